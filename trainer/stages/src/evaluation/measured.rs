//! Inputs of the evaluations that sample: the clips, and the model to be measured.

use motion::Dataset;
use protocol::ArtifactKind;
use protocol::stage::Sampler;

use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::generate::generator::{self, MotionGenerator};

/// Opens the inputs `dataset` and `model` of an evaluation with `sampler`.
///
/// # Errors
/// If the model has another skeleton, or does not support the sampler.
pub(crate) fn measured(
    cx: &dyn AttemptContext,
    sampler: &Sampler,
) -> Result<(Dataset, Box<dyn MotionGenerator>), StageError> {
    let blobs = cx.blobs();
    let dataset = artifacts::input_dataset(cx)?;
    let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
    let model = generator::open(&manifest, &*blobs, &cx.device())?;
    generator::check_sampler(&*model, sampler)?;
    if model.format() != dataset.format {
        return Err(StageError::Input("`model` and `dataset` have different skeletons".into()));
    }
    Ok((dataset, model))
}
