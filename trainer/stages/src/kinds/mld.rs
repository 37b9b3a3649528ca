//! `train.mld`: the latent-diffusion teacher. Source: MLD (arXiv:2212.04048), MotionLCM v2's recipe.
//!
//! `t ~ U{0..999}`, `z_t = alpha_t z_0 + sigma_t eps`, loss `mean (eps_hat(z_t, t, c) - eps)^2` (of the sample or the velocity where `diffusion`
//! says so), the caption replaced by the empty one with probability `guidance_dropout`. Latents are samples of their posteriors, unscaled.

use std::collections::BTreeMap;

use checkpoint::model::Parts;
use models::diffusion::{Schedule, TIMESTEPS, affine, unzip};
use models::flat;
use models::kernels::Dropout;
use models::losses;
use models::networks::{Denoiser, Init};
use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::{Family, TrainMld};

use super::latent_data::{self, LatentData};
use super::{Gang, group, slice_result};
use crate::artifacts::{self, DenoiserMeta, VaeMeta};
use crate::context::{GangContext, Outcome, StageError};
use crate::train::{GroupPlan, Losses, Objective, SliceResult, TrainState, Trained, train};

/// The term of the loss that every latent diffusion has.
const DENOISING: &str = "denoising";

struct Mld {
    settings: TrainMld,
    data: LatentData,
    network: Denoiser,
    noise: Schedule,
    seed: u64,
}

impl Objective for Mld {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![group("model", &self.network, &self.settings.training, self.settings.ema)]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL]
    }

    fn load(&mut self, state: &TrainState) {
        flat::assign(&mut self.network, &state.groups[0].params);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.data.slice(step, slice, self.settings.guidance_dropout);
        let timesteps: Vec<usize> =
            batch.picks.iter().map(|pick| self.data.stream("timestep", *pick).below(TIMESTEPS)).collect();
        let noise = self.data.noise("noise", &batch.picks);
        let (a, e) = unzip(timesteps.iter().map(|t| self.noise.add_noise(*t)));
        let noisy = affine(batch.clean_bnd.clone(), noise.clone(), &a, &e);
        let target = self.noise.target(batch.clean_bnd, noise, &timesteps);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.seed, step, slice as u64);
        let predicted = self.network.forward(noisy, &timesteps, batch.text_blc, None, &mut dropout);
        let mut all = Losses::new(self.settings.training.batch.global);
        all.add(DENOISING, losses::mse(predicted, target), 1.0);
        slice_result(&self.network, &all, &self.terms())
    }
}

impl Gang for TrainMld {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let data = LatentData::read(cx, &self.training)?;
        let (vae_digest, vae_part) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
        let vae: VaeMeta = artifacts::meta(&vae_part, "the VAE")?;
        let text_part = data.text_encoder(cx)?;
        if data.vae() != vae_digest || data.meta().latent != vae.latent {
            return Err(StageError::Input(format!(
                "`latents` were made by another VAE ({} x {} latents) than `vae` ({} x {}); name the VAE that encoded them",
                data.meta().latent.tokens,
                data.meta().latent.dim,
                vae.latent.tokens,
                vae.latent.dim
            )));
        }
        let meta = DenoiserMeta {
            family: Family::Mld,
            latent: vae.latent,
            network: self.network.clone(),
            diffusion: self.diffusion.clone(),
            text_relu: self.text_relu,
            guidance_dim: 0,
            text_dim: data.text_meta().dim,
            fits: Parts::from([(Role::VAE, vae_digest), (Role::TEXT, text_part.digest())]),
        };
        let device = cx.device().autodiff();
        let purpose = format!("{}/init", cx.task().name);
        let mut init = Init::new(cx.task().seed, &purpose, self.network.positions, &device);
        let network = Denoiser::new(&meta.config(), &mut init);
        let seed = super::dropout_seed(cx);
        let noise = Schedule::new(&self.diffusion, TIMESTEPS);
        let mut objective = Mld { settings: self.clone(), data, network, noise, seed };
        match train(&mut objective, &self.training, cx)? {
            Trained::Yielded { at } => Ok(Outcome::Yielded { at }),
            Trained::Finished { state, metrics } => {
                let trained = (&state.groups[0].entries[..], state.result(0));
                let parts = BTreeMap::from([(Role::VAE, vae_part), (Role::TEXT, text_part)]);
                let output = latent_data::publish(cx, vae.format, &meta, trained, parts)?;
                Ok(Outcome::Finished { output, metrics })
            }
        }
    }
}
