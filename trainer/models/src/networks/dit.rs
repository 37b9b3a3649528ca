//! The second vector field of DisCoRD's code, a transformer with adaptive norms; no released configuration uses it.
//! Source: DisCoRD (Cho et al., arXiv:2411.19527), after DiT (Peebles and Xie, arXiv:2212.09748) and ALiBi (Press et
//! al., arXiv:2108.12409).
//!
//! Departs: the published state holds an unused norm and, with sinusoidal positions, their constant table; here they
//! are not parameters.

#![allow(non_snake_case, reason = "published names")]

use burn::module::{Module, Param};
use burn::tensor::activation::{gelu_approximate, silu};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use super::attend::{attend, hiding, sinusoids};
use super::conv::{GAP, Gap};
use super::{Init, Linear, time_sinusoid_f32};
use crate::kernels::{self, Dropout};

/// Frames per token.
const UNIT: usize = 4;
/// Added to variances in norms.
const EPS: f64 = 1e-6;
/// Width of the time's sinusoid.
const FREQUENCIES: usize = 256;
/// Probability that a weight of an attention is dropped in training, fixed upstream.
pub const ATTENTION_DROPOUT: f64 = 0.1;

/// Size of the network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DitConfig {
    /// Features per frame.
    pub features: usize,
    pub width: usize,
    /// Width of a token.
    pub token_dim: usize,
    /// Width of the condition on a frame.
    pub condition_dim: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Feed-forward width as a multiple of H.
    pub rate: usize,
    /// Number of blocks.
    pub layers: usize,
    /// Adds fixed positions.
    pub positions: bool,
    /// Lowers scores with the distance between frames (ALiBi).
    pub alibi: bool,
    /// Width of a caption embedding that is added to the time's embedding.
    pub text_dim: Option<usize>,
}

/// Attention with one packed projection for queries, keys and values.
#[derive(Module, Debug)]
pub struct DitAttention {
    /// Weights of shape [3H, H].
    pub in_proj_weight: Param<Tensor<2>>,
    /// Bias of shape [3H].
    pub in_proj_bias: Param<Tensor<1>>,
    /// H -> H.
    pub out_proj: Linear,
    heads: usize,
}

/// The feed-forward of two layers.
#[derive(Module, Debug)]
pub struct DitMlp {
    /// H -> feed-forward width.
    pub fc1: Linear,
    /// Feed-forward width -> H.
    pub fc2: Linear,
}

/// A block whose norms and residual outputs are scaled and shifted by the time.
#[derive(Module, Debug)]
pub struct DitBlock {
    pub attn: DitAttention,
    pub mlp: DitMlp,
    /// Time -> shift, scale and gate of both layers, after a SiLU.
    pub adaLN_modulation: (Gap, Linear),
}

/// `(1 + scale) LN(x) + shift`, the norm without gains.
fn modulated(x_bth: Tensor<3>, shift: Tensor<3>, scale: Tensor<3>) -> Tensor<3> {
    let width = x_bth.dims()[2];
    let device = x_bth.device();
    let normed = kernels::layer_norm(x_bth, Tensor::ones([width], &device), Tensor::zeros([width], &device), EPS);
    normed * (scale + 1.0) + shift
}

/// `parts` pieces [B, 1, H] of [B, parts H].
fn pieces(x_bc: Tensor<2>, parts: usize) -> Vec<Tensor<3>> {
    let [batch, all] = x_bc.dims();
    let width = all / parts;
    let piece = |i: usize| x_bc.clone().slice([0..batch, i * width..(i + 1) * width]).reshape([batch, 1, width]);
    (0..parts).map(piece).collect()
}

impl DitBlock {
    fn new(config: &DitConfig, init: &mut Init<'_>) -> Self {
        let DitConfig { width, heads, rate, .. } = *config;
        Self {
            attn: DitAttention {
                in_proj_weight: init.xavier(3 * width, width),
                in_proj_bias: init.constant(0.0, [3 * width]),
                out_proj: still(init, width, width),
                heads,
            },
            mlp: DitMlp { fc1: still(init, width, rate * width), fc2: still(init, rate * width, width) },
            adaLN_modulation: (GAP, zero(init, width, 6 * width)),
        }
    }

    fn forward(
        &self,
        x_bth: Tensor<3>,
        time_bh: &Tensor<2>,
        bias: Option<&Tensor<4>>,
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let mut parts = pieces(self.adaLN_modulation.1.forward(silu(time_bh.clone())), 6).into_iter();
        let mut next = || parts.next().expect("six parts");
        let shift = next();
        let scale = next();
        let gate = next();
        let x = x_bth.clone() + gate * self.attended(modulated(x_bth, shift, scale), bias, drop);
        let shift = next();
        let scale = next();
        let gate = next();
        let hidden = gelu_approximate(self.mlp.fc1.forward(modulated(x.clone(), shift, scale)));
        x + gate * self.mlp.fc2.forward(hidden)
    }

    fn attended(&self, x_bth: Tensor<3>, bias: Option<&Tensor<4>>, drop: &mut Dropout) -> Tensor<3> {
        let [batch, len, width] = x_bth.dims();
        let attn = &self.attn;
        let qkv = kernels::linear(x_bth, attn.in_proj_weight.val(), Some(attn.in_proj_bias.val()));
        let attended = match bias {
            None => kernels::self_attention(qkv, attn.heads, None, drop),
            Some(bias) => {
                let part = |i: usize| qkv.clone().slice([0..batch, 0..len, i * width..(i + 1) * width]);
                attend(part(0), part(1), part(2), attn.heads, Some(bias.clone()), drop)
            }
        };
        attn.out_proj.forward(attended)
    }
}

/// A Linear with Xavier-uniform weights and a bias of zeros.
fn still(init: &mut Init<'_>, inner: usize, out: usize) -> Linear {
    Linear { weight: init.xavier(out, inner), bias: Some(init.constant(0.0, [out])) }
}

/// A Linear of zeros: a block adds nothing at the start.
fn zero(init: &Init<'_>, inner: usize, out: usize) -> Linear {
    Linear { weight: init.constant(0.0, [out, inner]), bias: Some(init.constant(0.0, [out])) }
}

/// Linear, SiLU, Linear on the time's sinusoid.
#[derive(Module, Debug)]
pub struct TimeEmbedder {
    /// Linear, SiLU, Linear under upstream's numbers.
    pub mlp: (Linear, Gap, Linear),
}

/// The output layer, with an adaptive norm.
#[derive(Module, Debug)]
pub struct DitOut {
    /// H -> features.
    pub linear: Linear,
    /// SiLU, then a linear map from the time embedding to shift and scale.
    pub adaLN_modulation: (Gap, Linear),
}

/// The network's parts. All published names have the prefix `net`.
#[derive(Module, Debug)]
pub struct DitParts {
    /// Motion and condition -> H.
    pub in_proj: Linear,
    /// Tokens, repeated four times and stacked, -> condition.
    pub cin_proj: (Gap, Linear, Gap, Linear),
    /// Time -> H.
    pub t_embedder: TimeEmbedder,
    /// Caption -> H.
    pub text_embed: Option<Linear>,
    pub blocks: Vec<DitBlock>,
    /// H -> features.
    pub out_proj: DitOut,
}

/// The vector field.
#[derive(Module, Debug)]
pub struct FlowDit {
    /// The whole network, under the prefix of the published names.
    pub net: DitParts,
    heads: usize,
    positions: bool,
    alibi: bool,
}

impl FlowDit {
    /// Creates a network: Xavier-uniform, with zeros in the modulation by time and in the last layer.
    pub fn new(config: &DitConfig, init: &mut Init<'_>) -> Self {
        let DitConfig { features, width, token_dim, condition_dim, .. } = *config;
        let mut time = |inner: usize| Linear {
            weight: init.scaled_normal(0.02, [width, inner]),
            bias: Some(init.constant(0.0, [width])),
        };
        let mlp = (time(FREQUENCIES), GAP, time(width));
        Self {
            net: DitParts {
                in_proj: still(init, features + condition_dim, width),
                cin_proj: (
                    GAP,
                    still(init, UNIT * token_dim, UNIT * token_dim),
                    GAP,
                    still(init, token_dim, condition_dim),
                ),
                t_embedder: TimeEmbedder { mlp },
                text_embed: config.text_dim.map(|text| still(init, text, width)),
                blocks: (0..config.layers).map(|_| DitBlock::new(config, init)).collect(),
                out_proj: DitOut {
                    linear: zero(init, width, features),
                    adaLN_modulation: (GAP, zero(init, width, 2 * width)),
                },
            },
            heads: config.heads,
            positions: config.positions,
            alibi: config.alibi,
        }
    }

    /// Computes the condition on each frame, [B, n, token] -> [B, 4 n, condition].
    pub fn condition(&self, tokens_bnc: Tensor<3>) -> Tensor<3> {
        let [batch, tokens, dim] = tokens_bnc.dims();
        let stacked = self.net.cin_proj.1.forward(Tensor::cat(vec![tokens_bnc; UNIT], 2));
        self.net.cin_proj.3.forward(stacked.reshape([batch, UNIT * tokens, dim]))
    }

    /// Encodes the time as [B, H], without a caption's embedding.
    pub fn time(&self, times: &[f32], device: &Device) -> Tensor<2> {
        let (first, _, second) = &self.net.t_embedder.mlp;
        second.forward(silu(first.forward(time_sinusoid_f32(times, FREQUENCIES, device))))
    }

    /// The velocity [B, T, F] of `x_btf` [B, T, F] at `times` given `tokens_bnc` [B, T / 4, token], and a caption
    /// `text_bc` [B, C] if the network has a layer for it. Frames of clip b past `lengths[b]` are computed but not
    /// attended to.
    ///
    /// # Panics
    /// If there is not one token for every four frames, or the caption does not match the network: given without a
    /// layer for it, or missing with one.
    pub fn forward(
        &self,
        x_btf: Tensor<3>,
        times: &[f32],
        tokens_bnc: Tensor<3>,
        text_bc: Option<Tensor<2>>,
        lengths: Option<&[usize]>,
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let [batch, frames, _] = x_btf.dims();
        assert_eq!(UNIT * tokens_bnc.dims()[1], frames, "a token for every {UNIT} frames");
        let device = x_btf.device();
        let condition = self.condition(tokens_bnc);
        let mut x = self.net.in_proj.forward(Tensor::cat(vec![x_btf, condition], 2));
        let width = x.dims()[2];
        if self.positions {
            x = x + sinusoids(frames, width, &device);
        }
        let time = match (&self.net.text_embed, text_bc) {
            (None, None) => self.time(times, &device),
            (Some(layer), Some(text)) => self.time(times, &device) + layer.forward(text),
            _ => panic!("a caption for a network that takes one, and for no other"),
        };
        let mut bias = self.alibi.then(|| falling(self.heads, frames, &device));
        if let Some(lengths) = lengths {
            let visible: Vec<bool> = lengths.iter().flat_map(|len| (0..frames).map(move |t| t < *len)).collect();
            let hidden = hiding(&visible, batch, &device);
            bias = Some(match bias {
                Some(bias) => bias + hidden,
                None => hidden,
            });
        }
        let blocks = self.net.blocks.iter();
        let x = blocks.fold(x, |x, block| block.forward(x, &time, bias.as_ref(), drop));
        let out = &self.net.out_proj;
        let mut parts = pieces(out.adaLN_modulation.1.forward(silu(time)), 2).into_iter();
        let mut next = || parts.next().expect("two parts");
        let shift = next();
        let scale = next();
        out.linear.forward(modulated(x, shift, scale))
    }
}

/// `-slope_h |i - j|`, [1, heads, len, len].
pub fn falling(heads: usize, len: usize, device: &Device) -> Tensor<4> {
    let values = slopes(heads)
        .into_iter()
        .flat_map(|slope| (0..len).flat_map(move |i| (0..len).map(move |j| -slope * i.abs_diff(j) as f32)));
    Tensor::from_data(TensorData::new(values.collect(), [1, heads, len, len]), device)
}

/// Slopes of ALiBi: a geometric sequence that ends at 2^-8 for a power of two. Other numbers of heads take the slopes
/// of the power below, then every second slope of the power above.
fn slopes(heads: usize) -> Vec<f32> {
    let sequence = |n: usize| (1..=n).map(move |i| 2.0_f64.powf(-8.0 * i as f64 / n as f64) as f32);
    if heads.is_power_of_two() {
        return sequence(heads).collect();
    }
    let below = heads.next_power_of_two() / 2;
    sequence(below).chain(sequence(2 * below).step_by(2)).take(heads).collect()
}
