//! Models as evaluation, `generate`, `time` and registration use them: captions, lengths and seeds in, motions out.
//!
//! A model is opened from its artifact alone, by the generator that its manifest names. The generator decides which
//! parts the model needs. To add one: a file here that implements [`MotionGenerator`], and a line in the table of
//! [`open`].

mod feature_diffusion;
mod interface;
mod latent_diffusion;
mod mmm_condition;
mod tokens;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use motion::{Skeleton, footing};
use protocol::Manifest;
use protocol::stage::Sampler;

use crate::context::StageError;
use crate::parts::hint::Hint;
use crate::parts::model_error;

pub(crate) use feature_diffusion::NAME as FEATURE_DIFFUSION;
pub use interface::{Batch, ControlRequest, Edit, Infilling, Lap, LatentGenerator, MotionGenerator, Seeds, Text};
pub(crate) use latent_diffusion::NAME as LATENT_DIFFUSION;
pub(crate) use mmm_condition::{codebook, with_words};
pub(crate) use tokens::{GeneratorMeta, MASKED_PREFIX, NAME as TOKENS, RESIDUAL_PREFIX};

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

/// Refuses a sampler that the model does not have.
pub fn check_sampler(generator: &dyn MotionGenerator, sampler: &Sampler) -> Result<(), StageError> {
    generator.family().accepts(sampler).map_err(StageError::Input)
}

/// Generates feature rows `[frames, features]` in the data's own scale for each motion of the batch.
///
/// # Errors
/// If the model lacks the sampler, the length or the control part, or a motion is not finite.
pub fn motions(
    generator: &dyn MotionGenerator,
    batch: Batch<'_>,
    sampler: &Sampler,
    lap: &mut dyn FnMut(Lap),
) -> Result<Vec<Vec<f32>>, StageError> {
    check_sampler(generator, sampler)?;
    let longest = generator.longest();
    if let Some(frames) = batch.lengths.iter().find(|frames| !(1..=longest).contains(*frames)) {
        return Err(StageError::Input(format!(
            "a motion of {frames} frames was requested; the model generates 1 to {longest} frames"
        )));
    }
    if let Some(control) = batch.control {
        let Some(meta) = generator.control() else {
            return Err(StageError::Input("the model has no control part, so it cannot follow a path".into()));
        };
        let joints = meta.mean.len() / 3;
        let fits = |(hint, frames): (&Hint, &usize)| (hint.frames(), hint.joints()) == (*frames, joints);
        if control.hints.len() != batch.lengths.len() || !control.hints.iter().zip(batch.lengths).all(fits) {
            return Err(StageError::Fault("the hints do not match the requested motions".into()));
        }
    }
    let mut motions = generator.draw(batch, sampler, lap)?;
    finite(motions.iter().flatten())?;
    if sampler.footing && batch.control.is_none() {
        motions.iter_mut().for_each(|motion| footing::hold(motion, Skeleton::of(generator.format())));
        lap(Lap::Decoded);
    }
    Ok(motions)
}

fn finite<'v>(mut values: impl Iterator<Item = &'v f32>) -> Result<(), StageError> {
    match values.all(|v| v.is_finite()) {
        true => Ok(()),
        false => Err(StageError::Input(
            "the motion has numbers that are not finite; the model is not trained well enough".into(),
        )),
    }
}

/// The in-filling of a model.
///
/// # Errors
/// If the model does not support it.
pub fn infilling(generator: &dyn MotionGenerator) -> Result<&dyn Infilling, StageError> {
    generator.infilling().ok_or_else(|| {
        StageError::Input(
            "the model cannot regenerate part of a motion; only masked token generators (MoMask, MMM) can".into(),
        )
    })
}

/// Regenerates the units of a motion that are not kept.
///
/// # Errors
/// If the model does not support in-filling, the sampler or the length, or the motion is not finite.
pub fn edited(
    generator: &dyn MotionGenerator,
    edit: Edit<'_>,
    text: &Rc<Text>,
    seeds: &Seeds<'_>,
    sampler: &Sampler,
    lap: &mut dyn FnMut(Lap),
) -> Result<Vec<f32>, StageError> {
    check_sampler(generator, sampler)?;
    let model = infilling(generator)?;
    let frames = edit.kept.len() * model.unit();
    let longest = generator.longest();
    if !(1..=longest).contains(&frames) {
        return Err(StageError::Input(format!(
            "a motion of {frames} frames was requested; the model generates 1 to {longest} frames"
        )));
    }
    let motion = model.fill_in(edit, text, seeds, sampler, lap);
    finite(motion.iter())?;
    Ok(motion)
}

/// The captions of a dataset in the generator's form, each embedded once.
#[derive(Debug)]
pub(crate) struct Texts<'a> {
    generator: &'a dyn MotionGenerator,
    known: RefCell<BTreeMap<usize, Rc<Text>>>,
}

impl<'a> Texts<'a> {
    pub(crate) fn new(generator: &'a dyn MotionGenerator) -> Self {
        Self { generator, known: RefCell::default() }
    }

    /// Embeds captions by index; `text` returns the words of one.
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
