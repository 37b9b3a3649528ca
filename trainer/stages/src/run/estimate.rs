//! Estimates the cost of a pipeline on this machine: each stage is run at its real size on a few made-up clips, and
//! timed.
//!
//! It reads only the pipeline and keeps nothing, so a pipeline has an estimate before its data exists. A training stage
//! makes a few updates of a slice of two examples, or of more if they take little time. The time of an update is that of
//! its batch at this pace. An evaluation draws a few motions. Both are paces of small batches, which a large one may
//! exceed, of clips with HumanML3D's mean length, on one thread. On a processor they are the thread's own time, so an
//! estimate is that of an idle machine even if this one is loaded. Published text encoders are not run: the built-in one replaces them, with
//! vectors of its own width. The teacher's samples for `match` are left out.
//!
//! Not a stage: it reads the clock.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use checkpoint::Blobs;
use pipeline::{Pipeline, PipelineStage};
use protocol::message::StageTask;
use protocol::stage::{CheckpointPolicy, Replicas, Sampler, Shape, Split, StageSettings};
use protocol::{ArtifactKind, Digest, FileEntry, Manifest, RunId, StageName, Steps};
use serde_json::{Value, json};

use super::clock::Clock;
use super::solo::{Overlay, Solo};
use crate::artifacts::MODEL_FILE;
use crate::context::{AttemptContext, Outcome, Part, StageError};
use crate::kinds;

/// Number of updates made; the first is not timed.
pub const STEPS: u64 = 4;
/// Number of examples in each update.
const EXAMPLES: usize = 2;
/// Number of examples in each update of a stage that updates quickly. A small network takes less time per example in a
/// larger slice.
const MANY: usize = 16;
/// Time of an update of [`EXAMPLES`] up to which a stage is tried again with [`MANY`].
const QUICK: f64 = 0.1;
/// Samplers with more steps are timed with this many and with half of them.
const SAMPLED: usize = 4;

/// The cost of one stage.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Estimate {
    /// Number of parameters that the stage trains.
    pub parameters: Option<u64>,
    /// Duration on one worker, in seconds.
    pub seconds: Option<f64>,
}

/// Number of entries of a dataset by split.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entries {
    /// Entries in `train.txt`.
    pub train: usize,
    /// Entries in `val.txt`.
    pub val: usize,
    /// Entries in `test.txt`.
    pub test: usize,
}

impl Entries {
    fn of(self, split: Split) -> usize {
        match split {
            Split::Train => self.train,
            Split::Val => self.val,
            Split::Test => self.test,
            Split::All => self.train + self.val + self.test,
        }
    }
}

/// Estimates each stage that can be run, until `budget` is spent; a sweep counts all its trials. `entries` are those of
/// each dataset stage.
pub fn estimate(
    pipeline: &Pipeline,
    entries: &BTreeMap<StageName, Entries>,
    device: &Device,
    budget: Duration,
) -> BTreeMap<StageName, Estimate> {
    let begun = Instant::now();
    let mut tries =
        Tries { pipeline, entries, device: device.clone(), blobs: Arc::default(), outputs: BTreeMap::new() };
    let mut found = BTreeMap::new();
    for stage in &pipeline.stages {
        if begun.elapsed() > budget {
            break;
        }
        // A stage that cannot be run has no estimate, and neither have its readers.
        if let Ok(estimate) = tries.stage(stage) {
            found.insert(stage.name.clone(), estimate);
        }
    }
    found
}

struct Tries<'a> {
    pipeline: &'a Pipeline,
    entries: &'a BTreeMap<StageName, Entries>,
    device: Device,
    blobs: Arc<Overlay>,
    /// Outputs of the stages that were run.
    outputs: BTreeMap<StageName, Digest>,
}

impl Tries<'_> {
    fn stage(&mut self, stage: &PipelineStage) -> Result<Estimate, StageError> {
        let settings = &stage.settings;
        if settings.shape() == Shape::Registry {
            return Ok(Estimate::default());
        }
        let made = kinds::stand_in(settings, &mut self.solo(stage, settings.clone(), BTreeMap::new()));
        if let Some(output) = made {
            self.outputs.insert(stage.name.clone(), output?);
            return Ok(Estimate::default());
        }
        if let Some(cheaper) = kinds::cheaper(settings) {
            let tried = self.run(stage, cheaper, self.inputs(stage)?)?;
            self.outputs.insert(stage.name.clone(), tried.output);
            return Ok(Estimate::default());
        }
        let inputs = self.inputs(stage)?;
        let tried = |settings: StageSettings| self.run(stage, settings, inputs.clone());
        let (output, seconds) = if settings.training().is_some() {
            let update = |examples| -> Result<Tried, StageError> {
                let (reduced, share) = reduced_training(settings, examples)?;
                let found = tried(reduced)?;
                Ok(Tried { pace: found.pace.map(|pace| pace * share), ..found })
            };
            let few = update(EXAMPLES)?;
            let global = settings.training().map_or(0, |training| training.batch.global);
            let is_quick = few.pace.is_some_and(|pace| pace * EXAMPLES as f64 <= QUICK * global as f64);
            // If more examples cannot be tried, the few have to do.
            let many = (is_quick && global > EXAMPLES).then(|| update(MANY).ok()).flatten();
            let pace = many.and_then(|many| many.pace).or(few.pace);
            let steps = settings.steps().map_or(0, |steps| steps.0) as f64;
            (few.output, pace.map(|pace| pace * steps * trainings(stage)))
        } else {
            match settings.sampler() {
                // The time of longer samplers is extrapolated linearly in the steps.
                Some(sampler) if sampler.steps > SAMPLED && sampler.timesteps.is_empty() => {
                    let with = |steps| Sampler { steps, ..sampler.clone() };
                    let half = tried(reduced(settings, Some(&with(SAMPLED / 2)))?)?;
                    let all = tried(reduced(settings, Some(&with(SAMPLED)))?)?;
                    let line = half.pace.zip(all.pace).map(|(half, all)| {
                        let step = ((all - half) / (SAMPLED - SAMPLED / 2) as f64).max(0.0);
                        all + step * (sampler.steps - SAMPLED) as f64
                    });
                    (all.output, line.map(|pace| pace * self.units(settings)))
                }
                _ => {
                    let tried = tried(reduced(settings, None)?)?;
                    (tried.output, tried.pace.map(|pace| pace * self.units(settings)))
                }
            }
        };
        let parameters = settings.training().is_some().then(|| self.parameters(output, &inputs)).flatten();
        self.outputs.insert(stage.name.clone(), output);
        Ok(Estimate { parameters, seconds })
    }

    /// The inputs of the stage, from stages that were run before; without the teacher of `match`.
    fn inputs(&self, stage: &PipelineStage) -> Result<BTreeMap<String, Digest>, StageError> {
        let measures = stage.settings.output().kind == ArtifactKind::Report;
        let read = stage.inputs.iter().filter(|input| !(measures && input.field == "teacher"));
        let known = read.map(|input| {
            let untried = || StageError::Input(format!("stage `{}` was not estimated", input.stage));
            Ok((input.field.clone(), *self.outputs.get(&input.stage).ok_or_else(untried)?))
        });
        known.collect()
    }

    fn solo(&self, stage: &PipelineStage, settings: StageSettings, inputs: BTreeMap<String, Digest>) -> Solo {
        let task = StageTask {
            run: RunId::new("estimate"),
            name: stage.name.clone(),
            settings,
            inputs,
            seed: self.pipeline.seed,
            checkpoint: CheckpointPolicy { every: Steps(0), ..CheckpointPolicy::default() },
        };
        Solo::new(task, self.device.clone(), Arc::clone(&self.blobs), None, u64::MAX)
    }

    fn run(
        &self,
        stage: &PipelineStage,
        settings: StageSettings,
        inputs: BTreeMap<String, Digest>,
    ) -> Result<Tried, StageError> {
        let shape = settings.shape();
        let mut cx = self.solo(stage, settings, inputs);
        cx.clock = Clock::of(self.pipeline.backend);
        let given = |outcome| match outcome {
            Outcome::Finished { output, .. } => Ok(output),
            Outcome::Yielded { at } => Err(StageError::Fault(format!("the stage stopped after {at} steps"))),
        };
        let output = match shape {
            Shape::Plain | Shape::Registry => given(kinds::run_alone(&mut cx)?)?,
            Shape::Gang => given(kinds::run_gang(&mut cx)?)?,
            Shape::Map => {
                let shard = given(kinds::run_part(&mut cx, Part::Shard { index: 0, of: 1 })?)?;
                match cx.task().settings.output().kind {
                    // The report is unused, and with so few motions it may be meaningless.
                    ArtifactKind::Report => shard,
                    _ => given(kinds::run_part(&mut cx, Part::Merge { shards: vec![shard] })?)?,
                }
            }
        };
        let between = cx.progressed.windows(2).map(|pair| pair[1].saturating_sub(pair[0]).as_secs_f64());
        let paces: Vec<f64> = between.collect();
        let pace = (!paces.is_empty()).then(|| paces.iter().sum::<f64>() / paces.len() as f64);
        Ok(Tried { output, pace })
    }

    /// The number of times that the stage repeats the timed work.
    fn units(&self, settings: &StageSettings) -> f64 {
        let settings_json = serde_json::to_value(settings).unwrap_or_default();
        let of = |split: Split| -> f64 {
            let dataset = settings_json["dataset"].as_str().map(StageName::new);
            let entries = dataset.and_then(|dataset| self.entries.get(&dataset).copied());
            entries.map_or(0, |entries| entries.of(split)) as f64
        };
        kinds::repetitions(settings, &of)
    }

    /// Number of values in the weight files of `output` that are not files of its inputs.
    fn parameters(&self, output: Digest, inputs: &BTreeMap<String, Digest>) -> Option<u64> {
        let manifest =
            |digest: Digest| -> Option<Manifest> { serde_json::from_slice(&self.blobs.get(digest).ok()?).ok() };
        let known = inputs.values().filter_map(|digest| manifest(*digest)).flat_map(|input| input.files.into_values());
        let known: BTreeSet<Digest> = known.map(|entry| entry.digest).collect();
        let own = manifest(output)?
            .files
            .into_iter()
            .filter(|(name, entry)| name.rsplit('/').next() == Some(MODEL_FILE) && !known.contains(&entry.digest));
        let values = |file: &FileEntry| -> Option<u64> {
            let bytes = checkpoint::file::get(&*self.blobs, file).ok()?;
            let (_, metadata) = safetensors::SafeTensors::read_metadata(&bytes).ok()?;
            let count = |info: &safetensors::tensor::TensorInfo| info.shape.iter().product::<usize>() as u64;
            Some(metadata.tensors().values().map(|info| count(info)).sum())
        };
        own.map(|(_, entry)| values(&entry)).sum()
    }
}

/// The output of a stage, and the seconds between progress reports.
struct Tried {
    output: Digest,
    pace: Option<f64>,
}

/// The number of trainings of the stage's length in a sweep.
fn trainings(stage: &PipelineStage) -> f64 {
    let Some(sweep) = &stage.sweep else { return 1.0 };
    let (budget, trials) = (stage.settings.steps().map_or(1, |steps| steps.0.max(1)), sweep.trials());
    let mut done = 0;
    let mut left = trials;
    let mut steps = 0;
    for rung in sweep.rungs(budget) {
        steps += left as u64 * (rung - done);
        done = rung;
        left = left.div_ceil(usize::try_from(sweep.rungs.factor.max(2)).unwrap_or(usize::MAX));
    }
    steps as f64 / budget as f64
}

/// The settings with one slice of at most `examples` and few steps, and the number of such slices in a batch.
fn reduced_training(settings: &StageSettings, examples: usize) -> Result<(StageSettings, f64), StageError> {
    let Some(training) = settings.training() else { return Err(StageError::Fault("the stage does not train".into())) };
    let examples = training.batch.global.clamp(1, examples);
    let share = training.batch.global as f64 / examples as f64;
    let mut json = to_json(settings)?;
    json["steps"] = json!(STEPS);
    json["warmup"] = json!(0);
    json["batch"] = json!({"global": examples, "slices": 1});
    json["sync"] = json!(Replicas::default());
    // Phases have their own batches.
    for phase in ["windows", "movement"] {
        if let Some(batch) = json[phase]["batch"].as_u64().filter(|batch| *batch > 0) {
            json[phase]["batch"] = json!(((batch as f64 / share).round() as u64).max(1));
        }
    }
    Ok((without_files(json)?, share))
}

/// The settings of a map or plain stage, applied to all of the few clips.
fn reduced(settings: &StageSettings, sampler: Option<&Sampler>) -> Result<StageSettings, StageError> {
    let mut json = to_json(settings)?;
    let changes = [
        ("shards", json!(1)),
        ("repeats", json!(2)),
        ("samples", json!(1)),
        ("components", json!(2)),
        ("crops", json!(1)),
        ("pools", json!([4])),
        ("drop_last", json!(false)),
        ("split", json!("all")),
        ("teacher", json!("")),
        ("multimodality", json!({"captions": 0, "samples": 1, "pairs": 1})),
    ];
    for (key, value) in changes {
        if json.get(key).is_some() {
            json[key] = value;
        }
    }
    if let Some(sampler) = sampler {
        json["sampler"] = serde_json::to_value(sampler).map_err(|e| StageError::Fault(e.to_string()))?;
    }
    without_files(json)
}

fn to_json(settings: &StageSettings) -> Result<Value, StageError> {
    serde_json::to_value(settings).map_err(|e| StageError::Fault(e.to_string()))
}

/// The settings without folders to read.
fn without_files(mut json: Value) -> Result<StageSettings, StageError> {
    if json.get("words").is_some() {
        json["words"] = json!("");
    }
    serde_json::from_value(json).map_err(|e| StageError::Fault(e.to_string()))
}
