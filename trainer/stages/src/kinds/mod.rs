//! How each stage kind runs: one file a kind, and the list that finds it. What a kind is called, takes and gives is in its file in
//! `protocol::stage`.

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
use crate::context::{AttemptContext, GangContext, Outcome, Part, StageError};
use crate::train::{Average, Clip, GroupPlan, Losses, SliceResult, Turns};

/// Where a report's details are.
pub const REPORT_FILE: &str = "report.json";

/// A kind that one worker does alone.
trait Plain {
    /// Does it.
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError>;
}

/// A kind that is cut into shards.
trait Map {
    /// Does shard `index` of `of`.
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError>;
    /// Makes the stage's artifact of those of all shards, in order.
    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError>;
}

/// A kind that trains.
trait Gang {
    /// Runs one member's attempt.
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError>;
}

/// What runs a stage.
enum Stage<'a> {
    Plain(&'a dyn Plain),
    Map(&'a dyn Map),
    Gang(&'a dyn Gang),
}

/// Makes [`runner`] of the list of kinds.
macro_rules! runners {
    ($($shape:ident: $($name:ident),+;)*) => {
        /// What runs stages with these settings; nothing runs those that the coordinator does itself.
        fn runner(settings: &StageSettings) -> Option<Stage<'_>> {
            match settings {
                $($(StageSettings::$name(settings) => Some(Stage::$shape(settings)),)+)*
                _ => None,
            }
        }
    };
}

// The list of what runs. It is held against `protocol`'s list of kinds by a test below.
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
        Some(Stage::Plain(stage)) => stage.run(cx),
        _ => Err(misplaced(&settings, "by one worker alone")),
    }
}

/// Runs one shard of a map stage, or merges them.
pub fn run_part(cx: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match (runner(&settings), part) {
        (Some(Stage::Map(stage)), Part::Shard { index, of }) => stage.shard(cx, index, of),
        (Some(Stage::Map(stage)), Part::Merge { shards }) => stage.merge(cx, &shards),
        _ => Err(misplaced(&settings, "in shards")),
    }
}

/// Runs a training stage as a member of its gang.
pub fn run_gang(cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match runner(&settings) {
        Some(Stage::Gang(stage)) => stage.run(cx),
        _ => Err(misplaced(&settings, "by a gang")),
    }
}

/// All parameters of `module` as one group that every step trains as `training` says and that is clipped by its own norm, with a moving
/// average of decay `ema` beside them unless that is 0.
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

/// The gradient of a slice's loss for all parameters of `module`.
fn slice_gradient<M: Module>(module: &M, loss: Tensor<1>) -> Vec<f32> {
    let mut gradients = loss.backward();
    let mut flat = vec![0.0; module.num_params()];
    add_gradients(module, &mut gradients, &mut flat);
    flat
}

/// What a slice gives that trains `module` alone, on all of `losses`.
fn slice_result<M: Module>(module: &M, losses: &Losses, terms: &[&'static str]) -> Result<SliceResult, StageError> {
    let total = losses.total().ok_or_else(|| {
        StageError::Input("every weight of the loss is 0, so there is nothing to learn; set one".into())
    })?;
    let gradients = vec![slice_gradient(module, total)];
    Ok(SliceResult { gradients, terms: losses.values(terms), ..SliceResult::default() })
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

/// Which model an evaluation measured, and how it drew from it; nothing of real motion. A report says this, so that a reader who has the
/// report of a model knows how to draw from the model.
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

/// [`publish_report`] with pictures beside it: their names and files.
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
