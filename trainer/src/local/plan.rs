//! `trainer plan`: shows what a run would do and why, from keys, checkpoints and the newest run of the same name. Runs
//! nothing.

use std::collections::{BTreeMap, BTreeSet};

use coordinator::search::{Score, Search, Ticket};
use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::message::RunState;
use protocol::stage::{TextEmbed, TextEncoder};
use protocol::sweep::{STATE_OUTPUT, rung_name};
use protocol::units::{counted, grouped};
use protocol::{ArtifactKind, Digest, RunId, StageName, Steps, TaskId};
use registry::{ReadStore, RunRow, StageResultRow};
use serde::Serialize;
use serde_json::Value;
use stages::run::estimate::Estimate;

use crate::local::fleet;
use crate::local::missing::Missing;
use crate::report::print;
use crate::report::problem::Result;

/// Plan of a stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Step {
    pub(crate) stage: StageName,
    pub(crate) kind: &'static str,
    /// `cached`, `resume` or `run`.
    pub(crate) action: &'static str,
    pub(crate) why: String,
    pub(crate) key: Option<Digest>,
    /// Updates of a training stage.
    pub(crate) steps: Option<u64>,
    /// Number of trained parameters, if the stage was tried.
    pub(crate) parameters: Option<u64>,
    /// Estimated seconds with one worker, if the stage was tried.
    pub(crate) seconds: Option<f64>,
}

/// The whole plan.
#[derive(Debug, Serialize)]
pub(crate) struct Plan {
    schema_version: u32,
    pipeline: String,
    pub(crate) stages: Vec<Step>,
    /// Folders that a run would need but that are missing.
    pub(crate) missing: Vec<Missing>,
    pub(crate) device: String,
    /// Default number of worker processes of `run`.
    pub(crate) workers: usize,
    /// The newest finished run of this name, if it computed all long stages of this one.
    before: Option<Before>,
}

/// The work of an earlier run on the stages that would run now.
#[derive(Debug, PartialEq, Serialize)]
struct Before {
    run: RunId,
    /// Seconds on its stages, one after the other, at the present number of steps.
    seconds: f64,
}

impl Plan {
    /// Adds estimates to the stages.
    pub(crate) fn estimate(&mut self, estimates: &BTreeMap<StageName, Estimate>) {
        for step in &mut self.stages {
            if let Some(Estimate { parameters, seconds }) = estimates.get(&step.stage) {
                (step.parameters, step.seconds) = (*parameters, *seconds);
            }
        }
    }

    /// The plan as text, in lines of at most [`COLUMNS`].
    pub(crate) fn screen(&self, pipeline: &Pipeline) -> String {
        let Self { pipeline: name, device, workers, .. } = self;
        let mut text = format!("{name}, seed {}, on {device}, {}\n", pipeline.seed, counted(*workers, "worker"));
        if !self.missing.is_empty() {
            text.push_str("\nMISSING on this machine:\n");
            for one in &self.missing {
                text.push_str(&format!("  {}\n    {}\n", cut(&one.place(), COLUMNS - 2), cut(one.origin, COLUMNS - 4)));
            }
            let mut encoders = pipeline.stages.iter().filter_map(|stage| stage.settings.get::<TextEmbed>());
            if encoders.any(|text| text.encoder == TextEncoder::Hashed) {
                text.push_str("  (the text encoder `hashed` is built in)\n");
            }
        }
        let known = |value: Option<String>| value.unwrap_or_default();
        let cells = self.stages.iter().map(|step| {
            let runs = step.action != "cached";
            vec![
                step.stage.to_string(),
                step.action.to_owned(),
                known(step.steps.map(grouped)),
                known(step.parameters.map(short)),
                known(step.seconds.filter(|_| runs).map(long)),
                step.why.clone(),
            ]
        });
        let heads = ["STAGE", "ACTION", "STEPS", "PARAMETERS", "TIME", "WHY"];
        let table = print::table(&heads, cells.collect());
        text.push('\n');
        text.extend(table.lines().map(|line| format!("{}\n", cut(line, COLUMNS))));
        text.push_str(&self.total());
        text.trim_end().to_owned()
    }

    fn total(&self) -> String {
        let runs = self.stages.iter().filter(|step| step.action != "cached");
        let (mut seconds, mut untried) = (0.0, 0);
        for step in runs {
            seconds += step.seconds.unwrap_or(0.0);
            untried += usize::from(step.seconds.is_none() && takes_long(step.kind));
        }
        let mut text = String::new();
        if let Some(Before { run, seconds }) = &self.before {
            text.push_str(&format!("\nrun {run} worked {} on these stages\n", long(*seconds)));
        }
        if seconds == 0.0 {
            return text;
        }
        let wall = seconds / self.workers.max(1) as f64;
        text.push_str(&format!(
            "\nabout {} with one worker on an idle machine, at best {} with {}\nestimated by {} updates per stage",
            long(seconds),
            long(wall),
            self.workers,
            stages::run::estimate::STEPS - 1,
        ));
        if untried > 0 {
            text.push_str(&format!(", without {} that could not be estimated in time", counted(untried, "stage")));
        }
        text.push('\n');
        text
    }
}

/// Returns false for stages whose kind takes negligible time.
fn takes_long(kind: &str) -> bool {
    ["train.", "distill.", "encode.", "evaluate."].iter().any(|of| kind.starts_with(of))
}

/// Width of a screen.
const COLUMNS: usize = 100;

/// Truncates a line that is too long.
fn cut(line: &str, columns: usize) -> String {
    if line.chars().count() <= columns {
        return line.to_owned();
    }
    line.chars().take(columns - 1).chain(['…']).collect()
}

/// Formats a count: `18.06M`, `612k`.
fn short(count: u64) -> String {
    match count {
        0..1_000 => count.to_string(),
        1_000..1_000_000 => format!("{:.0}k", count as f64 / 1e3),
        _ => format!("{:.2}M", count as f64 / 1e6),
    }
}

/// Like [`print::duration`], but in days from three days on.
fn long(seconds: f64) -> String {
    const DAY: f64 = 86_400.0;
    if seconds < 3.0 * DAY { print::duration(seconds) } else { format!("{:.0} days", seconds / DAY) }
}

/// Keys that are already known, and the outputs of finished stages.
struct Known {
    keys: BTreeMap<StageName, Digest>,
    outputs: BTreeMap<StageName, Digest>,
    made_by: BTreeMap<StageName, String>,
}

async fn known(pipeline: &Pipeline, store: Option<&ReadStore>) -> Result<Known> {
    let mut known = Known { keys: BTreeMap::new(), outputs: BTreeMap::new(), made_by: BTreeMap::new() };
    for stage in &pipeline.stages {
        if stage.sweep.is_some() {
            if let Some(store) = store
                && let Some((key, row)) = best_of_sweep(pipeline, stage, &known.outputs, store).await?
            {
                known.keys.insert(stage.name.clone(), key);
                known.made_by.insert(stage.name.clone(), row.run.to_string());
                let output = row.outputs.get(stage.settings.output().name).copied();
                known.outputs.extend(output.map(|output| (stage.name.clone(), output)));
            }
            continue;
        }
        let inputs: Option<BTreeMap<String, Digest>> =
            stage.inputs.iter().map(|input| Some((input.field.clone(), *known.outputs.get(&input.stage)?))).collect();
        let Some(inputs) = inputs else { continue };
        // A key needs the content of all folders.
        if !stage.settings.folders().iter().all(|folder| stage.external.contains_key(&folder.field)) {
            continue;
        }
        let key = pipeline.identity(stage, &inputs).key();
        known.keys.insert(stage.name.clone(), key);
        if let Some(store) = store
            && let Some(row) = store.stage_result(key).await?
        {
            known.made_by.insert(stage.name.clone(), row.run.to_string());
            known.outputs.extend(row.outputs.into_values().next().map(|output| (stage.name.clone(), output)));
        }
    }
    Ok(known)
}

/// The best trial of a sweep, if the store has all results that the sweep needs. The searcher runs on the store's
/// results.
async fn best_of_sweep(
    pipeline: &Pipeline,
    stage: &PipelineStage,
    outputs: &BTreeMap<StageName, Digest>,
    store: &ReadStore,
) -> Result<Option<(Digest, StageResultRow)>> {
    let Some(sweep) = &stage.sweep else { return Ok(None) };
    let mut search = Search::new(sweep, &stage.settings, &stage.name, pipeline.seed);
    let mut made: BTreeMap<StageName, (Digest, StageResultRow)> = BTreeMap::new();
    let mut next = 0;
    while let Some(ticket) = search.tickets().get(next).copied() {
        next += 1;
        let Ticket::Rung { trial, rung } = ticket else { continue };
        let stop = search.stop(rung).map(Steps);
        let Ok(stages) = stage.rung(trial, rung, stop, &search.trials()[trial]) else {
            search.report(next - 1, Score::Failed);
            continue;
        };
        let mut score = Score::Failed;
        for stage in stages {
            let read = |input: &StageInput| match (made.get(&input.stage), input.kind) {
                (Some((_, row)), ArtifactKind::Checkpoint) => row.outputs.get(STATE_OUTPUT).copied(),
                (Some((_, row)), _) => {
                    row.outputs.iter().find(|(name, _)| *name != STATE_OUTPUT).map(|(_, output)| *output)
                }
                (None, _) => outputs.get(&input.stage).copied(),
            };
            let inputs: Option<BTreeMap<String, Digest>> =
                stage.inputs.iter().map(|input| Some((input.field.clone(), read(input)?))).collect();
            let Some(inputs) = inputs else { return Ok(None) };
            let key = pipeline.identity(&stage, &inputs).key();
            let Some(row) = store.stage_result(key).await? else { return Ok(None) };
            score = row.metrics.get(&sweep.metric).map_or(Score::Failed, |value| Score::of(*value));
            made.insert(stage.name, (key, row));
        }
        search.report(next - 1, score);
    }
    let last = search.rungs().len() - 1;
    Ok(search.best().and_then(|(trial, _)| made.remove(&rung_name(&stage.name, trial, last))))
}

/// Plans a run of `pipeline` on `store`; `None` is a store that does not exist yet.
pub(crate) async fn plan(pipeline: &Pipeline, store: Option<&ReadStore>) -> Result<Plan> {
    let now = known(pipeline, store).await?;
    let mut resumable = BTreeMap::new();
    let mut earlier = Vec::new();
    let mut finished = None;
    if let Some(store) = store {
        let runs = store.runs().await?;
        resumable = checkpoints(pipeline, &now, store, &runs).await?;
        earlier = earlier_runs(&pipeline.name, runs);
        finished = worked(&earlier, store).await?;
    }
    let mut running: BTreeSet<&StageName> = BTreeSet::new();
    let mut stages = Vec::new();
    for stage in &pipeline.stages {
        let key = now.keys.get(&stage.name).copied();
        let (action, why) = if let Some(run) = now.made_by.get(&stage.name) {
            ("cached", format!("key {} from run {run}", key.map(|key| key.short()).unwrap_or_default()))
        } else {
            let upstream = stage.inputs.iter().find(|input| running.contains(&input.stage));
            let absent = stage.settings.folders().into_iter().find(|f| !stage.external.contains_key(&f.field));
            match (resumable.get(&stage.name).cloned(), upstream) {
                (None, _) if absent.is_some() => {
                    ("run", format!("`{}` is missing", absent.map(|folder| folder.path).unwrap_or_default()))
                }
                (None, None) if stage.sweep.is_some() => {
                    let trials = stage.sweep.as_ref().map_or(0, protocol::sweep::Sweep::trials);
                    ("run", format!("a sweep of up to {trials} trials; finished trials are not run again"))
                }
                (Some(why), _) => ("resume", why),
                (None, Some(input)) => ("run", format!("upstream `{}` runs", input.stage)),
                (None, None) => ("run", difference(pipeline, stage, &earlier)),
            }
        };
        if action != "cached" {
            running.insert(&stage.name);
        }
        stages.push(Step {
            stage: stage.name.clone(),
            kind: stage.settings.kind(),
            action,
            why,
            key,
            steps: stage.settings.steps().map(|steps| steps.0),
            parameters: None,
            seconds: None,
        });
    }
    let backend = pipeline.backend;
    let device = models::device::available().into_iter().find(|device| device.backend == backend);
    // The name of the device, or why there is none, up to its first comma.
    let device =
        device.map(|device| if device.index.is_some() { device.name } else { device.note }).unwrap_or_default();
    let device = device.split(',').next().unwrap_or_default();
    let before = finished.and_then(|(run, worked)| Some(Before { run, seconds: needed(&stages, &worked)? }));
    Ok(Plan {
        schema_version: 1,
        pipeline: pipeline.name.clone(),
        stages,
        missing: Vec::new(),
        device: format!("{} ({device})", backend.name()),
        workers: fleet::default_size(backend),
        before,
    })
}

/// Describes the run, step and checkpoint from which each unfinished training stage would resume. Stages of ended runs
/// are found by key. Only runs that have not ended are read, each once.
async fn checkpoints(
    pipeline: &Pipeline,
    now: &Known,
    store: &ReadStore,
    runs: &[RunRow],
) -> Result<BTreeMap<StageName, String>> {
    let mut unfinished: BTreeMap<Digest, &PipelineStage> = BTreeMap::new();
    for stage in &pipeline.stages {
        if let Some(key) = now.keys.get(&stage.name)
            && !now.made_by.contains_key(&stage.name)
            && stage.settings.steps().is_some()
        {
            unfinished.insert(*key, stage);
        }
    }
    if unfinished.is_empty() {
        return Ok(BTreeMap::new());
    }
    let keys: Vec<Digest> = unfinished.keys().copied().collect();
    let mut begun: Vec<(Digest, (RunId, StageName))> = store.sources(&keys).await?.into_iter().collect();
    for row in runs.iter().filter(|row| !has_ended(row)) {
        // The pipeline of another build may not parse.
        let Ok(other) = serde_json::from_value::<Pipeline>(row.pipeline.clone()) else { continue };
        for (stage, key) in known(&other, Some(store)).await?.keys {
            begun.push((key, (row.run.clone(), stage)));
        }
    }
    let mut found: BTreeMap<StageName, (u64, String)> = BTreeMap::new();
    for (key, (run, task_stage)) in begun {
        let Some(stage) = unfinished.get(&key) else { continue };
        let Some(newest) = store.latest_checkpoint(&TaskId::of(&run, &task_stage, None)).await? else { continue };
        if found.get(&stage.name).is_some_and(|(step, _)| *step >= newest.step) {
            continue;
        }
        let steps = stage.settings.steps().map(|steps| steps.to_string()).unwrap_or_default();
        let why =
            format!("run {run} stopped at step {} of {steps} (checkpoint {})", newest.step, newest.manifest.short());
        found.insert(stage.name.clone(), (newest.step, why));
    }
    Ok(found.into_iter().map(|(stage, (_, why))| (stage, why)).collect())
}

fn has_ended(row: &RunRow) -> bool {
    serde_json::from_value(Value::String(row.state.clone())).is_ok_and(RunState::is_final)
}

/// Earlier runs of this name with their pipelines, newest first. Skips runs of another build that do not parse.
fn earlier_runs(name: &str, mut rows: Vec<RunRow>) -> Vec<(RunRow, Pipeline)> {
    rows.retain(|row| row.pipeline.get("name").and_then(Value::as_str) == Some(name));
    rows.sort_by_key(|row| std::cmp::Reverse(row.created_ms));
    let parsed = |row: RunRow| serde_json::from_value(row.pipeline.clone()).ok().map(|pipeline| (row, pipeline));
    rows.into_iter().filter_map(parsed).collect()
}

/// The work on a stage of an earlier run.
#[derive(Debug)]
struct Work {
    kind: &'static str,
    steps: Option<u64>,
    seconds: f64,
}

/// The newest of these runs that finished, with the work on its stages.
async fn worked(
    earlier: &[(RunRow, Pipeline)],
    store: &ReadStore,
) -> Result<Option<(RunId, BTreeMap<StageName, Work>)>> {
    let finished = earlier.iter().find(|(row, _)| row.state == RunState::Finished.name());
    let Some((row, pipeline)) = finished else { return Ok(None) };
    let keys = known(pipeline, Some(store)).await?.keys;
    let mut found = BTreeMap::new();
    for stage in &pipeline.stages {
        let Some(key) = keys.get(&stage.name) else { continue };
        let Some(result) = store.stage_result(*key).await? else { continue };
        let steps = stage.settings.steps().map(|steps| steps.0);
        found.insert(stage.name.clone(), Work { kind: stage.settings.kind(), steps, seconds: result.wall_s });
    }
    Ok(Some((row.run.clone(), found)))
}

/// Seconds that the stages of a plan need by the pace of an earlier run; `None` if it lacks one that takes long.
fn needed(stages: &[Step], worked: &BTreeMap<StageName, Work>) -> Option<f64> {
    let mut seconds = 0.0;
    for step in stages.iter().filter(|step| step.action != "cached" && takes_long(step.kind)) {
        let work = worked.get(&step.stage).filter(|work| work.kind == step.kind)?;
        let more = step.steps.zip(work.steps).map_or(1.0, |(now, then)| now as f64 / then.max(1) as f64);
        seconds += work.seconds * more;
    }
    (seconds > 0.0).then_some(seconds)
}

/// Describes the differences of a stage from the same stage in the newest run of that name.
fn difference(pipeline: &Pipeline, stage: &PipelineStage, earlier: &[(RunRow, Pipeline)]) -> String {
    let before = earlier.iter().find_map(|(_, other)| Some((other, other.stage(&stage.name)?)));
    let Some((other, before)) = before else { return "never run".into() };
    if before.settings.kind() != stage.settings.kind() {
        return format!("kind changed: {} -> {}", before.settings.kind(), stage.settings.kind());
    }
    let mut changes = Vec::new();
    if other.seed != pipeline.seed {
        changes.push(format!("seed {} -> {}", other.seed, pipeline.seed));
    }
    if other.backend != pipeline.backend {
        changes.push(format!("backend {} -> {}", other.backend.name(), pipeline.backend.name()));
    }
    for (field, content) in &stage.external {
        if before.external.get(field) != Some(content) {
            let is_version = stage.versions().iter().any(|input| input.field == *field);
            let what = if is_version { "the version" } else { "the content of the folder" };
            changes.push(format!("{what} `{field}`"));
        }
    }
    let json = |stage: &PipelineStage| serde_json::to_value(stage.settings.without_references()).unwrap_or_default();
    compare(&json(before), &json(stage), "", &mut changes);
    match changes.len() {
        0 => "not finished before".into(),
        1..=3 => format!("changed: {}", changes.join(", ")),
        more => format!("changed: {}, and {} more", changes[..3].join(", "), more - 3),
    }
}

fn compare(before: &Value, after: &Value, path: &str, changes: &mut Vec<String>) {
    match (before, after) {
        (Value::Object(before), Value::Object(after)) => {
            let keys: BTreeSet<&String> = before.keys().chain(after.keys()).collect();
            for key in keys {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                let get = |map: &serde_json::Map<String, Value>| map.get(key).cloned().unwrap_or_default();
                compare(&get(before), &get(after), &path, changes);
            }
        }
        _ if before != after => changes.push(format!("{path} {before} -> {after}")),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "name: p\ndataset: {format: synthetic}\nstages:\n  vae: {kind: train.vae}\n";

    fn pipeline(sets: &[&str]) -> Pipeline {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        pipeline::read("p.yaml", TEXT, &sets).unwrap_or_else(|mistakes| panic!("{mistakes}"))
    }

    fn row(pipeline: &Pipeline) -> RunRow {
        RunRow {
            submission: None,
            run: "p-1".into(),
            pipeline: serde_json::to_value(pipeline).unwrap(),
            source: String::new(),
            state: "finished".into(),
            idempotency_key: None,
            created_ms: 0,
            updated_ms: 0,
        }
    }

    #[test]
    fn a_changed_setting_is_named() {
        let before = pipeline(&["vae.lr=2e-4"]);
        let rows = || vec![row(&before)];
        let why = |sets: &[&str]| {
            let now = pipeline(sets);
            difference(&now, now.stage(&"vae".into()).unwrap(), &earlier_runs(&now.name, rows()))
        };
        assert_eq!(why(&["vae.lr=1e-4"]), "changed: lr 0.0002 -> 0.0001");
        assert_eq!(why(&["vae.network.width=64", "seed=3"]), "changed: seed 0 -> 3, network.width 256 -> 64");
        assert_eq!(why(&[]), "not finished before");
        assert_eq!(why(&["name=q"]), "never run");
    }

    #[test]
    fn an_earlier_run_tells_what_a_longer_one_needs() {
        let step = |stage: &str, kind, action, steps| Step {
            stage: stage.into(),
            kind,
            action,
            why: String::new(),
            key: None,
            steps,
            parameters: None,
            seconds: None,
        };
        let now = [
            step("dataset", "data.synthetic", "cached", None),
            step("vae", "train.vae", "run", Some(300)),
            step("fid", "evaluate.latent_fid", "run", None),
        ];
        let work = |kind, steps, seconds| Work { kind, steps, seconds };
        let vae = || ("vae".into(), work("train.vae", Some(100), 20.0));
        let fid = |kind| ("fid".into(), work(kind, None, 5.0));
        assert_eq!(needed(&now, &BTreeMap::from([vae(), fid("evaluate.latent_fid")])), Some(65.0));
        assert_eq!(needed(&now, &BTreeMap::from([vae(), fid("evaluate.recognition")])), None, "of another kind");
        assert_eq!(needed(&now, &BTreeMap::from([vae()])), None, "it lacks a stage");
        assert_eq!(needed(&now[..1], &BTreeMap::from([vae()])), None, "nothing runs");
    }

    #[tokio::test]
    async fn a_recipe_without_its_data_is_one_screen() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/motionpcm.yaml");
        let text = std::fs::read_to_string(file).expect("a shipped recipe");
        // Paths that do not exist, independent of the folders beside the tests.
        let text = text.replace("path: data/", "path: nowhere/data/").replace(" deps/", " nowhere/deps/");
        let pipeline = pipeline::read("p.yaml", &text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
        let mut plan = plan(&pipeline, None).await.unwrap_or_else(|problem| panic!("{problem:?}"));
        plan.missing = crate::local::missing::missing(&pipeline);
        let found = Estimate { parameters: Some(18_056_487), seconds: Some(1.2e7) };
        plan.estimate(&BTreeMap::from([("vae".into(), found)]));
        let screen = plan.screen(&pipeline);
        println!("{screen}");
        let (lines, widest) = (screen.lines().count(), screen.lines().map(|line| line.chars().count()).max());
        assert!(lines <= 40 && widest <= Some(COLUMNS), "{lines} lines, the widest of {widest:?}");
        for part in [
            "nowhere/data/HumanML3D: no such folder",
            "nowhere/deps/t2m/t2m: no such folder",
            "nowhere/deps/glove: no such folder",
            "nowhere/data/sentence-t5-large: no such folder",
            "Sentence-T5, such as huggingface.co/",
            "flex (CPU",
            "1,150,000  18.06M      139 days",
            "about 139 days with one worker on an idle machine",
            "that could not be estimated",
        ] {
            assert!(screen.contains(part), "`{part}` is missing");
        }
        assert!(plan.stages.iter().all(|step| step.action == "run"), "nothing is known");
        assert!(plan.stages[0].key.is_none(), "no key without the folder's content");
    }

    #[tokio::test]
    async fn without_a_store_everything_runs() {
        let plan = plan(&pipeline(&[]), None).await.unwrap_or_else(|problem| panic!("{problem:?}"));
        let shown: Vec<(&str, &str)> = plan.stages.iter().map(|step| (step.stage.as_str(), &*step.why)).collect();
        assert_eq!(shown, [("dataset", "never run"), ("vae", "upstream `dataset` runs")]);
        assert!(plan.stages[0].key.is_some() && plan.stages[1].key.is_none());
    }
}
