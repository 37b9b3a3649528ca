//! `train.mld`: the latent-diffusion teacher. Source: MLD (arXiv:2212.04048), MotionLCM v2's recipe.
//!
//! `t ~ U{0..999}`, `z_t = alpha_t z_0 + sigma_t eps`, loss `mean (eps_hat(z_t, t, c) - eps)^2` (of the sample or the
//! velocity, according to `diffusion`). The caption is replaced by the empty one with probability `guidance_dropout`.
//! Latents are samples of their posteriors, unscaled.
//!
//! Free-T2M's losses apply to motion: for a part of the batch the predicted clean latent is decoded by the frozen
//! decoder, and compared with the decoded true latent. Departs: the paper has no latent host; the VAE's own error is
//! not counted here.

use std::collections::BTreeMap;

use burn::tensor::{Int, Tensor, TensorData};
use checkpoint::model::Parts;
use models::diffusion::{Schedule, TIMESTEPS, affine, unzip};
use models::kernels::Dropout;
use models::losses;
use models::networks::{Denoiser, Init};
use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::{Family, TrainMld};

use crate::artifacts::{self, DenoiserMeta, VaeMeta};
use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::latent_networks::Autoencoder;
use crate::parts::warm_start::WarmStart;
use crate::train::data::latents::{self, LatentData};
use crate::train::frequency::{FrequencyTerms, LOW_FREQUENCY, Predicted, SEMANTIC, clean};
use crate::train::network::{dropout_seed, group, slice_result};
use crate::train::{GroupPlan, Losses, Objective, Pick, SliceResult, TrainState, train};

/// Name of the loss term that every latent diffusion has.
const DENOISING: &str = "denoising";

/// Free-T2M's terms, and their frozen decoder.
struct Decoded {
    terms: FrequencyTerms,
    vae: Autoencoder,
}

struct Mld {
    settings: TrainMld,
    decoded: Option<Decoded>,
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
        let mut terms = vec![Losses::TOTAL];
        if self.decoded.is_some() {
            terms.extend([DENOISING, LOW_FREQUENCY, SEMANTIC]);
        }
        terms
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.network);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.data.slice(step, slice, self.settings.guidance_dropout);
        let timesteps: Vec<usize> = batch.picks.iter().map(|pick| self.timestep(*pick)).collect();
        let noise = self.data.noise("noise", &batch.picks);
        let (a, e) = unzip(timesteps.iter().map(|t| self.noise.add_noise(*t)));
        let noisy = affine(batch.clean_bnd.clone(), noise.clone(), &a, &e);
        let target = self.noise.target(batch.clean_bnd.clone(), noise, &timesteps);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.seed, step, slice as u64);
        let predicted = self.network.forward(noisy.clone(), &timesteps, batch.text_blc, None, &mut dropout);
        let mut all = Losses::new(self.settings.training.batch.global);
        all.add(DENOISING, losses::mse(predicted.clone(), target), 1.0);
        let whole = self.data.picks(step);
        if let Some(decoded) = &self.decoded {
            let found = clean(&self.noise, noisy, predicted, &timesteps);
            let chosen = self.chosen(decoded, &whole);
            decoded.add(&mut all, &chosen, (&batch.picks, &batch.lengths), found, batch.clean_bnd);
        }
        slice_result(&self.network, &all, &self.terms())
    }
}

impl Mld {
    fn timestep(&self, pick: Pick) -> usize {
        self.data.stream("timestep", pick).below(TIMESTEPS)
    }

    /// Places of the batch whose latents are decoded, with their timesteps and the number of samples in the batch.
    fn chosen(&self, decoded: &Decoded, batch: &[Pick]) -> Chosen {
        let drawn = |pick: &&Pick| self.data.stream("decoded", **pick).chance(self.settings.decoded);
        let timed = batch.iter().filter(drawn).map(|pick| (pick.place, self.timestep(*pick)));
        Chosen { timesteps: timed.filter(|(_, t)| decoded.terms.acts(*t)).collect(), global: batch.len() }
    }
}

/// The decoded part of a batch.
struct Chosen {
    timesteps: BTreeMap<u64, usize>,
    global: usize,
}

impl Decoded {
    fn add(
        &self,
        losses: &mut Losses,
        chosen: &Chosen,
        (picks, lengths): (&[Pick], &[usize]),
        found_bnd: Tensor<3>,
        clean_bnd: Tensor<3>,
    ) {
        let rows: Vec<usize> = (0..picks.len()).filter(|b| chosen.timesteps.contains_key(&picks[*b].place)).collect();
        if rows.is_empty() {
            return;
        }
        let indices: Vec<i64> = rows.iter().map(|b| *b as i64).collect();
        let lengths: Vec<usize> = rows.iter().map(|b| lengths[*b]).collect();
        let decode = |z: Tensor<3>| {
            let indices = Tensor::<1, Int>::from_data(TensorData::new(indices.clone(), [rows.len()]), &z.device());
            self.vae.decode_tensor(z.select(0, indices), &lengths)
        };
        let timesteps: Vec<usize> = rows.iter().map(|b| chosen.timesteps[&picks[*b].place]).collect();
        let batch_timesteps: Vec<usize> = chosen.timesteps.values().copied().collect();
        let predicted = Predicted {
            found: decode(found_bnd),
            target: decode(clean_bnd),
            lengths: &lengths,
            timesteps: &timesteps,
            batch_timesteps: &batch_timesteps,
        };
        self.terms.add(losses, &predicted, chosen.global);
    }
}

impl Gang for TrainMld {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let data = LatentData::read(cx, &self.training, 1)?;
        let (vae_digest, vae_part) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
        let vae: VaeMeta = artifacts::meta(&vae_part, "the VAE")?;
        let text_part = data.text_encoder(cx)?;
        if data.vae() != vae_digest || data.meta().latent != vae.latent {
            return Err(StageError::Input(format!(
                "`latents` were encoded with another VAE ({} x {} latents) than `vae` ({} x {}); use the VAE that \
                 encoded them",
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
            projection: None,
            time_dim: None,
        };
        let device = cx.device().autodiff();
        let purpose = format!("{}/init", cx.task().name);
        let mut init = Init::new(cx.task().seed, &purpose, self.network.positions, &device);
        let network = Denoiser::new(&meta.config(), &mut init);
        let network = WarmStart::begin(cx, ArtifactKind::Denoiser, network, &meta)?;
        let seed = dropout_seed(cx);
        let noise = Schedule::new(&self.diffusion, TIMESTEPS);
        let statistics = (&vae.mean[..], &vae.std[..]);
        let terms = FrequencyTerms::read(cx, &self.losses, &noise, vae.format, statistics)?;
        let decoded = match terms {
            Some(terms) => Some(Decoded { terms, vae: Autoencoder::read(&*cx.blobs(), &vae_part, &cx.device())? }),
            None => None,
        };
        let mut objective = Mld { settings: self.clone(), decoded, data, network, noise, seed };
        train(&mut objective, &self.training, cx)?.publish(|state| {
            let parts = BTreeMap::from([(Role::VAE, vae_part), (Role::TEXT, text_part)]);
            latents::publish(cx, vae.format, &meta, state.trained(0), parts)
        })
    }
}
