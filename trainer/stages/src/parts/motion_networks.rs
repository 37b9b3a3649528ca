//! Networks that diffuse motion itself: their artifacts, their conditions, and sampling with them.
//!
//! Sources: MDM (arXiv:2209.14916) and StableMoFusion (arXiv:2405.05691). Motions are rows `[frames, features]`,
//! normalised with the statistics of the training data, which the meta holds. Without a mask MDM attends to padding, so
//! it always generates `max_frames` frames, as published, and cuts. Otherwise a motion is generated at its own length.
//! Departs: upstream StableMoFusion generates a batch at its longest length and cuts, so that a motion depends on its
//! batch.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::device::host;
use models::diffusion::{
    DpmPath, Form, Last, Schedule, affine_one, ddim_sample_to_data, ddpm_sample, ddpm_timesteps, dpm_sample, guided,
    leading_timesteps,
};
use models::kernels::Dropout;
use models::names::load;
use models::networks::{Init, Mdm, MdmConfig, StableMoFusion, StableMoFusionConfig, TokenCondition};
use motion::dataset::denormalise;
use protocol::Manifest;
use protocol::stage::{DataFormat, Diffusion, Family, MdmNetwork, Sampler, Solver, StableMoFusionNetwork};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, MODEL_FILE};
use crate::context::{ContextError, StageError};

/// The network's architecture and size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "name", content = "network", rename_all = "lowercase")]
pub enum Architecture {
    /// A transformer, conditioned on one vector per caption.
    Mdm(MdmNetwork),
    /// A U-Net, conditioned on a caption's tokens.
    StableMoFusion(StableMoFusionNetwork),
}

/// Meta of an artifact of kind `denoiser` that diffuses motion itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MotionDenoiserMeta {
    /// Family of the model, which decides its samplers.
    #[serde(flatten)]
    pub family: Family,
    pub architecture: Architecture,
    /// Format of the training data.
    pub format: DataFormat,
    /// Noise schedule and prediction.
    pub diffusion: Diffusion,
    /// True if attention excludes padding.
    pub mask_frames: bool,
    /// Number of frames of the longest motion.
    pub max_frames: usize,
    /// Mean subtracted from features, `[features]`.
    pub mean: Vec<f32>,
    /// Deviation that divides features, `[features]`.
    pub std: Vec<f32>,
    /// Width of a caption's vector, or of its tokens.
    pub text_dim: usize,
    /// The text encoder of its training.
    pub fits: Parts,
}

impl MotionDenoiserMeta {
    /// Number of timesteps of the schedule.
    pub fn timesteps(&self) -> Result<usize, StageError> {
        match self.family {
            Family::Features { timesteps, .. } => Ok(timesteps),
            _ => Err(StageError::Input("the denoiser is for latents; expected a denoiser of motion features".into())),
        }
    }

    /// Returns true if a caption is a sequence of tokens, not one vector.
    pub fn reads_tokens(&self) -> bool {
        matches!(self.architecture, Architecture::StableMoFusion(_))
    }

    /// Returns true if motions are always padded to `max_frames`, because the network attends to padding.
    pub fn draws_whole(&self) -> bool {
        matches!(self.architecture, Architecture::Mdm(_)) && !self.mask_frames
    }

    /// Creates an MDM of these sizes with initial weights.
    pub fn mdm(&self, network: &MdmNetwork, init: &mut Init<'_>) -> Mdm {
        let config = MdmConfig { features: self.mean.len(), network: network.clone(), text_dim: self.text_dim };
        Mdm::new(&config, init)
    }

    /// Creates a StableMoFusion network of these sizes with initial weights.
    pub fn stablemofusion(&self, network: &StableMoFusionNetwork, init: &mut Init<'_>) -> StableMoFusion {
        let config =
            StableMoFusionConfig { features: self.mean.len(), network: network.clone(), text_dim: self.text_dim };
        StableMoFusion::new(&config, init)
    }
}

/// The embedded captions of a batch.
#[derive(Debug, Clone)]
pub struct CaptionRows {
    /// For each caption its vector, or the vectors of its tokens one after the other.
    pub rows: Vec<Vec<f32>>,
    /// True for a sample with its caption, false for a sample without.
    pub kept: Vec<bool>,
}

/// Condition of a network.
#[derive(Debug, Clone)]
pub enum Condition {
    /// One vector per caption [B, text_dim].
    Vector(Tensor<2>),
    /// Encoded tokens of each caption.
    Tokens(TokenCondition),
}

/// A network that predicts the clean motion from a noised one.
pub trait MotionNetwork: Module {
    /// Encodes captions of `dim` numbers per vector, once for any number of predictions.
    fn condition(&self, captions: &CaptionRows, dim: usize, device: &Device, drop: &mut Dropout) -> Condition;

    /// The output for `x_btf` [B, T, F] at `timesteps`; `None` as condition means that no sample has a caption. With
    /// `lengths`, frames past them are padding without attention.
    fn predict(
        &self,
        x_btf: Tensor<3>,
        timesteps: &[usize],
        condition: Option<&Condition>,
        lengths: Option<&[usize]>,
        drop: &mut Dropout,
    ) -> Tensor<3>;
}

impl MotionNetwork for Mdm {
    fn condition(&self, captions: &CaptionRows, dim: usize, device: &Device, _: &mut Dropout) -> Condition {
        let row = |(row, kept): (&Vec<f32>, &bool)| if *kept { row.clone() } else { vec![0.0; dim] };
        let values: Vec<f32> = captions.rows.iter().zip(&captions.kept).flat_map(row).collect();
        Condition::Vector(Tensor::from_data(TensorData::new(values, [captions.rows.len(), dim]), device))
    }

    fn predict(
        &self,
        x_btf: Tensor<3>,
        timesteps: &[usize],
        condition: Option<&Condition>,
        lengths: Option<&[usize]>,
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let vector = match condition {
            Some(Condition::Vector(vector)) => vector.clone(),
            _ => Tensor::zeros([timesteps.len(), self.embed_text.weight.dims()[1]], &x_btf.device()),
        };
        self.forward(x_btf, timesteps, vector, lengths, drop)
    }
}

impl MotionNetwork for StableMoFusion {
    fn condition(&self, captions: &CaptionRows, dim: usize, device: &Device, drop: &mut Dropout) -> Condition {
        let counts: Vec<usize> = captions.rows.iter().map(|rows| rows.len() / dim).collect();
        let most = counts.iter().copied().max().unwrap_or_default();
        let mut values = vec![0.0; counts.len() * most * dim];
        for (to, from) in values.chunks_exact_mut((most * dim).max(1)).zip(&captions.rows) {
            to[..from.len()].copy_from_slice(from);
        }
        let tokens = Tensor::from_data(TensorData::new(values, [counts.len(), most, dim]), device);
        let lengths = counts.iter().any(|count| *count != most).then_some(counts);
        let text_bnc = self.encode_text(tokens, lengths.as_deref(), drop);
        Condition::Tokens(TokenCondition { text_bnc, lengths, kept: captions.kept.clone() })
    }

    fn predict(
        &self,
        x_btf: Tensor<3>,
        timesteps: &[usize],
        condition: Option<&Condition>,
        _: Option<&[usize]>,
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let tokens = condition.and_then(|condition| match condition {
            Condition::Tokens(tokens) => Some(tokens),
            Condition::Vector(_) => None,
        });
        self.forward(x_btf, timesteps, tokens, drop)
    }
}

#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "there is one of it")]
enum Network {
    Mdm(Mdm),
    StableMoFusion(StableMoFusion),
}

/// A trained network with its meta.
#[derive(Debug)]
pub struct MotionDenoiser {
    network: Network,
    meta: MotionDenoiserMeta,
    schedule: Schedule,
    device: Device,
}

/// Motions of one length to be generated together.
#[derive(Debug, Clone, Copy)]
pub struct Drawing<'a> {
    /// Captions as embedded by the text encoder.
    pub captions: &'a CaptionRows,
    /// Number of frames of each motion.
    pub frames: usize,
    pub sampler: &'a Sampler,
}

/// Receives the timestep of each sampler step, and a function that computes the predicted clean motions.
pub type SeeMotions<'a> = dyn FnMut(usize, &dyn Fn() -> Vec<Vec<f32>>) + 'a;

impl MotionDenoiser {
    /// Reads an artifact of kind `denoiser`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, device: &Device) -> Result<Self, StageError> {
        let meta: MotionDenoiserMeta = artifacts::meta(manifest, "the denoiser")?;
        let weights = artifacts::file(blobs, manifest, MODEL_FILE)?;
        let device = device.clone().inner();
        let misfit = |e| StageError::Context(ContextError::Corrupt(format!("the denoiser's weights: {e}")));
        let mut blank = Init::blank(&device);
        let network = match &meta.architecture {
            Architecture::Mdm(size) => Network::Mdm(load(meta.mdm(size, &mut blank), &weights, "").map_err(misfit)?),
            Architecture::StableMoFusion(size) => {
                let fresh = meta.stablemofusion(size, &mut blank);
                Network::StableMoFusion(load(fresh, &weights, "").map_err(misfit)?)
            }
        };
        let schedule = Schedule::new(&meta.diffusion, meta.timesteps()?);
        Ok(Self { network, meta, schedule, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &MotionDenoiserMeta {
        &self.meta
    }

    /// Generates motions `[frames, features]` in the data's own scale. `noise(k, b, out)` writes standard normal noise
    /// for motion b: number 0 is its initial noise, 1 + j is for step j.
    pub fn draw(
        &self,
        drawing: Drawing<'_>,
        noise: &dyn Fn(usize, usize, &mut [f32]),
    ) -> Result<Vec<Vec<f32>>, StageError> {
        self.draw_seen(drawing, noise, &mut |_, _| {})
    }

    /// Like [`draw`](Self::draw); `see` receives each step's timestep and a function that computes the predicted clean
    /// motions.
    pub fn draw_seen(
        &self,
        drawing: Drawing<'_>,
        noise: &dyn Fn(usize, usize, &mut [f32]),
        see: &mut SeeMotions<'_>,
    ) -> Result<Vec<Vec<f32>>, StageError> {
        self.meta.family.accepts(drawing.sampler).map_err(StageError::Input)?;
        let frames = if self.meta.draws_whole() { self.meta.max_frames } else { drawing.frames };
        let drawn = match &self.network {
            Network::Mdm(network) => self.sample(network, drawing, frames, noise, see)?,
            Network::StableMoFusion(network) => self.sample(network, drawing, frames, noise, see)?,
        };
        Ok(self.motions(drawn, drawing.frames))
    }

    /// Converts [B, T, F] to motions of `frames` frames in the data's own scale.
    fn motions(&self, drawn: Tensor<3>, frames: usize) -> Vec<Vec<f32>> {
        let [_, whole, width] = drawn.dims();
        let values = host(drawn);
        let mut motions: Vec<Vec<f32>> =
            values.chunks_exact(whole * width).map(|motion| motion[..frames * width].to_vec()).collect();
        motions.iter_mut().for_each(|motion| denormalise(motion, &self.meta.mean, &self.meta.std));
        motions
    }

    fn sample<N: MotionNetwork>(
        &self,
        network: &N,
        drawing: Drawing<'_>,
        frames: usize,
        noise: &dyn Fn(usize, usize, &mut [f32]),
        see: &mut SeeMotions<'_>,
    ) -> Result<Tensor<3>, StageError> {
        let batch = drawing.captions.rows.len();
        let width = self.meta.mean.len();
        let fill = |k: usize| {
            let mut values = vec![0.0; batch * frames * width];
            values.chunks_exact_mut(frames * width).enumerate().for_each(|(b, row)| noise(k, b, row));
            Tensor::<3>::from_data(TensorData::new(values, [batch, frames, width]), &self.device)
        };
        let off = &mut Dropout::off();
        let condition = network.condition(drawing.captions, self.meta.text_dim, &self.device, off);
        let see = std::cell::RefCell::new(see);
        // All have one length, so a mask would be empty.
        let out = |z: Tensor<3>, t: usize| {
            let times = vec![t; batch];
            let off = &mut Dropout::off();
            let with = network.predict(z.clone(), &times, Some(&condition), None, off);
            let out = guided(with, network.predict(z.clone(), &times, None, None, off), drawing.sampler.guidance);
            let clean = || affine_one(z.clone(), out.clone(), self.schedule.clean(t));
            (see.borrow_mut())(t, &|| self.motions(clean(), drawing.frames));
            out
        };
        let (schedule, steps, step_noise) = (&self.schedule, drawing.sampler.steps, |j: usize| fill(1 + j));
        let dpm = |path: &DpmPath, form| dpm_sample(schedule, path, form, fill(0), step_noise, out);
        Ok(match self.meta.family.solver(drawing.sampler.solver) {
            Some(Solver::Ddpm) => ddpm_sample(schedule, &ddpm_timesteps(schedule, steps), fill(0), step_noise, out),
            Some(Solver::Ddim) => ddim_sample_to_data(schedule, &leading_timesteps(schedule, steps), fill(0), out),
            Some(Solver::DpmSolver) => dpm(&DpmPath::even(schedule, steps), Form::Noise),
            Some(Solver::DpmSolverPp) => dpm(&DpmPath::even(schedule, steps), Form::Data),
            Some(Solver::SdeDpmSolverPp) => dpm(&DpmPath::karras(schedule, steps, Last::Zero), Form::StochasticData),
            Some(Solver::SdeDpmSolverPp2023) => {
                dpm(&DpmPath::karras(schedule, steps, Last::Repeated), Form::StochasticData)
            }
            Some(Solver::Own) | None => {
                return Err(StageError::Input(format!("this model has no solver `{}`", drawing.sampler.solver.name())));
            }
        })
    }
}
