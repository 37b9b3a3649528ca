//! The table of generators, by their names in manifests.

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use protocol::Manifest;

use super::feature_diffusion::{self, NAME as FEATURE_DIFFUSION};
use super::interface::MotionGenerator;
use super::latent_diffusion::{self, NAME as LATENT_DIFFUSION};
use super::tokens::{self, NAME as TOKENS};
use crate::context::StageError;
use crate::parts::model_error;

/// Opens a generator with the parts of a model.
type Open = fn(&Model, &dyn Blobs, &Device) -> Result<Box<dyn MotionGenerator>, StageError>;

/// Every generator by its name in manifests.
const GENERATORS: [(&str, Open); 3] =
    [(LATENT_DIFFUSION, latent_diffusion::open), (FEATURE_DIFFUSION, feature_diffusion::open), (TOKENS, tokens::open)];

/// Opens the generator of an artifact of kind `model`.
pub fn open(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn MotionGenerator>, StageError> {
    let model = Model::read(manifest).map_err(model_error)?;
    let Some((_, open)) = GENERATORS.iter().find(|(name, _)| *name == model.generator) else {
        let have: Vec<&str> = GENERATORS.iter().map(|(name, _)| *name).collect();
        let wanted = &model.generator;
        return Err(StageError::Input(format!("this build has no generator `{wanted}`; it has {}", have.join(", "))));
    };
    let generator = open(&model, blobs, device)?;
    if generator.format() != model.format {
        let found = generator.format().name();
        let said = model.format.name();
        return Err(StageError::Input(format!(
            "the model's parts generate motions in format `{found}`, but its manifest declares `{said}`"
        )));
    }
    Ok(generator)
}
