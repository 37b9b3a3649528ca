//! The motion VAE. Source: MLD (Chen et al., arXiv:2212.04048) with one 256-wide latent token, and MotionLCM v2 with 16
//! tokens of 32 and a projection on either side of the bottleneck.
//!
//! 2N learned tokens precede the frames. After the encoder the first N of them are means and the next N log-variances.
//! The decoder's queries are positions alone; its memory is the N latent tokens, without positions of their own.

use burn::module::{Module, Param};
use burn::tensor::{Tensor, TensorData};
use protocol::stage::{LatentShape, Network};

use super::{Init, Linear, POSITIONS, SkipStack, StackConfig};
use crate::kernels::{Dropout, KeyMask};

/// Size of a VAE.
#[derive(Debug, Clone, PartialEq)]
pub struct VaeConfig {
    /// Features per frame: 263 or 251.
    pub features: usize,
    /// Shape N x d of a latent.
    pub latent: LatentShape,
    /// Size of each of encoder and decoder, whose dropout is an argument of each pass.
    pub network: Network,
    /// Adds linear layers around the bottleneck (v2); without them d is H (v1).
    pub projection: bool,
}

/// A diagonal normal distribution over latents.
#[derive(Debug, Clone)]
pub struct Posterior {
    /// Means [B, N, d].
    pub mu_bnd: Tensor<3>,
    /// Logarithms of variances [B, N, d].
    pub logvar_bnd: Tensor<3>,
}

impl Posterior {
    /// Computes `mu + exp(logvar / 2) noise`, with `noise` standard normal [B, N, d].
    pub fn sample(&self, noise_bnd: Tensor<3>) -> Tensor<3> {
        self.mu_bnd.clone() + self.sigma() * noise_bnd
    }

    /// Standard deviations [B, N, d].
    pub fn sigma(&self) -> Tensor<3> {
        (self.logvar_bnd.clone() * 0.5).exp()
    }
}

/// A learned position table.
#[derive(Module, Debug)]
pub struct Positions {
    /// Table of shape [rows, 1, H].
    pub pe: Param<Tensor<3>>,
}

impl Positions {
    pub(super) fn new(init: &mut Init<'_>, width: usize) -> Self {
        Self { pe: init.positions(POSITIONS, width) }
    }

    /// The first `len` rows as [1, len, H].
    pub(super) fn rows(&self, len: usize) -> Tensor<3> {
        let [rows, one, width] = self.pe.dims();
        assert!(len <= rows, "a sequence of {len} tokens is longer than the position table of {rows} rows");
        self.pe.val().slice([0..len, 0..one, 0..width]).swap_dims(0, 1)
    }
}

/// The VAE's layers under their published names.
#[derive(Module, Debug)]
pub struct Vae {
    /// Learned tokens [2N, H].
    pub global_motion_token: Param<Tensor<2>>,
    /// Features -> H.
    pub skel_embedding: Linear,
    /// Positions of tokens and frames.
    pub query_pos_encoder: Positions,
    /// Positions of the queries.
    pub query_pos_decoder: Positions,
    pub encoder: SkipStack,
    pub decoder: SkipStack,
    /// H -> d (v2).
    pub latent_pre: Option<Linear>,
    /// d -> H (v2).
    pub latent_post: Option<Linear>,
    /// H -> features.
    pub final_layer: Linear,
    tokens: usize,
}

impl Vae {
    /// Creates a VAE with initial weights.
    pub fn new(config: &VaeConfig, init: &mut Init<'_>) -> Self {
        let VaeConfig { features, latent: LatentShape { tokens, dim }, .. } = *config;
        let width = config.network.width;
        let stack = |memory| StackConfig { memory, ..StackConfig::of(&config.network) };
        Self {
            global_motion_token: init.normal([2 * tokens, width]),
            skel_embedding: Linear::new(init, features, width),
            query_pos_encoder: Positions::new(init, width),
            query_pos_decoder: Positions::new(init, width),
            encoder: SkipStack::new(init, &stack(false)),
            decoder: SkipStack::new(init, &stack(true)),
            latent_pre: config.projection.then(|| Linear::new(init, width, dim)),
            latent_post: config.projection.then(|| Linear::new(init, dim, width)),
            final_layer: Linear::new(init, width, features),
            tokens,
        }
    }

    /// Encodes normalised `features_btf` [B, T, F]; the first `lengths[b]` frames of clip b are valid.
    pub fn encode(&self, features_btf: Tensor<3>, lengths: &[usize], dropout: &mut Dropout) -> Posterior {
        let [batch, frames, _] = features_btf.dims();
        let [count, width] = self.global_motion_token.dims();
        let tokens = self.global_motion_token.val().reshape([1, count, width]).expand([batch, count, width]);
        let embedded = self.skel_embedding.forward(features_btf);
        let x = Tensor::cat(vec![tokens, embedded], 1) + self.query_pos_encoder.rows(count + frames);
        let mask = KeyMask::new(lengths, count);
        let out = self.encoder.forward(x, None, Some(&mask), dropout).slice([0..batch, 0..count, 0..width]);
        let out = match &self.latent_pre {
            Some(project) => project.forward(out),
            None => out,
        };
        let dim = out.dims()[2];
        Posterior {
            mu_bnd: out.clone().slice([0..batch, 0..self.tokens, 0..dim]),
            logvar_bnd: out.slice([0..batch, self.tokens..count, 0..dim]),
        }
    }

    /// Decodes `latent_bnd` [B, N, d] into normalised features [B, frames, F]; frames past `lengths[b]` are exactly 0.
    pub fn decode(&self, latent_bnd: Tensor<3>, lengths: &[usize], frames: usize, dropout: &mut Dropout) -> Tensor<3> {
        let batch = latent_bnd.dims()[0];
        let device = latent_bnd.device();
        let memory = match &self.latent_post {
            Some(project) => project.forward(latent_bnd),
            None => latent_bnd,
        };
        let rows = self.query_pos_decoder.rows(frames);
        let width = rows.dims()[2];
        let mask = KeyMask::new(lengths, 0);
        let x = self.decoder.forward(rows.expand([batch, frames, width]), Some(&memory), Some(&mask), dropout);
        let out = self.final_layer.forward(x);
        if lengths.iter().all(|l| *l == frames) {
            return out;
        }
        let live = lengths.iter().flat_map(|l| (0..frames).map(move |t| if t < *l { 1.0_f32 } else { 0.0 })).collect();
        out * Tensor::from_data(TensorData::new(live, [batch, frames, 1]), &device)
    }
}
