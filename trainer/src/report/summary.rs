//! Result of a run: a table for people, one object for programs.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use coordinator::shell::RunSettings;
use pipeline::Pipeline;
use protocol::message::{RunState, RunView, StageState, StageView, StorageProblem, SweepView};
use protocol::stage::Register;
use protocol::units::{grouped, size};
use protocol::{Digest, StageName};
use registry::leaderboard::Evaluation;
use serde::Serialize;

use crate::report::print;

/// The object of `run -o json` and `status -o json`. Fields are only ever added.
#[derive(Debug, Serialize)]
pub(crate) struct Summary {
    schema_version: u32,
    run: String,
    pipeline: String,
    /// Owner of the run.
    owner: String,
    state: String,
    /// Order among the runs of its group.
    #[serde(skip_serializing_if = "Option::is_none")]
    priority: Option<i32>,
    stages: Vec<StageSummary>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    sweeps: Vec<SweepView>,
    /// The problem that keeps the coordinator from reading or writing the run's data.
    #[serde(skip_serializing_if = "Option::is_none")]
    storage: Option<StorageProblem>,
}

#[derive(Debug, Serialize)]
struct StageSummary {
    name: String,
    kind: String,
    state: &'static str,
    key: Option<Digest>,
    outputs: BTreeMap<String, Digest>,
    metrics: BTreeMap<String, f64>,
    wall_s: f64,
    /// Peak memory of a worker's process, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    peak_memory: Option<u64>,
    /// Why it was computed, beside the previous run.
    #[serde(skip_serializing_if = "Option::is_none")]
    why: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    message: Option<String>,
    /// The swept stage, if this stage is one of its trials.
    #[serde(skip_serializing_if = "Option::is_none")]
    of: Option<StageName>,
    /// The stage of the file that this one is a copy of.
    #[serde(skip_serializing_if = "Option::is_none")]
    copy_of: Option<StageName>,
}

/// Why stages were computed, in the server's words.
pub(crate) type Whys = BTreeMap<StageName, String>;

/// The reasons in a run's settings, without empty ones.
pub(crate) fn whys(settings: RunSettings) -> Whys {
    let mut whys = Whys::new();
    for stage in settings.stages {
        if let Some(why) = stage.why.filter(|why| !why.text.is_empty()) {
            whys.insert(stage.stage, why.text);
        }
    }
    whys
}

impl Summary {
    /// Creates the object; `interrupted` distinguishes a run that was drained from a running one.
    pub(crate) fn of(run: &RunView, whys: &Whys, interrupted: bool) -> Self {
        let stage = |stage: &StageView| StageSummary {
            name: stage.name.to_string(),
            kind: stage.kind.clone(),
            state: state(stage.state),
            key: stage.key,
            outputs: stage.outputs.clone(),
            metrics: stage.metrics.clone(),
            wall_s: stage.wall_s,
            peak_memory: stage.peak_memory,
            why: whys.get(&stage.name).cloned(),
            message: stage.message.clone(),
            of: stage.of.clone(),
            copy_of: stage.copy_of.clone(),
        };
        let interrupted = run.interrupted || (interrupted && !run.state.is_final());
        Self {
            schema_version: 1,
            run: run.run.to_string(),
            pipeline: run.pipeline.clone(),
            owner: run.owner.to_string(),
            state: if interrupted { "interrupted".to_owned() } else { run_state(run).to_owned() },
            priority: Some(run.priority).filter(|priority| *priority != 0),
            stages: run.stages.iter().map(stage).collect(),
            sweeps: run.sweeps.clone(),
            storage: run.storage.clone(),
        }
    }
}

/// A stage's state in one word.
pub(crate) fn state(state: StageState) -> &'static str {
    match state {
        StageState::Waiting => "waiting",
        StageState::Ready => "ready",
        StageState::Running => "running",
        StageState::Ran => "ran",
        StageState::Cached => "cached",
        StageState::Resumed => "resumed",
        StageState::Failed => "failed",
        StageState::Skipped => "skipped",
    }
}

/// A run's state in one word.
pub(crate) fn run_state(run: &RunView) -> &'static str {
    match run.state {
        RunState::Paused if run.interrupted => "interrupted",
        RunState::Running if run.queued => "queued",
        RunState::Running => "running",
        RunState::Paused => "paused",
        RunState::Finished => "finished",
        RunState::Failed => "failed",
        RunState::Cancelled => "cancelled",
    }
}

/// The priority of a run as it follows the run's state; empty for the usual one.
pub(crate) fn with_priority(priority: i32) -> String {
    if priority == 0 { String::new() } else { format!(", priority {priority}") }
}

/// The requested stages, one per line, and one line per sweep. `trainer sweep status` shows the trials.
pub(crate) fn table(run: &RunView, whys: &Whys) -> String {
    let asked_for = run.stages.iter().filter(|stage| stage.of.is_none() && stage.is_asked_for());
    let rows = asked_for.map(|stage| {
        let progress = &stage.progress;
        let (done, total) = (grouped(progress.done), grouped(progress.total));
        let steps = if progress.total > 0 { format!("{done}/{total}") } else { String::new() };
        vec![
            stage.name.to_string(),
            stage.kind.clone(),
            state(stage.state).to_owned(),
            steps,
            if stage.wall_s > 0.0 { print::duration(stage.wall_s) } else { String::new() },
            stage.peak_memory.map(size).unwrap_or_default(),
            stage.key.map(|key| key.short()).unwrap_or_default(),
            headline(stage),
            whys.get(&stage.name).cloned().unwrap_or_default(),
        ]
    });
    let table =
        print::table(&["STAGE", "KIND", "STATE", "DONE", "TIME", "MEMORY", "KEY", "RESULT", "WHY"], rows.collect());
    let table = run.sweeps.iter().fold(table, |text, sweep| format!("{text}\n\nsweep of {}", sweep_line(sweep)));
    match &run.storage {
        Some(problem) => format!("{table}\n\nstorage: {}", storage_line(problem)),
        None => table,
    }
}

/// Formats a storage problem: `for 2m 3s: there was no answer`.
fn storage_line(problem: &StorageProblem) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let since = Duration::from_millis(u64::try_from(problem.since_ms).unwrap_or_default());
    format!("for {}: {}", print::duration(now.saturating_sub(since).as_secs_f64()), problem.what)
}

/// Describes a sweep:
/// `pcm: trial 7 is best, latent_fid 0.1234 with adversarial 0.1; 24 trials, 5200 of 21600 steps (24 %)`.
pub(crate) fn sweep_line(sweep: &SweepView) -> String {
    let best =
        sweep.best.and_then(|best| sweep.trials.get(best)).map_or("no trial is finished yet".to_owned(), |best| {
            let value = best.results.last().copied().flatten().unwrap_or(f64::NAN);
            let values: Vec<String> = best.values.iter().map(|(path, value)| format!("{path} {value}")).collect();
            format!(
                "trial {} is best, {} {} with {}",
                best.trial,
                sweep.metric,
                print::number(value),
                values.join(", ")
            )
        });
    let percent = 100.0 * sweep.spent as f64 / sweep.full.max(1) as f64;
    let (stage, trials, spent, full) = (&sweep.stage, sweep.trials.len(), sweep.spent, sweep.full);
    format!("{stage}: {best}; {trials} trials, {spent} of {full} steps ({percent:.0} %)")
}

/// A table for each kind of evaluation with several stages, in the papers' column order.
pub(crate) fn evaluations(run: &RunView) -> String {
    let mut kinds: Vec<&str> =
        run.stages.iter().map(|stage| stage.kind.as_str()).filter(|kind| kind.starts_with("evaluate.")).collect();
    kinds.sort_unstable();
    kinds.dedup();
    let of_kind = |kind: &&str| {
        let stages = run.stages.iter().filter(|stage| stage.kind == *kind && !stage.metrics.is_empty());
        let evaluation = |stage: &StageView| Evaluation {
            name: stage.name.to_string(),
            copy_of: stage.copy_of.as_ref().map(ToString::to_string),
            metrics: stage.metrics.clone(),
        };
        let all: Vec<_> = stages.map(evaluation).collect();
        if all.len() < 2 { None } else { registry::leaderboard::evaluations(kind, &all) }
    };
    let tables =
        kinds.iter().filter_map(of_kind).map(|table| format!("\n{}", table.render(registry::leaderboard::Style::Text)));
    tables.collect()
}

/// The most important metric, or the reason why there is none.
fn headline(stage: &StageView) -> String {
    if matches!(stage.state, StageState::Failed | StageState::Skipped) {
        return stage.message.clone().unwrap_or_default().lines().next().unwrap_or_default().chars().take(90).collect();
    }
    if let (StageState::Running | StageState::Ready, Some(message)) = (stage.state, &stage.message) {
        return message.clone();
    }
    let first = ["latent_fid", "fid", "mpjpe", "mpjpe_mm", "loss"]
        .into_iter()
        .find_map(|key| stage.metrics.get_key_value(key))
        .or_else(|| stage.metrics.first_key_value());
    first.map(|(key, value)| format!("{key} {}", print::number(*value))).unwrap_or_default()
}

/// The model that the run promoted, as an argument of `generate`.
pub(crate) fn promoted(pipeline: &Pipeline, run: &RunView) -> Option<String> {
    let done = |name: &StageName| {
        let stage = run.stages.iter().find(|stage| &stage.name == name)?;
        matches!(stage.state, StageState::Ran | StageState::Cached | StageState::Resumed).then_some(())
    };
    pipeline.stages.iter().rev().find_map(|stage| {
        let settings = stage.settings.get::<Register>()?;
        done(&stage.name)?;
        let pick = if settings.promote.to.is_empty() { "best" } else { &settings.promote.to };
        Some(format!("{}@{pick}", settings.model))
    })
}

#[cfg(test)]
mod tests {
    use protocol::message::Progress;

    use super::*;

    fn view(states: &[(&str, &str, StageState)]) -> RunView {
        let stage = |(name, kind, state): &(&str, &str, StageState)| StageView {
            name: (*name).into(),
            kind: (*kind).into(),
            state: *state,
            key: Some(Digest::of(b"key")),
            outputs: BTreeMap::from([("x".to_owned(), Digest::of(b"x"))]),
            metrics: BTreeMap::from([("latent_fid".to_owned(), 0.25), ("a".to_owned(), 1.0)]),
            progress: Progress::default(),
            wall_s: 2.0,
            peak_memory: Some(412 << 20),
            attempt: protocol::Attempt(1),
            workers: vec![],
            instruction_set: None,
            message: None,
            wants_workers: None,
            of: None,
            copy_of: None,
            times: Default::default(),
            needs: vec![],
        };
        RunView {
            run: "p-1".into(),
            pipeline: "p".into(),
            owner: protocol::Owner::default(),
            state: RunState::Finished,
            interrupted: false,
            priority: 0,
            queued: false,
            stages: states.iter().map(stage).collect(),
            sweeps: vec![],
            storage: None,
            times: Default::default(),
            note: String::new(),
        }
    }

    #[test]
    fn programs_get_what_was_promised() {
        let view = view(&[("vae", "train.vae", StageState::Ran), ("mld", "train.mld", StageState::Cached)]);
        let json = serde_json::to_value(Summary::of(&view, &Whys::new(), false)).unwrap();
        assert_eq!((&json["run"], &json["state"]), (&"p-1".into(), &"finished".into()));
        let stage = &json["stages"][0];
        assert_eq!(
            (&stage["name"], &stage["kind"], &stage["state"]),
            (&"vae".into(), &"train.vae".into(), &"ran".into())
        );
        assert_eq!(stage["outputs"]["x"], Digest::of(b"x").to_string());
        assert_eq!(stage["metrics"]["latent_fid"], 0.25);
        assert_eq!(json["stages"][1]["state"], "cached");
    }

    #[test]
    fn people_get_a_line_a_stage() {
        let whys = Whys::from([("fid".into(), "repeats 1 -> 20".to_owned())]);
        let table = table(&view(&[("fid", "evaluate.latent_fid", StageState::Resumed)]), &whys);
        let lines: Vec<&str> = table.lines().collect();
        assert!(lines[0].starts_with("STAGE") && lines[1].starts_with("fid"), "{table}");
        assert!(lines[1].contains("resumed") && lines[1].contains("latent_fid 0.2500"), "{table}");
        assert!(lines[1].contains("412.0 MiB") && lines[1].ends_with("repeats 1 -> 20"), "{table}");
    }

    #[test]
    fn an_interrupted_run_is_not_called_paused_and_what_was_not_asked_for_has_no_row() {
        let mut run = view(&[("vae", "train.vae", StageState::Ready), ("mld", "train.mld", StageState::Skipped)]);
        run.state = RunState::Paused;
        assert_eq!(run_state(&run), "paused");
        run.interrupted = true;
        assert_eq!(run_state(&run), "interrupted");
        assert_eq!(serde_json::to_value(Summary::of(&run, &Whys::new(), false)).unwrap()["state"], "interrupted");
        run.stages[0].message = Some("interrupted at 1,204 of 6,000 steps".to_owned());
        run.stages[0].progress = Progress { done: 1204, total: 6000, ..Progress::default() };
        run.stages[1].message = Some(StageView::NOT_ASKED_FOR.to_owned());
        let table = table(&run, &Whys::new());
        assert!(table.contains("1,204/6,000") && table.contains("interrupted at 1,204 of 6,000 steps"), "{table}");
        assert!(!table.contains("mld"), "{table}");
    }

    #[test]
    fn evaluations_are_printed_as_the_papers_print_them() {
        let kinds = [("real", "evaluate.t2m"), ("pcm", "evaluate.t2m"), ("fid", "evaluate.latent_fid")];
        let mut run = view(&kinds.map(|(name, kind)| (name, kind, StageState::Ran)));
        run.stages.iter_mut().for_each(|stage| stage.metrics.clear());
        assert_eq!(evaluations(&run), "", "an evaluation that is not done has no row");
        let values = [("fid", 0.25), ("fid.lower", 0.2), ("fid.upper", 0.3), ("r_precision_top3", 0.8)];
        run.stages[0].metrics = values.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect();
        run.stages[1].metrics = run.stages[0].metrics.clone();
        let text = evaluations(&run);
        let row = text.lines().find(|line| line.contains("real")).unwrap();
        let cells: Vec<&str> = row.split_whitespace().collect();
        assert_eq!(
            cells,
            ["real", "0.800", "*", "0.250", "±", "0.050", "*"],
            "what was measured and no other column: {text}"
        );
    }

    #[test]
    fn the_promoted_model_is_offered_once_it_is_there() {
        let text = "name: p\ndataset: {format: synthetic}\nstages:\n  vae: {kind: train.vae}\n  latents: {kind: encode.latents}\n  mld: {kind: train.mld}\n  pcm: {kind: distill.pcm, phases: 2}\n  fid: {kind: evaluate.latent_fid, model: pcm, sampler: {steps: 2}}\n  out: {kind: register, model: m, from: pcm, promote: {to: staging}}\n";
        let pipeline = pipeline::read("p.yaml", text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
        let ready = view(&[("out", "register", StageState::Ran)]);
        assert_eq!(promoted(&pipeline, &ready), Some("m@staging".to_owned()));
        let failed = view(&[("out", "register", StageState::Failed)]);
        assert_eq!(promoted(&pipeline, &failed), None);
    }
}
