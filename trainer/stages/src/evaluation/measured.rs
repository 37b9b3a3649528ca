//! Inputs of the evaluations that sample: the clips, and the model to be measured.

use motion::Dataset;
use protocol::stage::{DataFormat, Sampler};
use protocol::{ArtifactKind, Manifest};

use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::generate::generator::{self, MotionGenerator};

/// Opens the inputs `dataset` and `model` of an evaluation with `sampler`.
///
/// # Errors
/// As [`model`].
pub(crate) fn measured(
    cx: &dyn AttemptContext,
    sampler: &Sampler,
) -> Result<(Dataset, Box<dyn MotionGenerator>), StageError> {
    let dataset = artifacts::input_dataset(cx)?;
    let (_, model) = model(cx, dataset.format, sampler)?;
    Ok((dataset, model))
}

/// Opens the model to be measured on clips of `format`, and returns its manifest too.
///
/// # Errors
/// If the model has another skeleton, or does not support the sampler.
pub(crate) fn model(
    cx: &dyn AttemptContext,
    format: DataFormat,
    sampler: &Sampler,
) -> Result<(Manifest, Box<dyn MotionGenerator>), StageError> {
    let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
    let model = generator::open(&manifest, &*cx.blobs(), &cx.device())?;
    if model.format() != format {
        return Err(StageError::Input(format!(
            "`model` generates motions in format `{}`, but the dataset has format `{}`; use a dataset in the model's format",
            model.format().name(),
            format.name()
        )));
    }
    generator::check_sampler(&*model, sampler)?;
    Ok((manifest, model))
}
