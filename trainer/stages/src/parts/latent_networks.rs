//! Trained networks from artifacts, with plain arrays in and out, for evaluation and generation.
//!
//! Everything runs on the plain device, without dropout. Arrays are row-major f32: rows `[batch, frames, D]` of
//! normalised features, latents `[batch, N, d]`, caption embeddings `[batch, text]`. Not its job: training, and
//! artifacts other than these two.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use models::device::host;
use models::diffusion::{
    DpmPath, Form, Grid, LcmTimesteps, Phases, Schedule, TIMESTEPS, affine_one, ddim_sample, dpm_sample, guided,
    lcm_sample, lcm_timesteps, pcm_sample,
};
use models::kernels::Dropout;
use models::networks::{self, Control, DenoiserConfig, Init, POSITIONS, Vae, VaeConfig, guidance_embedding};
use motion::Stream;
use motion::dataset::{denormalise, normalise};
use protocol::Manifest;
use protocol::stage::{DataFormat, Family, Sampler, Solver};

use super::model::expect_format;
use super::steering::Steering;
use super::weights;
use crate::artifacts::{self, DenoiserMeta, VaeMeta};
use crate::context::StageError;

/// Width of the time sinusoid in every published denoiser.
pub(crate) const TIME_DIM: usize = 768;

impl VaeMeta {
    /// The network's size. A bottleneck of the transformer's width has no projections (v1), any other has them (v2).
    pub fn config(&self) -> VaeConfig {
        VaeConfig {
            features: self.features,
            latent: self.latent,
            network: self.network.clone(),
            projection: self.projection.unwrap_or(self.latent.dim != self.network.width),
        }
    }
}

impl DenoiserMeta {
    /// The network's size; projections as in [`VaeMeta::config`].
    pub fn config(&self) -> DenoiserConfig {
        DenoiserConfig {
            latent: self.latent,
            network: self.network.clone(),
            text_dim: self.text_dim,
            time_dim: self.time_dim.unwrap_or(TIME_DIM),
            text_relu: self.text_relu,
            projection: self.projection.unwrap_or(self.latent.dim != self.network.width),
            guidance_dim: (self.guidance_dim > 0).then_some(self.guidance_dim),
        }
    }
}

fn tensor(values: Vec<f32>, shape: [usize; 3], device: &Device) -> Tensor<3> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// A trained VAE.
#[derive(Debug)]
pub struct Autoencoder {
    vae: Vae,
    meta: VaeMeta,
    device: Device,
}

/// Diagonal normal distributions over latents, `[batch, N, d]`.
#[derive(Debug, Clone)]
pub struct Posterior {
    /// Means of the distributions.
    pub mu: Vec<f32>,
    /// Standard deviations of the distributions.
    pub sigma: Vec<f32>,
}

impl Posterior {
    /// Draws a sample, with noise from `stream`.
    pub fn sample(&self, stream: &mut Stream) -> Vec<f32> {
        self.mu.iter().zip(&self.sigma).map(|(mu, sigma)| mu + sigma * stream.normal()).collect()
    }
}

impl Autoencoder {
    /// Reads an artifact of kind `vae`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, device: &Device) -> Result<Self, StageError> {
        let meta: VaeMeta = artifacts::meta(manifest, "the VAE")?;
        let device = device.clone().inner();
        let fresh = Vae::new(&meta.config(), &mut Init::blank(&device));
        let vae = weights::load(fresh, blobs, manifest, "the VAE's weights")?;
        Ok(Self { vae, meta, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &VaeMeta {
        &self.meta
    }

    /// The device that computes.
    pub(crate) fn device(&self) -> &Device {
        &self.device
    }

    /// Number of frames of the longest motion that encoder and decoder have positions for.
    pub fn max_frames(&self) -> usize {
        POSITIONS - 2 * self.meta.latent.tokens
    }

    /// Refuses data of another format than the training data.
    pub fn check_format(&self, format: DataFormat) -> Result<(), StageError> {
        expect_format("the VAE", self.meta.format, format)
    }

    /// Computes `(x - mean) / std` with the statistics of the training data, in place.
    pub fn normalise(&self, rows: &mut [f32]) {
        normalise(rows, &self.meta.mean, &self.meta.std);
    }

    /// The inverse of [`normalise`](Self::normalise).
    pub fn denormalise(&self, rows: &mut [f32]) {
        denormalise(rows, &self.meta.mean, &self.meta.std);
    }

    /// Encodes clips of one length as posteriors: `rows` are `[batch, frames, D]`, normalised.
    pub fn encode(&self, rows: Vec<f32>, frames: usize) -> Posterior {
        let batch = rows.len() / (frames * self.meta.features);
        let rows = tensor(rows, [batch, frames, self.meta.features], &self.device);
        let posterior = self.vae.encode(rows, &vec![frames; batch], &mut Dropout::off());
        Posterior { sigma: host(posterior.sigma()), mu: host(posterior.mu_bnd) }
    }

    /// Decodes latents `[batch, N, d]` to clips `[batch, frames, D]`, normalised.
    pub fn decode(&self, z: Vec<f32>, frames: usize) -> Vec<f32> {
        let latent = self.meta.latent;
        let batch = z.len() / (latent.tokens * latent.dim);
        let z = tensor(z, [batch, latent.tokens, latent.dim], &self.device);
        host(self.vae.decode(z, &vec![frames; batch], frames, &mut Dropout::off()))
    }
}

impl Autoencoder {
    /// Decodes latents [B, N, d] to clips [B, frames, D], normalised; frames past `lengths[b]` are 0. Gradients flow to
    /// the latents, not to the VAE.
    pub fn decode_tensor(&self, z_bnd: Tensor<3>, lengths: &[usize]) -> Tensor<3> {
        let frames = lengths.iter().copied().max().unwrap_or_default();
        self.vae.decode(z_bnd, lengths, frames, &mut Dropout::off())
    }

    /// Decodes latents `[batch, N, d]` to clips of `lengths[b]` frames each, normalised.
    pub fn decode_ragged(&self, z: Vec<f32>, lengths: &[usize]) -> Vec<Vec<f32>> {
        let latent = self.meta.latent;
        let width = self.meta.features;
        let frames = lengths.iter().copied().max().unwrap_or_default();
        let z = tensor(z, [lengths.len(), latent.tokens, latent.dim], &self.device);
        let rows = host(self.vae.decode(z, lengths, frames, &mut Dropout::off()));
        let clip = |(rows, len): (&[f32], &usize)| rows[..len * width].to_vec();
        rows.chunks_exact((frames * width).max(1)).zip(lengths).map(clip).collect()
    }
}

/// Conditions and initial noise of latents to be sampled.
#[derive(Debug, Clone)]
pub struct Conditions {
    /// Caption embeddings, `[batch, text]`.
    pub text: Vec<f32>,
    /// The empty caption's embedding, `[text]`.
    pub null: Vec<f32>,
    /// Standard normal initial noise of the sampler, `[batch, N, d]`.
    pub noise: Vec<f32>,
}

/// A trained denoiser: teacher or student.
#[derive(Debug)]
pub struct Denoiser {
    network: networks::Denoiser,
    meta: DenoiserMeta,
    schedule: Schedule,
    device: Device,
}

/// Receives the timestep of each sampler step, and a function that computes the predicted clean latents.
pub type SeeLatents<'a> = dyn FnMut(usize, &dyn Fn() -> Vec<f32>) + 'a;

impl Denoiser {
    /// Reads an artifact of kind `denoiser`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, device: &Device) -> Result<Self, StageError> {
        let meta: DenoiserMeta = artifacts::meta(manifest, "the denoiser")?;
        let device = device.clone().inner();
        let fresh = networks::Denoiser::new(&meta.config(), &mut Init::blank(&device));
        let network = weights::load(fresh, blobs, manifest, "the denoiser's weights")?;
        let schedule = Schedule::new(&meta.diffusion, TIMESTEPS);
        Ok(Self { network, meta, schedule, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &DenoiserMeta {
        &self.meta
    }

    /// Samples latents `[batch, N, d]`. A teacher uses DDIM or a DPM-Solver with guidance g, an LCM fresh noise between
    /// its jumps, a PCM one jump per phase; students embed w. `step_noise(j)` returns noise of the same shape after
    /// jump j of an LCM. With `steering` every prediction is controlled, including that without a caption.
    pub fn sample(
        &self,
        conditions: &Conditions,
        sampler: &Sampler,
        steering: Option<&Steering<'_>>,
        step_noise: &mut dyn FnMut(usize) -> Vec<f32>,
    ) -> Result<Vec<f32>, StageError> {
        self.sample_seen(conditions, sampler, steering, step_noise, &mut |_, _| {})
    }

    /// Like [`sample`](Self::sample); `see` receives each step's timestep and a function that computes the predicted
    /// clean latents.
    pub fn sample_seen(
        &self,
        conditions: &Conditions,
        sampler: &Sampler,
        steering: Option<&Steering<'_>>,
        step_noise: &mut dyn FnMut(usize) -> Vec<f32>,
        see: &mut SeeLatents<'_>,
    ) -> Result<Vec<f32>, StageError> {
        let mut seen = |z: &Tensor<3>, t: usize, out: &Tensor<3>| {
            let clean = || host(affine_one(z.clone(), out.clone(), self.schedule.clean(t)));
            see(t, &clean);
        };
        self.meta.family.accepts(sampler).map_err(StageError::Input)?;
        let latent = self.meta.latent;
        let batch = conditions.noise.len() / (latent.tokens * latent.dim);
        let shape = [batch, latent.tokens, latent.dim];
        let on_device = |values: Vec<f32>, shape| tensor(values, shape, &self.device);
        let z = on_device(conditions.noise.clone(), shape);
        Ok(host(match self.meta.family {
            Family::Mld => self.sample_teacher(conditions, sampler, z, steering, &mut seen),
            Family::Lcm { skip, .. } => {
                let mut eps = self.student(conditions, sampler, batch, steering);
                let timesteps = lcm_path(skip, sampler);
                let fresh: Vec<_> = (1..timesteps.len()).map(|j| on_device(step_noise(j - 1), shape)).collect();
                lcm_sample(&self.schedule, &timesteps, z, &fresh, |z, t| {
                    let out = eps(z.clone(), t);
                    seen(&z, t, &out);
                    out
                })
            }
            Family::Autoregressive | Family::Masked | Family::Mmm | Family::Features { .. } => {
                return Err(StageError::Input("expected a latent denoiser; the manifest names another family".into()));
            }
            Family::Pcm { skip, phases, .. } => {
                let mut eps = self.student(conditions, sampler, batch, steering);
                pcm_sample(&self.schedule, &Phases::new(&Grid::new(skip), phases), z, |z, t| {
                    let out = eps(z.clone(), t);
                    seen(&z, t, &out);
                    out
                })
            }
        }))
    }

    /// Samples with guidance from noise `z` `[batch, N, d]`; `seen` receives each step's input, timestep and output.
    fn sample_teacher(
        &self,
        conditions: &Conditions,
        sampler: &Sampler,
        z: Tensor<3>,
        steering: Option<&Steering<'_>>,
        seen: &mut dyn FnMut(&Tensor<3>, usize, &Tensor<3>),
    ) -> Tensor<3> {
        let [batch, tokens, dim] = z.dims();
        let mut text = conditions.text.clone();
        text.extend(conditions.null.repeat(batch));
        let text = tensor(text, [2 * batch, 1, self.meta.text_dim], &self.device);
        let out = |z: Tensor<3>, t: usize| {
            let both = Tensor::cat(vec![z.clone(), z.clone()], 0);
            let noise = self.predict(both, &vec![t; 2 * batch], text.clone(), None, steering);
            let half = |from: usize| noise.clone().slice([from..from + batch, 0..tokens, 0..dim]);
            let out = guided(half(0), half(batch), sampler.guidance);
            seen(&z, t, &out);
            out
        };
        let form = match self.meta.family.solver(sampler.solver) {
            Some(Solver::DpmSolver) => Form::Noise,
            Some(Solver::DpmSolverPp) => Form::Data,
            _ => return ddim_sample(&self.schedule, sampler.steps, z, out),
        };
        let path = DpmPath::even(&self.schedule, sampler.steps);
        // Deterministic forms need no noise.
        dpm_sample(&self.schedule, &path, form, z.clone(), |_| z.zeros_like(), out)
    }

    fn predict(
        &self,
        latent_bnd: Tensor<3>,
        timesteps: &[usize],
        text_blc: Tensor<3>,
        guidance_bg: Option<Tensor<2>>,
        steering: Option<&Steering<'_>>,
    ) -> Tensor<3> {
        let off = &mut Dropout::off();
        let Some(steering) = steering else {
            return self.network.forward(latent_bnd, timesteps, text_blc, guidance_bg, off);
        };
        let (residuals, scale) = steering.residuals(&latent_bnd, timesteps, &text_blc, guidance_bg.as_ref());
        let control = Control { residuals: &residuals, scale };
        self.network.forward_controlled(latent_bnd, timesteps, text_blc, guidance_bg, control, off)
    }

    /// A student's noise prediction as a function of latent and timestep.
    fn student(
        &self,
        conditions: &Conditions,
        sampler: &Sampler,
        batch: usize,
        steering: Option<&Steering<'_>>,
    ) -> impl FnMut(Tensor<3>, usize) -> Tensor<3> {
        let text = tensor(conditions.text.clone(), [batch, 1, self.meta.text_dim], &self.device);
        #[expect(clippy::cast_possible_truncation, reason = "embedded in f32 by definition")]
        let w = vec![sampler.guidance as f32; batch];
        let guidance = guidance_embedding(&w, self.meta.guidance_dim, &self.device);
        move |z, t| self.predict(z, &vec![t; batch], text.clone(), Some(guidance.clone()), steering)
    }
}

/// Timesteps of an LCM's sampler, noisiest first: the given ones, otherwise evenly spread over the training grid from
/// 999 down.
fn lcm_path(skip: usize, sampler: &Sampler) -> Vec<usize> {
    match sampler.timesteps.is_empty() {
        true => lcm_timesteps(LcmTimesteps::Even(Grid::new(skip)), sampler.steps),
        false => sampler.timesteps.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_lcm_starts_at_the_noisiest_timestep_or_where_it_is_told() {
        let sampler = |timesteps: &[usize]| Sampler {
            steps: 1,
            guidance: 2.0,
            timesteps: timesteps.to_vec(),
            ..Sampler::default()
        };
        assert_eq!(lcm_path(100, &sampler(&[])), [999]);
        assert_eq!(lcm_path(100, &sampler(&[699])), [699]);
    }
}
