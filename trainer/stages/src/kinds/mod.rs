//! One file per stage kind, and the table that finds it.

mod consistency;
mod data;
mod encode;
mod evaluator;
mod import;
mod latent_data;
mod latent_fid;
mod lcm;
mod mld;
mod pcm;
mod reconstruction;
mod t2m;
pub mod text;
mod vae;

use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::Tensor;
use models::flat::{self, add_gradients};
use motion::Stream;
use protocol::ArtifactKind;
use protocol::stage::{Split, StageSettings, Training};
use serde_json::{Value, json};

use crate::artifacts;
use crate::context::{AttemptContext, GangContext, Outcome, Part, StageError};
use crate::train::GroupPlan;

/// Where a report's details are.
pub const REPORT_FILE: &str = "report.json";

/// Runs a plain stage.
pub fn run_alone(cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
    match cx.task().settings.clone() {
        StageSettings::DataOpen(settings) => data::open(cx, &settings),
        StageSettings::DataSynthetic(settings) => data::synthetic(cx, &settings),
        StageSettings::TextEmbed(settings) => text::run(cx, &settings),
        StageSettings::ImportEvaluator(settings) => import::run(cx, &settings),
        other => Err(misplaced(&other, "by one worker alone")),
    }
}

/// Runs one shard of a map stage, or merges them.
pub fn run_part(cx: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError> {
    match (cx.task().settings.clone(), part) {
        (StageSettings::EncodeLatents(settings), Part::Shard { index, of }) => encode::shard(cx, &settings, index, of),
        (StageSettings::EncodeLatents(_), Part::Merge { shards }) => encode::merge(cx, &shards),
        (StageSettings::EvaluateReconstruction(settings), Part::Shard { index, of }) => {
            reconstruction::shard(cx, &settings, index, of)
        }
        (StageSettings::EvaluateReconstruction(_), Part::Merge { shards }) => reconstruction::merge(cx, &shards),
        (StageSettings::EvaluateLatentFid(settings), Part::Shard { index, of }) => {
            latent_fid::shard(cx, &settings, index, of)
        }
        (StageSettings::EvaluateLatentFid(settings), Part::Merge { shards }) => {
            latent_fid::merge(cx, &settings, &shards)
        }
        (StageSettings::EvaluateT2m(settings), Part::Shard { index, of }) => t2m::shard(cx, &settings, index, of),
        (StageSettings::EvaluateT2m(settings), Part::Merge { shards }) => t2m::merge(cx, &settings, &shards),
        (other, _) => Err(misplaced(&other, "in shards")),
    }
}

/// Runs a training stage as a member of its gang.
pub fn run_gang(cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
    match cx.task().settings.clone() {
        StageSettings::TrainVae(settings) => vae::run(cx, &settings),
        StageSettings::TrainMld(settings) => mld::run(cx, &settings),
        StageSettings::DistillLcm(settings) => lcm::run(cx, &settings),
        StageSettings::DistillPcm(settings) => pcm::run(cx, &settings),
        StageSettings::TrainEvaluator(settings) => evaluator::run(cx, &settings),
        other => Err(misplaced(&other, "by a gang")),
    }
}

/// All parameters of `module` as one group that every step trains as `training` says, with a moving average of decay `ema` beside them
/// unless that is 0.
fn group<M: Module>(name: &'static str, module: &M, training: &Training, ema: f64) -> GroupPlan {
    GroupPlan {
        name,
        entries: flat::layout(module),
        params: flat::read(module),
        optimizer: (&training.optimizer).into(),
        lr: training.into(),
        ema: (ema > 0.0).then_some(ema),
        active: None,
    }
}

/// The gradient of a slice's loss for all parameters of `module`, and the loss.
fn slice_gradient<M: Module>(module: &M, loss: Tensor<1>) -> (Vec<f32>, f32) {
    let value = loss.clone().inner().into_scalar::<f32>();
    let mut gradients = loss.backward();
    let mut flat = vec![0.0; module.num_params()];
    add_gradients(module, &mut gradients, &mut flat);
    (flat, value)
}

/// What a stage's dropout is keyed by: the run's seed and the stage's name.
fn dropout_seed(cx: &dyn AttemptContext) -> u64 {
    Stream::new(cx.task().seed, &format!("{}/dropout", cx.task().name), 0, 0).bits()
}

/// Settings' own word for one of them, such as `humanml3d` or `test`.
pub(crate) fn word(setting: &impl serde::Serialize) -> String {
    serde_json::to_value(setting).ok().and_then(|value| Some(value.as_str()?.to_owned())).unwrap_or_default()
}

/// A split that an evaluation cannot be of.
fn no_entries(split: Split) -> StageError {
    StageError::Input(format!("the split `{}` has no entries; set `split` to one that has", word(&split)))
}

/// Nothing to train on.
fn no_clips() -> StageError {
    StageError::Input("the training split has no clips; list some in the dataset's `train.txt`".into())
}

fn misplaced(settings: &StageSettings, how: &str) -> StageError {
    StageError::Fault(format!("stage kind `{}` does not run {how}", settings.kind()))
}

/// Uploads a report and ends the stage with its metrics.
fn publish_report(
    cx: &mut dyn AttemptContext,
    metrics: BTreeMap<String, f64>,
    details: Value,
) -> Result<Outcome, StageError> {
    let report = json!({"metrics": metrics, "details": details});
    let meta = json!({"kind": cx.task().settings.kind(), "metrics": metrics});
    let bytes = protocol::canonical::to_bytes(&report);
    let output = artifacts::publish(cx, ArtifactKind::Report, meta, REPORT_FILE, bytes)?;
    Ok(Outcome::Finished { output, metrics })
}
