//! Latent diffusion and its students: a denoiser samples a latent, and a VAE decodes it to motion. Source: MLD,
//! MotionLCM, MotionPCM.
//!
//! Parts: `denoiser`, `vae`, `text`; `control` if motions can be steered; `decoder` if a flow decodes instead of the
//! VAE. The denoiser reads one vector of a caption.

use std::rc::Rc;

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Model;
use motion::Stream;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, Family, LatentShape, Sampler};
use protocol::{ArtifactKind, Digest};

use super::{Batch, ControlRequest, Lap, LatentGenerator, MotionGenerator, Seeds, Text};
use crate::context::StageError;
use crate::generate::refine::refine;
use crate::parts::control::{ControlMeta, TrainedControl};
use crate::parts::flow_decoder::{FlowDecoder, UNIT};
use crate::parts::latent_networks::{Autoencoder, Conditions, Denoiser, SeeLatents};
use crate::parts::text::{self, TextEncoder};
use crate::parts::{self, model_error};

/// Name of this generator in manifests.
pub(crate) const NAME: &str = "latent-diffusion";

#[derive(Debug)]
struct LatentDiffusion {
    denoiser: Denoiser,
    vae: Autoencoder,
    /// Digest of the VAE's manifest.
    vae_digest: Digest,
    decoder: Option<FlowDecoder>,
    text: Box<dyn TextEncoder>,
    control: Option<TrainedControl>,
    /// Embedding of the empty caption.
    null: Vec<f32>,
}

/// Opens the parts and checks that they fit each other.
pub(super) fn open(model: &Model, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn MotionGenerator>, StageError> {
    let part = |role: &Role, kind| parts::part(blobs, model, role, kind);
    let denoiser = Denoiser::read(blobs, &part(&Role::DENOISER, ArtifactKind::Denoiser)?, device)?;
    let vae = Autoencoder::read(blobs, &part(&Role::VAE, ArtifactKind::Vae)?, device)?;
    let text = text::open(&part(&Role::TEXT, ArtifactKind::TextEncoder)?, blobs, device)?;
    let meta = denoiser.meta();
    for role in [Role::VAE, Role::TEXT] {
        if meta.fits.get(&role) != model.parts.get(&role) {
            return Err(StageError::Input(format!("the denoiser was not trained with the model's `{role}` part")));
        }
    }
    let ours = meta.latent;
    let theirs = vae.meta().latent;
    if ours != theirs {
        return Err(StageError::Input(format!(
            "the denoiser's latent is {}x{}, but the VAE's is {}x{}",
            ours.tokens, ours.dim, theirs.tokens, theirs.dim
        )));
    }
    if meta.text_dim != text.dim() {
        let wanted = meta.text_dim;
        let found = text.dim();
        return Err(StageError::Input(format!(
            "the denoiser expects {wanted} numbers per caption, but the text encoder returns {found}"
        )));
    }
    let control = match model.parts.contains_key(&Role::CONTROL) {
        true => {
            let part = part(&Role::CONTROL, ArtifactKind::Control)?;
            Some(TrainedControl::read(blobs, &part, meta, device)?)
        }
        false => None,
    };
    if let Some(control) = &control {
        let fits = |role: &Role| control.meta().fits.get(role) == model.parts.get(role);
        if control.meta().format != vae.meta().format || !fits(&Role::DENOISER) {
            return Err(StageError::Input("the control part was not trained for the model's denoiser".into()));
        }
    }
    let null = text.pooled(&[""])?;
    let vae_digest = model.part(&Role::VAE).map_err(model_error)?;
    let decoder = match model.parts.contains_key(&Role::DECODER) {
        true => {
            let manifest = part(&Role::DECODER, ArtifactKind::FlowDecoder)?;
            Some(FlowDecoder::read(blobs, &manifest, (&Role::VAE, vae_digest), device)?)
        }
        false => None,
    };
    Ok(Box::new(LatentDiffusion { denoiser, vae, vae_digest, decoder, text, control, null }))
}

impl MotionGenerator for LatentDiffusion {
    fn format(&self) -> DataFormat {
        self.vae.meta().format
    }

    fn longest(&self) -> usize {
        let most = self.vae.max_frames();
        // A flow decodes only whole codes.
        if self.decoder.is_some() { most / UNIT * UNIT } else { most }
    }

    fn family(&self) -> &Family {
        &self.denoiser.meta().family
    }

    fn text(&self) -> &dyn TextEncoder {
        &*self.text
    }

    fn embed(&self, captions: &[&str]) -> Result<Vec<Text>, StageError> {
        let pooled = self.text.pooled(captions)?;
        Ok(pooled.chunks_exact(self.text.dim()).map(|row| Text { values: row.to_vec() }).collect())
    }

    fn draw(&self, batch: Batch<'_>, sampler: &Sampler, lap: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError> {
        let mut z = self.steered(batch.texts, batch.seeds, sampler, batch.control, &mut |_, _| {})?;
        if let (Some(ControlRequest { hints, options }), Some(control)) = (batch.control, &self.control) {
            z = control.correct(&self.vae, z, batch.lengths, (hints, options));
        }
        if let Some(ControlRequest { hints, options }) = batch.control
            && options.refine > 0
        {
            if self.decoder.is_some() {
                return Err(StageError::Input(
                    "the model decodes motions with a flow; latents cannot be refined through a flow".into(),
                ));
            }
            refine(&self.vae, &mut z, batch.lengths, hints, options.refine);
        }
        lap(Lap::Sampled);
        let mut motions = match &self.decoder {
            None => self.vae.decode_ragged(z, batch.lengths),
            Some(decoder) => {
                let clips = z.chunks_exact(self.shape().tokens * self.shape().dim).zip(batch.lengths).enumerate();
                // A stream after those of all steps.
                let noise = |b| (batch.seeds)(1 + sampler.steps, b);
                clips.map(|(b, (z, n))| decoder.decode_latent(&self.vae, z.to_vec(), *n, &mut noise(b))).collect()
            }
        };
        motions.iter_mut().for_each(|motion| self.vae.denormalise(motion));
        lap(Lap::Decoded);
        Ok(motions)
    }

    fn predictions(&self, batch: Batch<'_>, sampler: &Sampler) -> Result<Vec<(usize, Vec<f32>)>, StageError> {
        let mut all = Vec::new();
        let mut see = |t: usize, clean: &dyn Fn() -> Vec<f32>| {
            let mut motion = self.vae.decode_ragged(clean(), batch.lengths).concat();
            self.vae.denormalise(&mut motion);
            all.push((t, motion));
        };
        self.steered(batch.texts, batch.seeds, sampler, batch.control, &mut see)?;
        Ok(all)
    }

    fn control(&self) -> Option<&ControlMeta> {
        self.control.as_ref().map(TrainedControl::meta)
    }

    fn reconstruct(&self, rows: &[f32], noise: &mut Stream) -> Vec<f32> {
        let width = self.vae.meta().features;
        let whole = if self.decoder.is_some() { UNIT } else { 1 };
        let frames = (rows.len() / width / whole * whole).min(self.longest());
        if frames == 0 {
            return rows.to_vec();
        }
        let mut rows = rows[..frames * width].to_vec();
        self.vae.normalise(&mut rows);
        let z = self.vae.encode(rows, frames).mu;
        let mut rows = match &self.decoder {
            None => self.vae.decode(z, frames),
            Some(decoder) => decoder.decode_latent(&self.vae, z, frames, noise),
        };
        self.vae.denormalise(&mut rows);
        rows
    }

    fn latents(&self) -> Option<&dyn LatentGenerator> {
        Some(self)
    }
}

impl LatentDiffusion {
    fn steered(
        &self,
        texts: &[Rc<Text>],
        seeds: &Seeds<'_>,
        sampler: &Sampler,
        control: Option<ControlRequest<'_>>,
        see: &mut SeeLatents<'_>,
    ) -> Result<Vec<f32>, StageError> {
        let size = self.shape().tokens * self.shape().dim;
        let fill = |k: usize| {
            let mut values = vec![0.0; texts.len() * size];
            values.chunks_exact_mut(size).enumerate().for_each(|(b, row)| seeds(k, b).fill_normal(row));
            values
        };
        let text = texts.iter().flat_map(|text| text.values.iter().copied()).collect();
        let conditions = Conditions { text, null: self.null.clone(), noise: fill(0) };
        let steering = match (control, &self.control) {
            (Some(request), Some(control)) => Some(control.steer(request.hints, request.options.scale)),
            _ => None,
        };
        self.denoiser.sample_seen(&conditions, sampler, steering.as_ref(), &mut |step| fill(1 + step), see)
    }
}

impl LatentGenerator for LatentDiffusion {
    fn shape(&self) -> LatentShape {
        self.denoiser.meta().latent
    }

    fn vae(&self) -> Digest {
        self.vae_digest
    }

    fn sample(&self, texts: &[Rc<Text>], seeds: &Seeds<'_>, sampler: &Sampler) -> Result<Vec<f32>, StageError> {
        self.steered(texts, seeds, sampler, None, &mut |_, _| {})
    }
}
