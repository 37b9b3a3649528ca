//! The interface of motion generators.

use std::rc::Rc;

use motion::Stream;
use protocol::Digest;
use protocol::stage::{DataFormat, Family, LatentShape, Sampler};

use crate::context::StageError;
use crate::parts::control::{ControlMeta, ControlOptions};
use crate::parts::hint::Hint;
use crate::parts::text::TextEncoder;

/// A caption in the form that a generator requested from its text encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct Text {
    /// The caption's vector, a vector for each of its tokens, or both, with the caption's first.
    pub values: Vec<f32>,
}

/// Returns the `k`-th stream of random numbers of motion `b` of a batch. Stream 0 is the motion's initial noise.
pub type Seeds<'a> = dyn Fn(usize, usize) -> Stream + 'a;

/// Conditions of a batch, one of each per motion.
#[derive(Clone, Copy)]
pub struct Batch<'a> {
    pub texts: &'a [Rc<Text>],
    /// Number of frames of each motion.
    pub lengths: &'a [usize],
    /// Streams of the draws: motions depend on no other random numbers.
    pub seeds: &'a Seeds<'a>,
    /// Target positions of the motions.
    pub control: Option<ControlRequest<'a>>,
}

/// Target positions for the motions of a batch.
#[derive(Debug, Clone, Copy)]
pub struct ControlRequest<'a> {
    /// A hint for each motion, of the motion's length.
    pub hints: &'a [Hint],
    /// Strength of the steering.
    pub options: ControlOptions,
}

impl std::fmt::Debug for Batch<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Batch").field("lengths", &self.lengths).finish_non_exhaustive()
    }
}

/// Phase that just ended, for a caller that measures time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lap {
    /// The sampler is done.
    Sampled,
    /// The sample is decoded to motion.
    Decoded,
}

/// A loaded model that generates motions.
pub trait MotionGenerator: std::fmt::Debug {
    /// The skeleton of its motions.
    fn format(&self) -> DataFormat;

    /// Frames of the longest motion that the model generates.
    fn longest(&self) -> usize;

    /// Family of the model, which decides its samplers.
    fn family(&self) -> &Family;

    /// Encoder of its captions.
    fn text(&self) -> &dyn TextEncoder;

    /// Embeds captions in the form that the model reads.
    fn embed(&self, captions: &[&str]) -> Result<Vec<Text>, StageError>;

    /// Generates feature rows `[frames, features]` in the data's own scale for each motion of the batch. They have the
    /// requested length unless the model decides it. [`motions`](super::motions) checks that the model supports the
    /// lengths and the sampler.
    fn draw(&self, batch: Batch<'_>, sampler: &Sampler, lap: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError>;

    /// A denoising model's estimates of the clean motion in all steps of the sampler, with their timesteps, for a batch
    /// of one motion.
    fn predictions(&self, _: Batch<'_>, _: &Sampler) -> Result<Vec<(usize, Vec<f32>)>, StageError> {
        Err(StageError::Input("the model generates motion without denoising; it has no steps to measure".into()))
    }

    /// Meta of the control part; without one a batch has no `control`.
    fn control(&self) -> Option<&ControlMeta> {
        None
    }

    /// Encodes feature rows `[frames, features]` in the data's own scale and decodes them, as far as the model decodes
    /// motion at all. Frames beyond the longest motion or the last whole unit are left out.
    fn reconstruct(&self, rows: &[f32], _noise: &mut Stream) -> Vec<f32> {
        rows.to_vec()
    }

    /// Access to the latents, if the model generates motion from latents.
    fn latents(&self) -> Option<&dyn LatentGenerator> {
        None
    }

    /// The in-filling of the model, if it supports it.
    fn infilling(&self) -> Option<&dyn Infilling> {
        None
    }
}

/// A motion to be regenerated in part.
#[derive(Debug, Clone, Copy)]
pub struct Edit<'a> {
    /// Feature rows `[frames, features]` in the data's own scale, a whole number of units.
    pub motion: &'a [f32],
    /// True for each unit that is kept.
    pub kept: &'a [bool],
}

/// A generator that regenerates a part of a motion to fit the rest.
pub trait Infilling {
    /// Frames of a unit, which is kept or regenerated as a whole.
    fn unit(&self) -> usize;

    /// Regenerates the units that are not kept. Kept units are decoded with them, so their frames change slightly at
    /// the borders. The sampler must be one of the model's.
    fn fill_in(
        &self,
        edit: Edit<'_>,
        text: &Rc<Text>,
        seeds: &Seeds<'_>,
        sampler: &Sampler,
        lap: &mut dyn FnMut(Lap),
    ) -> Vec<f32>;
}

/// A generator that samples latents and decodes them.
pub trait LatentGenerator {
    /// The shape of a latent.
    fn shape(&self) -> LatentShape;

    /// Digest of the VAE of the latents.
    fn vae(&self) -> Digest;

    /// Samples latents `[batch, N, d]`.
    fn sample(&self, texts: &[Rc<Text>], seeds: &Seeds<'_>, sampler: &Sampler) -> Result<Vec<f32>, StageError>;
}
