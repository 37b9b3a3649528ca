//! Models as evaluation, `generate`, `time` and registering know them: captions, lengths and seeds in, motions out.
//!
//! A model is opened from its artifact alone, by the generator that its manifest names; which parts there are and what they are is the
//! generator's own matter. To add one: a file here that implements [`MotionGenerator`], and a line in the table of [`open`].

mod latent_diffusion;
mod tokens;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use motion::Stream;
use protocol::stage::{DataFormat, Family, LatentShape, Sampler};
use protocol::{Digest, Manifest};

use crate::context::StageError;
use crate::parts::model_error;
use crate::text::TextEncoder;

pub(crate) use latent_diffusion::NAME as LATENT_DIFFUSION;
pub(crate) use tokens::{GeneratorMeta, MASKED_PREFIX, NAME as TOKENS, RESIDUAL_PREFIX};

/// A caption as a generator wants it: what it asked its text encoder for.
#[derive(Debug, Clone, PartialEq)]
pub struct Text {
    /// The caption's one vector, or a vector for each of its tokens.
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
}

impl std::fmt::Debug for Batch<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Batch").field("lengths", &self.lengths).finish_non_exhaustive()
    }
}

/// What has just been done, for whoever takes the time.
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
    /// decides on its own. The lengths and the sampler are ones that it has; [`motions`] sees to that.
    fn draw(&self, batch: Batch<'_>, sampler: &Sampler, lap: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError>;

    /// The way to its latents, if it draws motion from such.
    fn latents(&self) -> Option<&dyn LatentGenerator> {
        None
    }
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

/// Opens a generator with the parts of a model.
type Open = fn(&Model, &dyn Blobs, &Device) -> Result<Box<dyn MotionGenerator>, StageError>;

/// Every generator by its name in manifests.
const GENERATORS: [(&str, Open); 2] = [(LATENT_DIFFUSION, latent_diffusion::open), (TOKENS, tokens::open)];

/// The generator of an artifact of kind `model`.
pub fn open(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn MotionGenerator>, StageError> {
    let model = Model::read(manifest).map_err(model_error)?;
    let Some((_, open)) = GENERATORS.iter().find(|(name, _)| *name == model.generator) else {
        let have: Vec<&str> = GENERATORS.iter().map(|(name, _)| *name).collect();
        let wanted = &model.generator;
        return Err(StageError::Input(format!(
            "generator `{wanted}` is not in this build, which has {}",
            have.join(", ")
        )));
    };
    let generator = open(&model, blobs, device)?;
    if generator.format() != model.format {
        let (found, said) = (generator.format().name(), model.format.name());
        return Err(StageError::Input(format!(
            "the model's parts draw motions of `{found}`, its manifest says `{said}`"
        )));
    }
    Ok(generator)
}

/// Refuses a sampler that the model does not have.
pub fn check_sampler(generator: &dyn MotionGenerator, sampler: &Sampler) -> Result<(), StageError> {
    generator.family().accepts(sampler).map_err(StageError::Input)
}

/// A motion for each of the batch, feature rows `[frames, features]` in the data's own scale.
///
/// # Errors
/// A sampler or a length that the model does not have, or motions that are not finite.
pub fn motions(
    generator: &dyn MotionGenerator,
    batch: Batch<'_>,
    sampler: &Sampler,
    lap: &mut dyn FnMut(Lap),
) -> Result<Vec<Vec<f32>>, StageError> {
    check_sampler(generator, sampler)?;
    let longest = generator.longest();
    if let Some(frames) = batch.lengths.iter().find(|frames| !(1..=longest).contains(*frames)) {
        return Err(StageError::Input(format!("{frames} frames: the model draws motions of 1 to {longest}")));
    }
    let motions = generator.draw(batch, sampler, lap)?;
    if !motions.iter().flatten().all(|v| v.is_finite()) {
        return Err(StageError::Input("the motion is not finite; the model has not been trained well".into()));
    }
    Ok(motions)
}

/// The captions of a dataset as a generator wants them, each embedded once.
#[derive(Debug)]
pub(crate) struct Texts<'a> {
    generator: &'a dyn MotionGenerator,
    known: RefCell<BTreeMap<usize, Rc<Text>>>,
}

impl<'a> Texts<'a> {
    pub(crate) fn new(generator: &'a dyn MotionGenerator) -> Self {
        Self { generator, known: RefCell::default() }
    }

    /// Captions by number; `text` gives one's words.
    pub(crate) fn get<'t>(
        &self,
        numbers: &[usize],
        text: impl Fn(usize) -> &'t str,
    ) -> Result<Vec<Rc<Text>>, StageError> {
        let mut known = self.known.borrow_mut();
        let mut new: Vec<usize> = numbers.iter().copied().filter(|number| !known.contains_key(number)).collect();
        new.sort_unstable();
        new.dedup();
        let words: Vec<&str> = new.iter().map(|number| text(*number)).collect();
        let embedded = self.generator.embed(&words)?;
        known.extend(new.into_iter().zip(embedded.into_iter().map(Rc::new)));
        Ok(numbers.iter().map(|number| Rc::clone(&known[number])).collect())
    }
}
