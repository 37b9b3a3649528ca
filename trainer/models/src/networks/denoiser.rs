//! The latent denoiser: predicts the noise in a latent from the latent, a timestep and a caption embedding. Source: MLD
//! (v1: ReLU on the text, d = H), MotionLCM v2 (no ReLU, projections), and LCM's guidance embedding (Luo et al.,
//! arXiv:2310.04378).
//!
//! The sequence is N latent tokens, one time token and the text tokens, with learned positions. A skip encoder follows,
//! and its first N outputs are the prediction. The motion's length is no input here; only the VAE's decoder uses it.

use burn::module::Module;
use burn::tensor::Tensor;
use burn::tensor::activation::{relu, silu};
use protocol::stage::{LatentShape, Network};

use super::vae::Positions;
use super::{ConditionEmbedding, Init, Linear, SkipStack, StackConfig, time_sinusoid};
use crate::kernels::Dropout;

/// Size of a denoiser.
#[derive(Debug, Clone, PartialEq)]
pub struct DenoiserConfig {
    /// Shape N x d of a latent.
    pub latent: LatentShape,
    /// Size of the transformer, whose dropout is an argument of each pass.
    pub network: Network,
    /// Width of a caption embedding.
    pub text_dim: usize,
    /// Width of the time sinusoid.
    pub time_dim: usize,
    /// Applies ReLU to the text (v1).
    pub text_relu: bool,
    /// Adds linear layers d -> H and back (v2); without them d is H (v1).
    pub projection: bool,
    /// Width of a student's guidance embedding.
    pub guidance_dim: Option<usize>,
}

/// Two layers on the time sinusoid.
#[derive(Module, Debug)]
pub struct TimeEmbedding {
    /// time_dim -> H.
    pub linear_1: Linear,
    /// guidance_dim -> time_dim, no bias, initialised to zero.
    pub cond_proj: Option<Linear>,
    /// H -> H.
    pub linear_2: Linear,
}

/// The denoiser's layers under their published names.
#[derive(Module, Debug)]
pub struct Denoiser {
    /// d -> H (v2).
    pub latent_pre: Option<Linear>,
    /// H -> d (v2).
    pub latent_post: Option<Linear>,
    /// Layers of the time token.
    pub time_embedding: TimeEmbedding,
    /// text_dim -> H; published as `emb_proj.1`.
    pub emb_proj: Linear,
    /// Positions of all tokens.
    pub query_pos: Positions,
    pub encoder: SkipStack,
    /// Layers for a ControlNet's condition.
    pub controlnet_cond_embedding: Option<ConditionEmbedding>,
    /// Layers for a ControlNet's block outputs; empty in a denoiser.
    pub controlnet_down_mid_blocks: Vec<Linear>,
    tokens: usize,
    time_dim: usize,
    text_relu: bool,
}

impl Denoiser {
    /// Creates a denoiser with initial weights.
    pub fn new(config: &DenoiserConfig, init: &mut Init<'_>) -> Self {
        let DenoiserConfig { latent: LatentShape { tokens, dim }, text_dim, time_dim, .. } = *config;
        let width = config.network.width;
        Self {
            latent_pre: config.projection.then(|| Linear::new(init, dim, width)),
            latent_post: config.projection.then(|| Linear::new(init, width, dim)),
            time_embedding: TimeEmbedding {
                linear_1: Linear::new(init, time_dim, width),
                cond_proj: config.guidance_dim.map(|guidance| Linear::zero(init, guidance, time_dim)),
                linear_2: Linear::new(init, width, width),
            },
            emb_proj: Linear::new(init, text_dim, width),
            query_pos: Positions::new(init, width),
            encoder: SkipStack::new(init, &StackConfig::of(&config.network)),
            controlnet_cond_embedding: None,
            controlnet_down_mid_blocks: Vec::new(),
            tokens,
            time_dim,
            text_relu: config.text_relu,
        }
    }

    /// The time token [B, H] before positions are added.
    ///
    /// # Panics
    /// If a guidance embedding is given to a network without a layer for it.
    pub fn time_token(
        &self,
        timesteps: &[usize],
        guidance_bg: Option<Tensor<2>>,
        device: &burn::tensor::Device,
    ) -> Tensor<2> {
        let mut sinusoid = time_sinusoid(timesteps, self.time_dim, device);
        if let Some(guidance) = guidance_bg {
            let project = self.time_embedding.cond_proj.as_ref().expect("a teacher takes no guidance embedding");
            sinusoid = sinusoid + project.forward(guidance);
        }
        self.time_embedding.linear_2.forward(silu(self.time_embedding.linear_1.forward(sinusoid)))
    }

    /// Predicts the noise [B, N, d]. `latent_bnd` [B, N, d]; one timestep per sample; `text_blc` [B, L, text_dim];
    /// `guidance_bg` [B, guidance_dim] for a student.
    pub fn forward(
        &self,
        latent_bnd: Tensor<3>,
        timesteps: &[usize],
        text_blc: Tensor<3>,
        guidance_bg: Option<Tensor<2>>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let out = self.tokens_through(latent_bnd, timesteps, text_blc, guidance_bg, dropout, |_, x| x);
        match &self.latent_post {
            Some(project) => project.forward(out),
            None => out,
        }
    }

    /// The outputs of every block on the N latent tokens, [B, N, H] each, for a discriminator.
    pub fn features(
        &self,
        latent_bnd: Tensor<3>,
        timesteps: &[usize],
        text_blc: Tensor<3>,
        dropout: &mut Dropout,
    ) -> Vec<Tensor<3>> {
        let mut seen = Vec::new();
        let _unused_output = self.tokens_through(latent_bnd, timesteps, text_blc, None, dropout, |_, x_bth| {
            let [batch, _, width] = x_bth.dims();
            seen.push(x_bth.clone().slice([0..batch, 0..self.tokens, 0..width]));
            x_bth
        });
        seen
    }

    /// The first N outputs of the transformer [B, N, H]; `pass` replaces the output of every block.
    pub(super) fn tokens_through(
        &self,
        latent_bnd: Tensor<3>,
        timesteps: &[usize],
        text_blc: Tensor<3>,
        guidance_bg: Option<Tensor<2>>,
        dropout: &mut Dropout,
        pass: impl FnMut(usize, Tensor<3>) -> Tensor<3>,
    ) -> Tensor<3> {
        let [batch, tokens, _] = latent_bnd.dims();
        assert_eq!(timesteps.len(), batch, "one timestep a sample");
        let device = self.emb_proj.weight.val().device();
        let latent = match &self.latent_pre {
            Some(project) => project.forward(latent_bnd),
            None => latent_bnd,
        };
        let width = latent.dims()[2];
        let time = self.time_token(timesteps, guidance_bg, &device).reshape([batch, 1, width]);
        let text = if self.text_relu { relu(text_blc) } else { text_blc };
        let text = self.emb_proj.forward(text);
        let x = Tensor::cat(vec![latent, time, text], 1);
        let len = x.dims()[1];
        let x = x + self.query_pos.rows(len);
        self.encoder.forward_blocks(x, None, None, dropout, pass).slice([0..batch, 0..tokens, 0..width])
    }
}
