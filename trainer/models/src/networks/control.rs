//! The ControlNet of a latent denoiser: a trainable copy that adds joint targets to the frozen denoiser, block by
//! block. Source: MotionLCM (Dai et al., ECCV 2024; v2 of late 2024), after Zhang et al., arXiv:2302.05543.
//!
//! Tokens of the [trajectory encoder](super::TrajectoryEncoder) pass three Linears, with SiLU between them in v2, and
//! are added to the noised latent. The last Linear is initialised to zero. Each block output of the copy passes a
//! Linear that is initialised to zero. It is added to the output of the same block of the frozen denoiser, before that
//! output is kept for the skip connections. So nothing changes at the start, and only the zero layers get a gradient.
//! The copy has no norm at its end; its `latent_post` is copied but unused.

use burn::tensor::Tensor;
use protocol::stage::Network;

use super::{ConditionEmbedding, Denoiser, DenoiserConfig, Init, Linear};
use crate::flat;
use crate::kernels::Dropout;

/// The contribution of a ControlNet to its denoiser.
#[derive(Debug, Clone, Copy)]
pub struct Control<'a> {
    /// Residuals of each block, [B, N + 1 + L, H].
    pub residuals: &'a [Tensor<3>],
    /// Factor on the residuals; 1 as trained.
    pub scale: f64,
}

impl Denoiser {
    /// Creates a ControlNet for denoisers of `config`'s size. Its condition embedding has width `embed` and, in v2,
    /// activations.
    pub fn controlnet(config: &DenoiserConfig, embed: usize, activated: bool, init: &mut Init<'_>) -> Self {
        let mut network = Self::new(config, init);
        network.encoder.norm = None;
        network.controlnet_cond_embedding = Some(ConditionEmbedding::new(init, config.latent.dim, embed, activated));
        let Network { width, layers, .. } = config.network;
        let zero = || Linear { weight: init.constant(0.0, [width, width]), bias: Some(init.constant(0.0, [width])) };
        network.controlnet_down_mid_blocks = (0..layers).map(|_| zero()).collect();
        network
    }

    /// Computes the residuals for the blocks of the denoiser, [B, N + 1 + L, H] each. `condition_bnd` [B, N, d] are the
    /// trajectory encoder's tokens; the other arguments are the denoiser's.
    ///
    /// # Panics
    /// If this is no ControlNet.
    pub fn residuals(
        &self,
        latent_bnd: Tensor<3>,
        timesteps: &[usize],
        text_blc: Tensor<3>,
        guidance_bg: Option<Tensor<2>>,
        condition_bnd: Tensor<3>,
        dropout: &mut Dropout,
    ) -> Vec<Tensor<3>> {
        let embed = self.controlnet_cond_embedding.as_ref().expect("a ControlNet has a condition embedding");
        let latent = latent_bnd + embed.forward(condition_bnd);
        let mut residuals = Vec::with_capacity(self.controlnet_down_mid_blocks.len());
        let _unused_output = self.tokens_through(latent, timesteps, text_blc, guidance_bg, dropout, |block, x_bth| {
            residuals.push(self.controlnet_down_mid_blocks[block].forward(x_bth.clone()));
            x_bth
        });
        residuals
    }

    /// Like [`forward`](Self::forward), with a ControlNet's residuals added to the blocks' outputs.
    pub fn forward_controlled(
        &self,
        latent_bnd: Tensor<3>,
        timesteps: &[usize],
        text_blc: Tensor<3>,
        guidance_bg: Option<Tensor<2>>,
        control: Control<'_>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let add = |block: usize, x_bth: Tensor<3>| {
            let residual = control.residuals[block].clone();
            x_bth + if control.scale == 1.0 { residual } else { residual * (control.scale as f32) }
        };
        let out = self.tokens_through(latent_bnd, timesteps, text_blc, guidance_bg, dropout, add);
        match &self.latent_post {
            Some(project) => project.forward(out),
            None => out,
        }
    }
}

/// Copies every parameter that `base` and `control` share from `base`; the condition embedding and the zero layers keep
/// their own values.
pub fn copied_from(base: &Denoiser, control: Denoiser) -> Denoiser {
    let entries = flat::layout(base);
    let values = flat::read(base);
    let mut at = 0;
    let known: std::collections::BTreeMap<&str, &[f32]> = entries
        .iter()
        .map(|entry| {
            at += entry.len();
            (entry.name.as_str(), &values[at - entry.len()..at])
        })
        .collect();
    let own = flat::layout(&control);
    let mut weights = flat::read(&control);
    let mut at = 0;
    for entry in &own {
        let to = &mut weights[at..at + entry.len()];
        at += entry.len();
        if let Some(from) = known.get(entry.name.as_str()).filter(|from| from.len() == to.len()) {
            to.copy_from_slice(from);
        }
    }
    flat::write(control, &weights)
}
