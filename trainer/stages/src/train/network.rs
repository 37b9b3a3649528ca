//! A network in a training: its parameters as a group, and the gradient of a slice's loss.

use burn::module::Module;
use models::flat;
use motion::Stream;
use protocol::stage::Training;

use super::{Average, Clip, GroupPlan, Losses, SliceResult, Turns};
use crate::context::{AttemptContext, StageError};

/// All parameters of `module` as one group that `training` applies to in every step. Its gradient is clipped by its own
/// norm. It has a moving average with decay `ema`, unless that is 0.
pub(crate) fn group<M: Module>(name: &'static str, module: &M, training: &Training, ema: f64) -> GroupPlan {
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

/// The result of a slice that trains only `module`, on all of `losses`.
pub(crate) fn slice_result<M: Module>(
    module: &M,
    losses: &Losses,
    terms: &[&'static str],
) -> Result<SliceResult, StageError> {
    let total = losses.total().ok_or_else(|| {
        StageError::Input("every weight of the loss is 0, so nothing is learned; set at least one above 0".into())
    })?;
    let gradients = vec![flat::gradient(module, total)];
    Ok(SliceResult { gradients, terms: losses.values(terms), ..SliceResult::default() })
}

/// The dropout seed of a stage, derived from the run's seed and the stage's name.
pub(crate) fn dropout_seed(cx: &dyn AttemptContext) -> u64 {
    Stream::new(cx.task().seed, &format!("{}/dropout", cx.task().name), 0, 0).bits()
}

/// The error for a training split without clips.
pub(crate) fn no_clips() -> StageError {
    StageError::Input("the training split has no clips; list some in the dataset's `train.txt`".into())
}
