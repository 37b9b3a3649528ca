//! Implementation of each stage kind, one file per kind, and the list of them. The name, settings and outputs of a kind
//! are in its file in `protocol::stage`.

mod consistency;
mod control;
mod control_report;
mod data;
mod discord;
mod encode;
mod encode_tokens;
mod entry_draws;
mod evaluator;
mod feature_data;
mod features;
mod flow_data;
mod flow_student;
mod frequency;
mod import;
mod import_model;
mod latent_data;
mod latent_fid;
mod lcm;
mod length;
mod measured;
mod mld;
mod mmm;
mod model_decoder;
mod pcm;
mod recognition;
mod reconstruction;
mod reconstructor;
mod recordings;
mod spectrum;
mod t2m;
mod text;
mod token_data;
mod token_windows;
mod tokenizer;
mod tokens;
mod vae;

use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::Tensor;
use checkpoint::model::Drawn;
use models::flat::{self, add_gradients};
use motion::Stream;
use protocol::stage::{Split, StageSettings, Training};
use protocol::{ArtifactKind, Digest};
use serde_json::{Value, json};

use crate::artifacts;
use crate::context::{AttemptContext, GangContext, Outcome, Part, StageError, yielded};
use crate::train::{Average, Clip, GroupPlan, Losses, SliceResult, Turns};

/// File of a report's details.
pub const REPORT_FILE: &str = "report.json";

/// A kind that one worker runs alone.
trait Plain {
    /// Runs the stage.
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError>;
}

/// A kind that is divided into shards.
trait Map {
    /// Computes shard `index` of `of`.
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError>;
    /// Merges the artifacts of all shards, in order, into the stage's.
    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError>;
}

/// A kind that trains.
trait Gang {
    /// Runs one member's attempt.
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError>;
}

/// A stage in the form that its kind is run in.
enum Stage<'a> {
    Plain(&'a dyn Plain),
    Map(&'a dyn Map),
    Gang(&'a dyn Gang),
}

/// Generates [`runner`] from the list of kinds.
macro_rules! runners {
    ($($shape:ident: $($name:ident),+;)*) => {
        /// The runner of a stage with these settings; `None` for kinds that the coordinator runs itself.
        fn runner(settings: &StageSettings) -> Option<Stage<'_>> {
            match settings {
                $($(StageSettings::$name(settings) => Some(Stage::$shape(settings)),)+)*
                _ => None,
            }
        }
    };
}

// The list of implemented kinds. A test below compares it with the list of kinds in `protocol`.
runners! {
    Plain: DataOpen, DataSynthetic, ImportEvaluator, ImportModel, ModelDecoder, EvaluateSpectrum, EvaluateRecognition;
    Map: TextEmbed, DataFeatures, EncodeLatents, EncodeTokens, EvaluateReconstruction, EvaluateLatentFid, EvaluateT2m, EvaluateControl;
    Gang: TrainVae, TrainMld, DistillLcm, DistillPcm, TrainEvaluator, TrainLength, TrainTokenizer, TrainTokens, TrainDiscord, DistillDiscord,
        TrainMdm, TrainStableMoFusion, TrainControl;
}

/// Runs a plain stage.
pub fn run_alone(cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match runner(&settings) {
        Some(Stage::Plain(stage)) => yielded(stage.run(cx)),
        _ => Err(misplaced(&settings, "by one worker alone")),
    }
}

/// Runs one shard of a map stage, or merges them.
pub fn run_part(cx: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match (runner(&settings), part) {
        (Some(Stage::Map(stage)), Part::Shard { index, of }) => yielded(stage.shard(cx, index, of)),
        (Some(Stage::Map(stage)), Part::Merge { shards }) => yielded(stage.merge(cx, &shards)),
        _ => Err(misplaced(&settings, "in shards")),
    }
}

/// Runs a training stage as a member of its gang.
pub fn run_gang(cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match runner(&settings) {
        Some(Stage::Gang(stage)) => yielded(stage.run(cx)),
        _ => Err(misplaced(&settings, "by a gang")),
    }
}

/// All parameters of `module` as one group that `training` applies to in every step. Its gradient is clipped by its own
/// norm. It has a moving average with decay `ema`, unless that is 0.
fn group<M: Module>(name: &'static str, module: &M, training: &Training, ema: f64) -> GroupPlan {
    GroupPlan {
        name,
        entries: flat::layout(module),
        params: flat::read(module),
        optimizer: (&training.optimizer).into(),
        lr: training.into(),
        clip: (training.max_grad_norm > 0.0).then_some(Clip { norm: training.max_grad_norm, together: name }),
        average: (ema > 0.0).then(|| Average::of(ema)),
        turns: Turns::ALWAYS,
    }
}

/// The gradient of a slice's loss for all parameters of `module`, as a flat buffer.
fn slice_gradient<M: Module>(module: &M, loss: Tensor<1>) -> Vec<f32> {
    let mut gradients = loss.backward();
    let mut flat = vec![0.0; module.num_params()];
    add_gradients(module, &mut gradients, &mut flat);
    flat
}

/// The result of a slice that trains only `module`, on all of `losses`.
fn slice_result<M: Module>(module: &M, losses: &Losses, terms: &[&'static str]) -> Result<SliceResult, StageError> {
    let total = losses.total().ok_or_else(|| {
        StageError::Input("every weight of the loss is 0, so there is nothing to learn; set one".into())
    })?;
    let gradients = vec![slice_gradient(module, total)];
    Ok(SliceResult { gradients, terms: losses.values(terms), ..SliceResult::default() })
}

/// The dropout seed of a stage, derived from the run's seed and the stage's name.
fn dropout_seed(cx: &dyn AttemptContext) -> u64 {
    Stream::new(cx.task().seed, &format!("{}/dropout", cx.task().name), 0, 0).bits()
}

/// The name of a setting's value, such as `humanml3d` or `test`.
pub(crate) fn word(setting: &impl serde::Serialize) -> String {
    serde_json::to_value(setting).ok().and_then(|value| Some(value.as_str()?.to_owned())).unwrap_or_default()
}

/// The error for an evaluation on a split without entries.
fn no_entries(split: Split) -> StageError {
    StageError::Input(format!("the split `{}` has no entries; set `split` to one that has", word(&split)))
}

/// The error for a training split without clips.
fn no_clips() -> StageError {
    StageError::Input("the training split has no clips; list some in the dataset's `train.txt`".into())
}

fn misplaced(settings: &StageSettings, how: &str) -> StageError {
    StageError::Fault(format!("stage kind `{}` does not run {how}", settings.kind()))
}

/// The model and sampler of an evaluation, or null for real motion. Every report contains them, so that its reader
/// knows the settings of the model.
fn drawn(cx: &dyn AttemptContext) -> Result<Value, StageError> {
    let task = cx.task();
    let Some(sampler) = task.settings.sampler() else { return Ok(Value::Null) };
    let drawn = Drawn { model: artifacts::input(cx, "model", ArtifactKind::Model)?.0, sampler: sampler.clone() };
    Ok(artifacts::to_meta(&drawn))
}

/// Uploads a report and ends the stage with its metrics.
fn publish_report(
    cx: &mut dyn AttemptContext,
    metrics: BTreeMap<String, f64>,
    details: Value,
) -> Result<Outcome, StageError> {
    publish_illustrated(cx, metrics, details, vec![])
}

/// Like [`publish_report`], with pictures given as names and files.
fn publish_illustrated(
    cx: &mut dyn AttemptContext,
    metrics: BTreeMap<String, f64>,
    details: Value,
    pictures: Vec<(&str, Vec<u8>)>,
) -> Result<Outcome, StageError> {
    let report = json!({"metrics": metrics, "details": details});
    let meta = json!({"kind": cx.task().settings.kind(), "metrics": metrics, "drawn": drawn(cx)?});
    let mut draft = artifacts::Draft::new(cx, ArtifactKind::Report, meta);
    draft.add(REPORT_FILE, protocol::canonical::to_bytes(&report))?;
    for (name, bytes) in pictures {
        draft.add(name, bytes)?;
    }
    Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
}

#[cfg(test)]
mod tests {
    use protocol::stage::Shape;

    use super::*;

    #[test]
    fn every_kind_has_a_runner_of_its_shape() {
        for settings in StageSettings::all() {
            let shape = match runner(&settings) {
                Some(Stage::Plain(_)) => Shape::Plain,
                Some(Stage::Map(_)) => Shape::Map,
                Some(Stage::Gang(_)) => Shape::Gang,
                None => Shape::Registry,
            };
            assert_eq!(shape, settings.shape(), "{}", settings.kind());
        }
    }
}
