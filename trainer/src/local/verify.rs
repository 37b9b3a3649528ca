//! `trainer run --verify`: checks that this machine, with this build, reproduces the results in the store.
//!
//! Some steps of every training stage with progress are run again. They start from a committed checkpoint that is
//! followed by another one within reach. Otherwise they start from the newest checkpoint with later recorded values, or
//! from the beginning. The results are compared bit by bit: every value recorded at a step, the training state at every
//! later checkpoint, and the output if the stage's end is reached. The store is read and not changed.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use checkpoint::Blobs;
use pipeline::{Pipeline, PipelineStage};
use protocol::message::StageTask;
use protocol::stage::Shape;
use protocol::{Digest, Manifest, RunId, StageName, TaskId};
use registry::ReadStore;
use serde::Serialize;
use stages::run::verify::{Rerun, rerun, state_digest};

use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};

/// Result of verifying a stage.
#[derive(Debug, Serialize)]
struct Verified {
    stage: StageName,
    run: RunId,
    /// Steps of the initial state and of the final one.
    from: u64,
    to: u64,
    /// Number of compared values.
    values: usize,
    /// Number of compared digests: training states, and the output.
    digests: usize,
    /// Descriptions of the differences.
    differences: Vec<String>,
}

/// Data of a stage in the store.
struct Recorded {
    run: RunId,
    inputs: BTreeMap<String, Digest>,
    output: Option<Digest>,
    /// Committed checkpoints, oldest first.
    checkpoints: Vec<(u64, Manifest)>,
    values: BTreeMap<(u64, String), f64>,
}

/// Verifies `steps` steps of every training stage of `pipeline` that the store in `dir` has.
pub(crate) async fn verify(pipeline: &Pipeline, dir: &Path, steps: u64, output: Output) -> Result<u8> {
    let store = ReadStore::open(dir).await?;
    let mut pipeline = pipeline.clone();
    crate::local::pipeline_file::resolve_versions(&mut pipeline, Some(&store)).await?;
    let pipeline = &pipeline;
    let device = models::device::open(pipeline.backend, 0).map_err(|error| Problem::new(exit::USAGE, error))?;
    let mut outputs: BTreeMap<StageName, Digest> = BTreeMap::new();
    let mut all = Vec::new();
    for stage in &pipeline.stages {
        let inputs: Option<BTreeMap<String, Digest>> =
            stage.inputs.iter().map(|input| Some((input.field.clone(), *outputs.get(&input.stage)?))).collect();
        let Some(inputs) = inputs else { continue };
        let identity = pipeline.identity(stage, &inputs);
        let known = store.stage_result(identity.key()).await?;
        // Includes versions of the registry.
        let inputs = identity.inputs;
        if let Some(value) = known.as_ref().and_then(|row| row.outputs.values().next()) {
            outputs.insert(stage.name.clone(), *value);
        }
        if stage.settings.shape() != Shape::Gang {
            continue;
        }
        let Some(recorded) = recorded(&store, pipeline, stage, inputs, known).await? else { continue };
        let (from, until) = way(&recorded, steps, stage.settings.steps().map_or(0, |steps| steps.0));
        print::note(&format!(
            "{}: runs steps {} to {until} of run {} again",
            stage.name,
            from.map_or(0, |i| recorded.checkpoints[i].0) + 1,
            recorded.run
        ));
        let task = StageTask {
            run: recorded.run.clone(),
            name: stage.name.clone(),
            settings: stage.settings.clone(),
            inputs: recorded.inputs.clone(),
            seed: pipeline.seed,
            checkpoint: stage.placement.checkpoint.clone(),
        };
        let blobs: Arc<dyn Blobs> = Arc::new(store.blobs().clone());
        let (device, start) = (device.clone(), from.map(|i| recorded.checkpoints[i].1.clone()));
        // Deep graphs are dropped recursively, as in a worker.
        let thread = std::thread::Builder::new().name("verify".to_owned()).stack_size(64 << 20);
        let again = thread
            .spawn(move || rerun(task, device, blobs, start, until))
            .map_err(|error| Problem::failed(format!("cannot start a thread: {error}")))?;
        let again = again.join().map_err(|_| Problem::new(exit::FAULT, anyhow::anyhow!("the stage panicked")))?;
        let again = again.map_err(|error| {
            Problem::failed(format!("stage `{}` cannot be run again: {error}", stage.name))
                .hint("`trainer registry fsck` checks the store")
        })?;
        all.push(compare(&stage.name, &recorded, &again));
    }
    if all.is_empty() {
        return Err(Problem::usage(format!("no training of `{}` is stored in `{}` yet", pipeline.name, dir.display()))
            .hint("run the pipeline without --verify first"));
    }
    Ok(report(&all, output))
}

/// Reads the data of a stage: of the run that computed its result, or of the newest run with that pipeline.
async fn recorded(
    store: &ReadStore,
    pipeline: &Pipeline,
    stage: &PipelineStage,
    inputs: BTreeMap<String, Digest>,
    known: Option<registry::StageResultRow>,
) -> Result<Option<Recorded>> {
    let (name, output) = match &known {
        Some(row) => (row.stage.clone(), row.outputs.values().next().copied()),
        None => (stage.name.clone(), None),
    };
    let mut candidates: Vec<RunId> = known.iter().map(|row| row.run.clone()).collect();
    if candidates.is_empty() {
        let mut rows = store.runs().await?;
        rows.sort_by_key(|row| std::cmp::Reverse(row.created_ms));
        let digest = pipeline.digest();
        // The pipeline of another build may not parse; its results cannot be verified here.
        let same = |row: &registry::RunRow| {
            serde_json::from_value::<Pipeline>(row.pipeline.clone()).is_ok_and(|other| other.digest() == digest)
        };
        candidates.extend(rows.into_iter().filter(same).map(|row| row.run));
    }
    for run in candidates {
        let mut checkpoints = Vec::new();
        for row in store.checkpoints(&TaskId::of(&run, &name, None)).await?.into_iter().rev() {
            let bytes = store.blobs().get(row.manifest).map_err(Problem::failed)?;
            let manifest = serde_json::from_slice(&bytes)
                .map_err(|error| Problem::failed(format!("cannot read checkpoint {}: {error}", row.manifest)))?;
            checkpoints.push((row.step, manifest));
        }
        let mut values = BTreeMap::new();
        for (key, curve) in store.points(&run, &name, None, registry::Page::ALL).await? {
            values.extend(curve.points.iter().map(|point| ((point.step, key.clone()), point.value)));
        }
        if !checkpoints.is_empty() || !values.is_empty() {
            return Ok(Some(Recorded { run, inputs, output, checkpoints, values }));
        }
    }
    Ok(None)
}

/// Chooses the checkpoint to start from and the last step.
fn way(recorded: &Recorded, steps: u64, last: u64) -> (Option<usize>, u64) {
    let at = |i: usize| recorded.checkpoints[i].0;
    let count = recorded.checkpoints.len();
    // Newest first: a checkpoint whose successor is within reach.
    if let Some(i) = (1..count).rev().find(|i| at(*i) - at(i - 1) <= steps) {
        return (Some(i - 1), at(i));
    }
    let newest = recorded.values.keys().next_back().map_or(0, |(step, _)| *step);
    let start = (0..count).rev().find(|i| at(*i) < newest);
    let from = start.map_or(0, at);
    (start, (from + steps).min(last).max(from + 1))
}

fn compare(stage: &StageName, recorded: &Recorded, again: &Rerun) -> Verified {
    let mut differences = Vec::new();
    let (mut values, mut digests) = (0, 0);
    for ((step, key), value) in &again.values {
        let Some(before) = recorded.values.get(&(*step, key.clone())) else { continue };
        values += 1;
        if before.to_bits() != value.to_bits() {
            differences.push(format!("`{key}` after step {step} was {before:e}, now {value:e}"));
        }
    }
    let states = recorded.checkpoints.iter().filter_map(|(step, manifest)| Some((*step, state_digest(manifest)?)));
    for (step, before) in states {
        let Some(now) = again.states.get(&step) else { continue };
        digests += 1;
        if before != *now {
            differences.push(format!("the state after step {step} was {}, now {}", before.short(), now.short()));
        }
    }
    if let (Some(before), Some(now)) = (recorded.output, again.output) {
        digests += 1;
        if before != now {
            differences.push(format!("the output was {}, now {}", before.short(), now.short()));
        }
    }
    Verified {
        stage: stage.clone(),
        run: recorded.run.clone(),
        from: again.from,
        to: again.to,
        values,
        digests,
        differences,
    }
}

fn report(all: &[Verified], output: Output) -> u8 {
    match output {
        Output::Json => print::json(&serde_json::json!({"schema_version": 1, "stages": all})),
        Output::Table => {
            let row = |one: &Verified| {
                let verdict =
                    one.differences.first().map_or_else(|| "equal".to_owned(), |first| format!("DIFFERS: {first}"));
                vec![
                    one.stage.to_string(),
                    format!("{}..{}", one.from, one.to),
                    one.values.to_string(),
                    one.digests.to_string(),
                    verdict,
                ]
            };
            print::out(&print::table(
                &["STAGE", "STEPS", "VALUES", "DIGESTS", "VERDICT"],
                all.iter().map(row).collect(),
            ));
        }
    }
    let different: Vec<&str> =
        all.iter().filter(|one| !one.differences.is_empty()).map(|one| one.stage.as_str()).collect();
    if different.is_empty() {
        return 0;
    }
    let problem = Problem::new(
        exit::INTEGRITY,
        anyhow::anyhow!("the result differs from the stored one: {}", different.join(", ")),
    )
    .hint("another processor, backend or build may compute other bits; `trainer registry fsck` checks the store");
    print::problem(&problem, output);
    exit::INTEGRITY
}
