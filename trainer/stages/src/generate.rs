//! From a sentence to a motion, with a registered model.
//!
//! Not a stage: nothing is kept, and the clock is read, because the time per sentence is what few-step models are about. The
//! motion is a function of (model, sentence, frames, sampler, seed).

use std::time::Instant;

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::bundle::{DENOISER_FILE, VAE_FILE};
use motion::features::recover_joints;
use motion::{Skeleton, Stream};
use protocol::stage::{DataFormat, Sampler};
use protocol::{ArtifactKind, Manifest, Seed};
use serde::Deserialize;

use crate::artifacts::{self, DenoiserMeta, VaeMeta};
use crate::context::StageError;
use crate::kinds::text::embed;
use crate::networks::{Autoencoder, Conditions, Denoiser};
use crate::timing::Timing;

/// Length of a motion when nobody says: 6 seconds of HumanML3D, 9.6 of KIT-ML, near the mean length of their clips.
pub const DEFAULT_FRAMES: usize = 120;

/// Meta of a registered model, as [`checkpoint::bundle`] writes it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct ModelMeta {
    denoiser: DenoiserMeta,
    vae: VaeMeta,
    sampler: Sampler,
}

/// A model that is ready to draw motions.
#[derive(Debug)]
pub struct Generator {
    vae: Autoencoder,
    denoiser: Denoiser,
    sampler: Sampler,
    null: Vec<f32>,
}

/// A motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Generated {
    /// Feature rows `[frames, features]` in the data's own scale.
    pub features: Vec<f32>,
    /// Global joints `[frames, joints, 3]` in the data's unit.
    pub joints: Vec<f32>,
    /// Frames.
    pub frames: usize,
    /// Which skeleton.
    pub format: DataFormat,
    /// Where the time went.
    pub timing: Timing,
}

impl Generator {
    /// Loads an artifact of kind `model`.
    pub fn load(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Self, StageError> {
        if manifest.kind != ArtifactKind::Model {
            let kind = manifest.kind;
            return Err(StageError::Input(format!("an artifact of kind {kind:?} cannot generate; expected a model")));
        }
        let meta: ModelMeta = artifacts::meta(manifest, "the model")?;
        let vae = Autoencoder::load(meta.vae, &artifacts::file(blobs, manifest, VAE_FILE)?, device)?;
        let null = embed(&meta.denoiser.encoder, "")?;
        let denoiser = Denoiser::load(meta.denoiser, &artifacts::file(blobs, manifest, DENOISER_FILE)?, device)?;
        Ok(Self { vae, denoiser, sampler: meta.sampler, null })
    }

    /// How motions are drawn when nobody says.
    pub fn sampler(&self) -> &Sampler {
        &self.sampler
    }

    /// Refuses a sampler that the model does not have.
    pub fn check_sampler(&self, sampler: &Sampler) -> Result<(), StageError> {
        self.denoiser.check_sampler(sampler)
    }

    /// Which skeleton its motions have.
    pub fn format(&self) -> DataFormat {
        self.vae.meta().format
    }

    /// Draws a motion for `prompt`. Without `frames` it has [`DEFAULT_FRAMES`], without `sampler` the model's own is used.
    pub fn generate(
        &self,
        prompt: &str,
        frames: Option<usize>,
        sampler: Option<&Sampler>,
        seed: Seed,
    ) -> Result<Generated, StageError> {
        let frames = frames.unwrap_or(DEFAULT_FRAMES);
        let sampler = sampler.unwrap_or(&self.sampler);
        let longest = self.vae.max_frames();
        if !(1..=longest).contains(&frames) {
            return Err(StageError::Input(format!(
                "{frames} frames: expected 1 to {longest}, which the VAE has positions for"
            )));
        }
        self.denoiser.check_sampler(sampler)?;

        let start = Instant::now();
        let text = embed(&self.denoiser.meta().encoder, prompt)?;
        let embedded = Instant::now();
        let latent = self.denoiser.meta().latent;
        let normal = |index: u64| {
            let mut noise = vec![0.0; latent.tokens * latent.dim];
            Stream::new(seed, "generate/noise", 0, index).fill_normal(&mut noise);
            noise
        };
        let conditions = Conditions { text, null: self.null.clone(), noise: normal(0) };
        let z = self.denoiser.sample(&conditions, sampler, &mut |step| normal(1 + step as u64))?;
        let sampled = Instant::now();
        let mut features = self.vae.decode(z, frames);
        self.vae.denormalise(&mut features);
        let decoded = Instant::now();

        if !features.iter().all(|v| v.is_finite()) {
            return Err(StageError::Input("the motion is not finite; the model has not been trained well".into()));
        }
        let joints = recover_joints(&features, Skeleton::of(self.format()));
        let timing = Timing { text: embedded - start, sampling: sampled - embedded, decoding: decoded - sampled };
        Ok(Generated { features, joints, frames, format: self.format(), timing })
    }
}
