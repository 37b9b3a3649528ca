//! What a generator is asked.

use std::rc::Rc;

use motion::Stream;
use protocol::Digest;
use protocol::stage::{DataFormat, Family, LatentShape, Sampler};

use crate::context::StageError;
use crate::control::{ControlMeta, Heed};
use crate::hint::Hint;
use crate::text::TextEncoder;

/// A caption as a generator wants it: what it asked its text encoder for.
#[derive(Debug, Clone, PartialEq)]
pub struct Text {
    /// The caption's one vector, a vector for each of its tokens, or both, the caption's first.
    pub values: Vec<f32>,
}

/// The `k`-th stream of random numbers of motion `b` of a batch. Stream 0 is the noise that a motion starts from.
pub type Seeds<'a> = dyn Fn(usize, usize) -> Stream + 'a;

/// What motions are drawn for, one of each for every motion.
#[derive(Clone, Copy)]
pub struct Batch<'a> {
    /// Captions.
    pub texts: &'a [Rc<Text>],
    /// Frames.
    pub lengths: &'a [usize],
    /// What keys the draws: motions depend on nothing else that is random.
    pub seeds: &'a Seeds<'a>,
    /// Positions that the motions should pass.
    pub control: Option<ControlRequest<'a>>,
}

/// Positions that the motions of a batch should pass.
#[derive(Debug, Clone, Copy)]
pub struct ControlRequest<'a> {
    /// For each motion, as long as it.
    pub hints: &'a [Hint],
    /// How they are heeded.
    pub heed: Heed,
}

impl std::fmt::Debug for Batch<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Batch").field("lengths", &self.lengths).finish_non_exhaustive()
    }
}

/// What has just been done, for a caller that takes the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lap {
    /// The sampler is through.
    Sampled,
    /// What it drew is motion.
    Decoded,
}

/// A model that is ready to draw motions.
pub trait MotionGenerator: std::fmt::Debug {
    /// The skeleton of its motions.
    fn format(&self) -> DataFormat;

    /// Frames of the longest motion that it draws.
    fn longest(&self) -> usize;

    /// What it was trained to do, and so which samplers it has.
    fn family(&self) -> &Family;

    /// What its captions are embedded with.
    fn text(&self) -> &dyn TextEncoder;

    /// Captions as it wants them.
    fn embed(&self, captions: &[&str]) -> Result<Vec<Text>, StageError>;

    /// A motion for each of the batch, feature rows `[frames, features]` in the data's own scale, of the length asked for unless the model
    /// decides on its own. The lengths and the sampler are ones that it has; [`motions`](super::motions) sees to that.
    fn draw(&self, batch: Batch<'_>, sampler: &Sampler, lap: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError>;

    /// What a denoising model takes the clean motion for in each step of the sampler, with the step's timestep, the last step last: of a batch of one motion.
    fn predictions(&self, _: Batch<'_>, _: &Sampler) -> Result<Vec<(usize, Vec<f32>)>, StageError> {
        Err(StageError::Input("the model draws without denoising, so that it has no steps to look at".into()))
    }

    /// Its control part, if it has one, without which a batch has no `control`.
    fn control(&self) -> Option<&ControlMeta> {
        None
    }

    /// The way to its latents, if it draws motion from such.
    fn latents(&self) -> Option<&dyn LatentGenerator> {
        None
    }

    /// How it fills in a part of a motion, if it can.
    fn infilling(&self) -> Option<&dyn Infilling> {
        None
    }
}

/// A motion of which a part stays.
#[derive(Debug, Clone, Copy)]
pub struct Edit<'a> {
    /// Feature rows `[frames, features]` in the data's own scale, as many as the pieces have.
    pub motion: &'a [f32],
    /// Whether each piece stays.
    pub kept: &'a [bool],
}

/// A generator that draws a part of a motion so that it fits the rest.
pub trait Infilling {
    /// Frames of a piece, which stays or is drawn as a whole.
    fn unit(&self) -> usize;

    /// The motion with the pieces drawn anew that do not stay. What stays is decoded with them, so its frames change a little where the two meet.
    /// The sampler is one that the model has.
    fn fill_in(
        &self,
        edit: Edit<'_>,
        text: &Rc<Text>,
        seeds: &Seeds<'_>,
        sampler: &Sampler,
        lap: &mut dyn FnMut(Lap),
    ) -> Vec<f32>;
}

/// A generator that draws latents and decodes them.
pub trait LatentGenerator {
    /// The shape of a latent.
    fn shape(&self) -> LatentShape;

    /// The VAE whose latents they are.
    fn vae(&self) -> Digest;

    /// Latents `[batch, N, d]`.
    fn sample(&self, texts: &[Rc<Text>], seeds: &Seeds<'_>, sampler: &Sampler) -> Result<Vec<f32>, StageError>;
}
