//! Diffusion of motion itself: the common part of `train.mdm` and `train.stablemofusion`. Sources: MDM
//! (arXiv:2209.14916), StableMoFusion (arXiv:2405.05691), with the losses of Free-T2M as an option.
//!
//! `t ~ U{0..T-1}`, `x_t = alpha_t x_0 + sigma_t eps` on normalised features, loss
//! `mean over a clip's own frames of (x_0 hat - x_0)^2` (of the noise or the velocity, according to `diffusion`). A
//! caption is dropped with probability `guidance_dropout`: MDM then reads a zero vector, StableMoFusion skips its
//! cross-attention.

use std::collections::BTreeMap;

use burn::tensor::Device;
use checkpoint::model::Parts;
use models::diffusion::{Schedule, affine, unzip};
use models::kernels::Dropout;
use models::losses::{FrameWeights, Pointwise};
use models::networks::Init;
use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::{FrequencyLosses, Positions, StageSpec, Training};

use super::data::features::{FeatureData, Rules};
use super::frequency::{FrequencyTerms, LOW_FREQUENCY, Predicted, SEMANTIC, clean};
use super::network::{dropout_seed, group, slice_result};
use super::{Average, GroupPlan, Losses, Objective, SliceResult, TrainState, train};
use crate::artifacts::{Draft, to_meta};
use crate::context::{GangContext, Outcome, StageError};
use crate::generate::generator::FEATURE_DIFFUSION;
use crate::parts::motion_networks::{Architecture, MotionDenoiserMeta, MotionNetwork};
use crate::parts::warm_start::WarmStart;
use crate::parts::{self, weights};

/// Name of the loss term that every diffusion has.
const DENOISING: &str = "denoising";

struct Features<N> {
    data: FeatureData,
    network: N,
    noise: Schedule,
    terms: Option<FrequencyTerms>,
    training: Training,
    average: Option<Average>,
    masked: bool,
    guidance_dropout: f64,
    dropout: f64,
    seed: u64,
    device: Device,
}

impl<N: MotionNetwork> Objective for Features<N> {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![GroupPlan { average: self.average, ..group("model", &self.network, &self.training, 0.0) }]
    }

    fn terms(&self) -> Vec<&'static str> {
        let mut terms = vec![Losses::TOTAL];
        if self.terms.is_some() {
            terms.extend([DENOISING, LOW_FREQUENCY, SEMANTIC]);
        }
        terms
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.network);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.data.slice(step, slice, self.noise.steps(), self.guidance_dropout)?;
        let (a, e) = unzip(batch.timesteps.iter().map(|t| self.noise.add_noise(*t)));
        let noisy = affine(batch.clean_btf.clone(), batch.noise_btf.clone(), &a, &e);
        let mut dropout = Dropout::new(self.dropout, self.seed, step, slice as u64);
        let condition = self.network.condition(&batch.captions, self.data.text_dim(), &self.device, &mut dropout);
        let lengths = self.masked.then_some(&batch.lengths[..]);
        let out = self.network.predict(noisy.clone(), &batch.timesteps, Some(&condition), lengths, &mut dropout);

        let global = self.training.batch.global;
        let mut losses = Losses::new(global);
        let target = self.noise.target(batch.clean_btf.clone(), batch.noise_btf, &batch.timesteps);
        let weights = FrameWeights::masked(&batch.lengths, target.dims()[1], &self.device);
        losses.add(DENOISING, weights.compare(Pointwise::L2, out.clone(), target), 1.0);
        if let Some(terms) = &self.terms {
            let predicted = Predicted {
                found: clean(&self.noise, noisy, out, &batch.timesteps),
                target: batch.clean_btf,
                lengths: &batch.lengths,
                timesteps: &batch.timesteps,
                batch_timesteps: &batch.batch_timesteps,
            };
            terms.add(&mut losses, &predicted, global);
        }
        slice_result(&self.network, &losses, &self.terms())
    }
}

/// Differences between the two kinds.
pub(crate) struct Recipe<'a> {
    pub(crate) architecture: Architecture,
    pub(crate) rules: Rules,
    pub(crate) masked: bool,
    pub(crate) guidance_dropout: f64,
    pub(crate) dropout: f64,
    pub(crate) average: Option<Average>,
    pub(crate) diffusion: &'a protocol::stage::Diffusion,
    pub(crate) losses: &'a FrequencyLosses,
    pub(crate) training: &'a Training,
    pub(crate) family: protocol::stage::Family,
}

/// Trains the network of `make` by the recipe.
pub(crate) fn run<N: MotionNetwork>(
    cx: &mut dyn GangContext,
    recipe: Recipe<'_>,
    make: impl FnOnce(&MotionDenoiserMeta, &mut Init<'_>) -> N,
) -> Result<Outcome, StageError> {
    let data = FeatureData::read(cx, recipe.training, recipe.rules)?;
    let text_part = data.text_encoder(cx)?;
    let meta = MotionDenoiserMeta {
        family: recipe.family,
        architecture: recipe.architecture,
        format: data.dataset().format,
        diffusion: recipe.diffusion.clone(),
        mask_frames: recipe.masked,
        max_frames: recipe.rules.max_frames,
        mean: data.dataset().mean.clone(),
        std: data.std().to_vec(),
        text_dim: data.text_dim(),
        fits: Parts::from([(Role::TEXT, text_part.digest())]),
    };
    let noise = Schedule::new(&meta.diffusion, meta.timesteps()?);
    let statistics = (&meta.mean[..], &meta.std[..]);
    let terms = FrequencyTerms::read(cx, recipe.losses, &noise, meta.format, statistics)?;
    let tracked = cx.device().autodiff();
    let purpose = format!("{}/init", cx.task().name);
    let mut init = Init::new(cx.task().seed, &purpose, Positions::Uniform, &tracked);
    let network = WarmStart::begin(cx, ArtifactKind::Denoiser, make(&meta, &mut init), &meta)?;
    let mut objective = Features {
        data,
        network,
        noise,
        terms,
        training: recipe.training.clone(),
        average: recipe.average,
        masked: recipe.masked,
        guidance_dropout: recipe.guidance_dropout,
        dropout: recipe.dropout,
        seed: dropout_seed(cx),
        device: cx.device(),
    };
    train(&mut objective, recipe.training, cx)?.publish(|state| {
        let mut denoiser = Draft::new(cx, ArtifactKind::Denoiser, to_meta(&meta));
        weights::add(&mut denoiser, state.trained(0))?;
        let parts = BTreeMap::from([(Role::DENOISER, denoiser.into_manifest()), (Role::TEXT, text_part)]);
        parts::publish_model(cx, FEATURE_DIFFUSION, meta.format, &parts)
    })
}

/// The family of the models of `settings`.
pub(crate) fn family(settings: &impl StageSpec) -> Result<protocol::stage::Family, StageError> {
    settings.family().ok_or_else(|| StageError::Fault("a kind that trains a model has a family".into()))
}
