//! Source of the measured motions: a model, or reconstructions of real ones.

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use motion::Stream;
use protocol::ArtifactKind;
use protocol::artifact::Role;

use super::plan::{Draw, Plan};
use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::evaluation::reconstructor::Reconstructor;
use crate::generate::generator::{self, Batch, MotionGenerator, Texts};
use crate::parts::length::Lengths;
use crate::parts::model_error;

/// Source of the motions.
#[expect(clippy::large_enum_variant, reason = "there is one of it")]
pub(super) enum Source {
    /// The clips themselves.
    Real,
    /// Reconstructions of the clips by a VAE or a tokenizer.
    Reconstructed(Reconstructor),
    /// Motions of a model.
    Generated(Generated),
}

/// A model, and the length estimator if it replaces the clips' lengths.
pub(super) struct Generated {
    model: Box<dyn MotionGenerator>,
    lengths: Option<Lengths>,
}

impl Source {
    pub(super) fn open(cx: &dyn AttemptContext, plan: &Plan<'_>) -> Result<Self, StageError> {
        if plan.settings.real {
            return Ok(Self::Real);
        }
        if plan.settings.reconstructs() {
            let reconstructor = Reconstructor::read(cx, 0)?;
            reconstructor.check_format(plan.dataset.format)?;
            return Ok(Self::Reconstructed(reconstructor));
        }
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let (blobs, device) = (cx.blobs(), cx.device());
        let model = generator::open(&manifest, &*blobs, &device)?;
        let (ours, theirs) = (model.format(), plan.dataset.format);
        if ours != theirs {
            return Err(StageError::Input(format!(
                "`model` generates motions in format `{}`, but the dataset has format `{}`; use a dataset in the \
                 model's format",
                ours.name(),
                theirs.name()
            )));
        }
        generator::check_sampler(&*model, &plan.settings.sampler)?;
        let parts = Model::read(&manifest).map_err(model_error)?;
        let lengths = lengths(cx, &parts, &*blobs, &device)?;
        Ok(Self::Generated(Generated { model, lengths }))
    }
}

/// Opens the estimator of the input `length`, and checks that it reads the embeddings of the model's captions.
fn lengths(
    cx: &dyn AttemptContext,
    model: &Model,
    blobs: &dyn Blobs,
    device: &Device,
) -> Result<Option<Lengths>, StageError> {
    if !cx.task().inputs.contains_key("length") {
        return Ok(None);
    }
    let (_, manifest) = artifacts::input(cx, "length", ArtifactKind::Length)?;
    let lengths = Lengths::read(blobs, &manifest, device)?;
    let meta = lengths.meta();
    if meta.format != model.format {
        return Err(StageError::Input(format!(
            "`length` was trained on motions in format `{}`, but `model` generates `{}`",
            meta.format.name(),
            model.format.name()
        )));
    }
    if meta.fits.get(&Role::TEXT) != model.parts.get(&Role::TEXT) {
        let text =
            "`length` and `model` have different text encoders; train `length` with the model's `text.embed` stage";
        return Err(StageError::Input(text.into()));
    }
    Ok(Some(lengths))
}

/// A model with the captions embedded so far.
pub(super) struct Maker<'a> {
    generated: &'a Generated,
    texts: Texts<'a>,
}

impl<'a> Maker<'a> {
    pub(super) fn new(generated: &'a Generated) -> Self {
        Self { generated, texts: Texts::new(&*generated.model) }
    }

    /// Generates a motion for each draw, in the data's own scale. `seeds(k, b)` is the k-th stream of motion b, 0 for
    /// the sampler's initial noise.
    pub(super) fn motions(
        &self,
        plan: &Plan<'_>,
        draws: &[Draw],
        seeds: &dyn Fn(usize, usize) -> Stream,
    ) -> Result<Vec<Vec<f32>>, StageError> {
        let captions: Vec<usize> = draws.iter().map(|d| d.caption).collect();
        let texts = self.texts.get(&captions, |caption| plan.told(caption))?;
        let lengths = draws.iter().map(|draw| self.frames(plan, *draw)).collect::<Result<Vec<usize>, StageError>>()?;
        let batch = Batch { texts: &texts, lengths: &lengths, seeds, control: None };
        generator::motions(&*self.generated.model, batch, &plan.settings.sampler, &mut |_| {})
    }

    /// The length of a motion: that of its crop, or a draw of the length estimator for its caption, once per repeat.
    /// All motions for one caption have the same length.
    fn frames(&self, plan: &Plan<'_>, draw: Draw) -> Result<usize, StageError> {
        let Some(lengths) = &self.generated.lengths else { return Ok(draw.len) };
        let model = &*self.generated.model;
        let pooled = model.text().pooled(&[plan.told(draw.caption)])?;
        let drawn = lengths.draw(&pooled, &mut plan.stream("length", draw.repeat, draw.number));
        Ok(drawn.min(model.longest()))
    }
}

/// Reconstructs a crop with `reconstructor`, in the data's own scale.
pub(super) fn reconstruct(
    plan: &Plan<'_>,
    reconstructor: &Reconstructor,
    draw: Draw,
    crop: &[f32],
) -> Result<Vec<f32>, StageError> {
    reconstructor.check_frames(&plan.dataset.entries[draw.entry].id, draw.len)?;
    let mut rows = crop.to_vec();
    reconstructor.normalise(&mut rows);
    let mut made = reconstructor.sample(&rows, draw.len, &mut plan.stream("posterior", draw.repeat, draw.number));
    reconstructor.denormalise(&mut made);
    if !made.iter().all(|v| v.is_finite()) {
        let text = "a reconstruction is not finite; its model is not trained well enough";
        return Err(StageError::Input(text.into()));
    }
    Ok(made)
}
