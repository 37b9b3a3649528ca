//! Diffusion of motion itself: a denoiser generates the features of frames, without a decoder. Source: MDM,
//! StableMoFusion.
//!
//! Parts: `denoiser`, `text`. MDM reads one vector of a caption, StableMoFusion its tokens.

use std::collections::BTreeMap;

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, Family, Sampler};

use super::{Batch, Lap, MotionGenerator, Text};
use crate::context::StageError;
use crate::parts;
use crate::parts::motion_networks::{CaptionRows, Drawing, MotionDenoiser};
use crate::parts::text::{self, TextEncoder};

/// Name of this generator in manifests.
pub(crate) const NAME: &str = "feature-diffusion";

#[derive(Debug)]
struct FeatureDiffusion {
    denoiser: MotionDenoiser,
    text: Box<dyn TextEncoder>,
}

/// Opens the parts and checks that they fit each other.
pub(super) fn open(model: &Model, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn MotionGenerator>, StageError> {
    let part = |role: &Role, kind| parts::part(blobs, model, role, kind);
    let denoiser = MotionDenoiser::read(blobs, &part(&Role::DENOISER, ArtifactKind::Denoiser)?, device)?;
    let text = text::open(&part(&Role::TEXT, ArtifactKind::TextEncoder)?, blobs, device)?;
    let meta = denoiser.meta();
    if meta.fits.get(&Role::TEXT) != model.parts.get(&Role::TEXT) {
        return Err(StageError::Input("the denoiser was not trained with the model's `text` part".into()));
    }
    let found = if meta.reads_tokens() { text.token_dim() } else { text.dim() };
    if meta.text_dim != found {
        let wanted = meta.text_dim;
        return Err(StageError::Input(format!(
            "the denoiser expects vectors of {wanted} numbers, but the text encoder returns {found}"
        )));
    }
    Ok(Box::new(FeatureDiffusion { denoiser, text }))
}

impl MotionGenerator for FeatureDiffusion {
    fn format(&self) -> DataFormat {
        self.denoiser.meta().format
    }

    fn longest(&self) -> usize {
        self.denoiser.meta().max_frames
    }

    fn family(&self) -> &Family {
        &self.denoiser.meta().family
    }

    fn text(&self) -> &dyn TextEncoder {
        &*self.text
    }

    fn embed(&self, captions: &[&str]) -> Result<Vec<Text>, StageError> {
        if self.denoiser.meta().reads_tokens() {
            return Ok(self.text.tokens(captions)?.into_iter().map(|values| Text { values }).collect());
        }
        let pooled = self.text.pooled(captions)?;
        Ok(pooled.chunks_exact(self.text.dim()).map(|row| Text { values: row.to_vec() }).collect())
    }

    fn predictions(&self, batch: Batch<'_>, sampler: &Sampler) -> Result<Vec<(usize, Vec<f32>)>, StageError> {
        let rows = vec![batch.texts[0].values.clone()];
        let kept = vec![true];
        let captions = CaptionRows { rows, kept };
        let drawing = Drawing { captions: &captions, frames: batch.lengths[0], sampler };
        let noise = |k: usize, i: usize, out: &mut [f32]| (batch.seeds)(k, i).fill_normal(out);
        let mut all = Vec::new();
        self.denoiser.draw_seen(drawing, &noise, &mut |t, clean| all.push((t, clean().concat())))?;
        Ok(all)
    }

    fn draw(&self, batch: Batch<'_>, sampler: &Sampler, lap: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError> {
        // Motions of one length are generated together; a network with a fixed length generates all of them together.
        let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        let whole = self.denoiser.meta().draws_whole();
        for (b, frames) in batch.lengths.iter().enumerate() {
            groups.entry(if whole { self.longest() } else { *frames }).or_default().push(b);
        }
        let width = self.denoiser.meta().mean.len();
        let mut motions = vec![Vec::new(); batch.lengths.len()];
        for (frames, members) in groups {
            let rows = members.iter().map(|b| batch.texts[*b].values.clone()).collect();
            let captions = CaptionRows { rows, kept: vec![true; members.len()] };
            let drawing = Drawing { captions: &captions, frames, sampler };
            let noise = |k: usize, i: usize, out: &mut [f32]| (batch.seeds)(k, members[i]).fill_normal(out);
            for (b, mut motion) in members.iter().zip(self.denoiser.draw(drawing, &noise)?) {
                motion.truncate(batch.lengths[*b] * width);
                motions[*b] = motion;
            }
        }
        lap(Lap::Sampled);
        lap(Lap::Decoded);
        Ok(motions)
    }
}
