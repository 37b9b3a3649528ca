//! A loaded model with its own defaults.

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use motion::Stream;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, Family, Sampler};
use protocol::{ArtifactKind, Manifest, Seed};

use super::generator::{self, MotionGenerator};
use crate::context::StageError;
use crate::parts::control::ControlMeta;
use crate::parts::length::Lengths;
use crate::parts::{self, model_error};

/// Default length of a motion if neither the user nor the model sets one: 6 seconds of HumanML3D, 9.6 of KIT-ML, near
/// the mean length of their clips.
pub const DEFAULT_FRAMES: usize = 120;

/// A loaded model with its own defaults: a sampler, a length.
#[derive(Debug)]
pub struct Generator {
    pub(super) model: Box<dyn MotionGenerator>,
    pub(super) lengths: Option<Lengths>,
    pub(super) sampler: Option<Sampler>,
}

impl Generator {
    /// Loads an artifact of kind `model`.
    pub fn load(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Self, StageError> {
        let parts = Model::read(manifest).map_err(model_error)?;
        let model = generator::open(manifest, blobs, device)?;
        let lengths = match parts.parts.contains_key(&Role::LENGTH) {
            true => {
                let part = parts::part(blobs, &parts, &Role::LENGTH, ArtifactKind::Length)?;
                Some(Lengths::read(blobs, &part, device)?)
            }
            false => None,
        };
        if let Some(lengths) = &lengths
            && (lengths.meta().format, lengths.meta().text_dim) != (model.format(), model.text().dim())
        {
            return Err(StageError::Input(
                "the model's length estimator was trained on another format or another text encoder".into(),
            ));
        }
        Ok(Self { model, lengths, sampler: parts.sampler })
    }

    /// Wraps a model that was not loaded from a file.
    #[cfg(test)]
    pub(crate) fn of(model: Box<dyn MotionGenerator>) -> Self {
        Self { model, lengths: None, sampler: None }
    }

    /// The default sampler: that of the model's evaluation, or that of the papers for its kind if it has none.
    pub fn sampler(&self) -> Sampler {
        self.sampler.clone().unwrap_or_else(|| self.model.family().published())
    }

    /// Returns the family of the model, which says what it was trained to do.
    pub fn family(&self) -> &Family {
        self.model.family()
    }

    /// Refuses a sampler that the model does not have.
    pub fn check_sampler(&self, sampler: &Sampler) -> Result<(), StageError> {
        generator::check_sampler(&*self.model, sampler)
    }

    /// The skeleton of its motions.
    pub fn format(&self) -> DataFormat {
        self.model.format()
    }

    /// The default length for `prompt`: a draw of the model's length estimator, or [`DEFAULT_FRAMES`] without one.
    pub fn frames(&self, prompt: &str, seed: Seed) -> Result<usize, StageError> {
        let Some(lengths) = &self.lengths else { return Ok(DEFAULT_FRAMES) };
        let pooled = self.model.text().pooled(&[prompt])?;
        let drawn = lengths.draw(&pooled, &mut Stream::new(seed, "generate/length", 0, 0));
        Ok(drawn.min(self.model.longest()))
    }

    /// Frames of a unit that [`edit`](Self::edit) keeps or regenerates; `None` if the model generates only whole
    /// motions.
    pub fn infilling_unit(&self) -> Option<usize> {
        self.model.infilling().map(|infilling| infilling.unit())
    }

    /// Returns true if the text encoder recognises a word of `prompt`. Otherwise the result is the same as for an empty
    /// prompt: the built-in encoder has only words of Latin letters and digits.
    pub fn knows(&self, prompt: &str) -> Result<bool, StageError> {
        let texts = self.model.embed(&[prompt, ""])?;
        Ok(texts[0] != texts[1])
    }

    /// The meta of the control part, if the model has one.
    pub fn control(&self) -> Option<&ControlMeta> {
        self.model.control()
    }

    /// Frames of the longest motion that the model generates.
    pub fn longest(&self) -> usize {
        self.model.longest()
    }
}
