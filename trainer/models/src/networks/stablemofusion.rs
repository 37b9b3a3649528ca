//! StableMoFusion: a 1-D U-Net over frames with cross-attention to the tokens of a caption. Source: Huang et al.,
//! arXiv:2405.05691 (`T2MUnet`).
//!
//! A level is two conditioned blocks and a convolution that halves the frames, on the last level too. The middle has
//! two blocks. On the way up the frames are doubled and the level's output is appended. A block is a residual pair of
//! convolutions, scaled and shifted by the timestep, and residual cross-attention. Group norms run over the channels of
//! one frame each, not over time. Frames are padded with zeros to a multiple of 16. A dropped caption skips every
//! cross-attention; there is no null embedding.
//!
//! Attention is linear by default: queries are normalised over a head's channels and keys over the tokens. Keys times
//! values are a small matrix per head, on which dropout acts. `full_attention` selects softmax attention. Neither has
//! an output projection.
//!
//! Departs: upstream's captions all have 77 tokens and no mask. Ours may have `lengths`; tokens past them are ignored.
//!
//! Notation: c channels, n tokens, k heads.

#![expect(non_snake_case, reason = "fields have the published names")]

use burn::module::{Module, Param};
use burn::tensor::activation::softmax;
use burn::tensor::{Tensor, TensorData};
use protocol::stage::StableMoFusionNetwork;

use super::conv::Conv1d;
use super::transformer::NORM_EPS;
use super::{Deconv, Init, Layers, Linear, Norm, StackConfig, position_sinusoid};
use crate::kernels::{Dropout, KeyMask, cross_attention, dropout, layer_norm, mish};

/// Taps of the convolutions inside blocks.
const TAPS: usize = 5;
/// Groups of the group norms.
const GROUPS: usize = 8;
/// Heads of the cross-attention.
const HEADS: usize = 8;

/// Size of a StableMoFusion network.
#[derive(Debug, Clone, PartialEq)]
pub struct StableMoFusionConfig {
    /// Features per frame.
    pub features: usize,
    /// Size of the network, whose dropout is an argument of each pass.
    pub network: StableMoFusionNetwork,
    /// Width of a token from the text encoder.
    pub text_dim: usize,
}

/// The captions of a batch.
#[derive(Debug, Clone)]
pub struct TokenCondition {
    /// Encoded tokens [B, N, text width].
    pub text_bnc: Tensor<3>,
    /// Number of valid tokens of each caption; `None` if all are valid.
    pub lengths: Option<Vec<usize>>,
    /// True for a sample with its caption, false for a sample without.
    pub kept: Vec<bool>,
}

/// A convolution, a norm over groups of one frame's channels, and an activation.
#[derive(Module, Debug)]
pub struct ScaledConv {
    /// in -> out.
    pub block: Conv1d,
    /// Scale and shift of the norm.
    pub group_norm: Norm,
}

/// Like [`ScaledConv`], without scale and shift by the timestep.
#[derive(Module, Debug)]
pub struct PlainConv {
    /// out -> out, initialised to zero.
    pub block: Conv1d,
    /// Scale and shift of the norm.
    pub norm: Norm,
}

/// Two convolutions with a residual connection.
#[derive(Module, Debug)]
pub struct ResidualConv {
    /// First convolution, scaled and shifted by the timestep.
    pub blocks_0: ScaledConv,
    /// Second convolution, without the timestep.
    pub blocks_1: PlainConv,
    /// Time -> scale and shift of the first convolution, initialised to zero.
    pub time_mlp_1: Linear,
    /// in -> out on the residual path, if the widths differ.
    pub residual_conv: Option<Conv1d>,
}

/// Attention of frames to tokens.
#[derive(Module, Debug)]
pub struct TextAttention {
    /// Norm on the frames.
    pub norm: Norm,
    /// Norm on the tokens.
    pub text_norm: Norm,
    /// c -> c.
    pub query: Linear,
    /// Text -> c.
    pub key: Linear,
    /// Text -> c.
    pub value: Linear,
    full: bool,
}

/// Cross-attention with a residual connection.
#[derive(Module, Debug)]
pub struct CrossAttention {
    pub cross_attention: TextAttention,
}

/// A block conditioned on timestep and text.
#[derive(Module, Debug)]
pub struct ConditionedBlock {
    /// Convolutions conditioned on the timestep.
    pub conv1d: ResidualConv,
    /// Cross-attention to the text.
    pub cross_attn: CrossAttention,
}

/// A convolution that halves the frames.
#[derive(Module, Debug)]
pub struct Halving {
    /// c -> c, three taps.
    pub conv: Conv1d,
}

/// A convolution that doubles the frames.
#[derive(Module, Debug)]
pub struct Doubling {
    /// in -> out, four taps.
    pub conv: Deconv,
}

/// A level on the way down.
#[derive(Module, Debug)]
pub struct Down {
    pub at_0: ConditionedBlock,
    pub at_1: ConditionedBlock,
    /// Convolution to the next level.
    pub at_2: Halving,
}

/// A level on the way up.
#[derive(Module, Debug)]
pub struct Up {
    /// Convolution from the level below.
    pub at_0: Doubling,
    /// First block, on the doubled frames and the level's output on the way down.
    pub at_1: ConditionedBlock,
    pub at_2: ConditionedBlock,
}

/// The U-Net's layers under their published names.
#[derive(Module, Debug)]
pub struct Unet {
    /// Position sinusoid of the timestep -> 4 times its width.
    pub time_mlp_1: Linear,
    /// 4 times the width -> the width, after Mish.
    pub time_mlp_3: Linear,
    /// Levels, from the finest.
    pub downs: Vec<Down>,
    /// Levels, from the coarsest.
    pub ups: Vec<Up>,
    /// First block in the middle.
    pub mid_block1: ConditionedBlock,
    /// Second block in the middle.
    pub mid_block2: ConditionedBlock,
    /// Last width -> features, initialised to zero.
    pub final_conv: Conv1d,
}

/// The whole network.
#[derive(Module, Debug)]
pub struct StableMoFusion {
    /// Tokens of the text encoder -> text width.
    pub embed_text: Linear,
    /// Transformer over the tokens.
    pub textTransEncoder: Layers,
    /// Norm after the transformer.
    pub text_ln: Norm,
    /// U-Net over the frames.
    pub unet: Unet,
}

/// Standardises [B, T, c] to mean 0 and variance 1 in each group of a frame's channels.
fn standardised(x_btc: Tensor<3>) -> Tensor<3> {
    let [batch, frames, channels] = x_btc.dims();
    let width = channels / GROUPS;
    let device = x_btc.device();
    let ones = Tensor::ones([width], &device);
    let zeros = Tensor::zeros([width], &device);
    layer_norm(x_btc.reshape([batch, frames, GROUPS, width]), ones, zeros, NORM_EPS).reshape([batch, frames, channels])
}

/// A convolution initialised to zero.
fn zero(init: &mut Init<'_>, inner: usize, out: usize, taps: usize) -> Conv1d {
    let mut conv = Conv1d::same(init, inner, out, taps);
    conv.weight = init.constant(0.0, [out, inner, taps]);
    conv.bias = Some(init.constant(0.0, [out]));
    conv
}

/// A transposed convolution that doubles the frames, with PyTorch's initial values.
fn doubling(init: &mut Init<'_>, inner: usize, out: usize) -> Deconv {
    const TAPS: usize = 4;
    Deconv { weight: init.fan_in(out * TAPS, [inner, out, TAPS]), bias: init.fan_in(out * TAPS, [out]) }
}

/// The settings of a block.
#[derive(Clone, Copy)]
struct Sizes {
    time: usize,
    text: usize,
    full: bool,
}

impl ResidualConv {
    fn new(init: &mut Init<'_>, inner: usize, out: usize, time: usize) -> Self {
        Self {
            blocks_0: ScaledConv { block: Conv1d::same(init, inner, out, TAPS), group_norm: Norm::new(init, out) },
            blocks_1: PlainConv { block: zero(init, out, out, TAPS), norm: Norm::new(init, out) },
            time_mlp_1: Linear {
                weight: init.constant(0.0, [2 * out, time]),
                bias: Some(init.constant(0.0, [2 * out])),
            },
            residual_conv: (inner != out).then(|| Conv1d::same(init, inner, out, 1)),
        }
    }

    /// `time_bh` is Mish of the timestep's embedding.
    fn forward(&self, x_btc: Tensor<3>, time_bh: Tensor<2>, drop: &mut Dropout) -> Tensor<3> {
        let row = |values: &Param<Tensor<1>>| {
            let values = values.val();
            let width = values.dims()[0];
            values.reshape([1, 1, width])
        };
        let first = standardised(self.blocks_0.block.forward(x_btc.clone()));
        let [batch, _, channels] = first.dims();
        let pair = self.time_mlp_1.forward(time_bh).reshape([batch, 1, 2 * channels]);
        let scale = pair.clone().slice([0..batch, 0..1, 0..channels]) + 1.0;
        let shift = pair.slice([0..batch, 0..1, channels..2 * channels]);
        // The norm's own scale and shift come first; both pairs combine to one.
        let norm = &self.blocks_0.group_norm;
        let first = mish(first * (scale.clone() * row(&norm.weight)) + (scale * row(&norm.bias) + shift));

        let second = standardised(self.blocks_1.block.forward(first));
        let norm = &self.blocks_1.norm;
        let second = mish(second * row(&norm.weight) + row(&norm.bias));
        let skip = match &self.residual_conv {
            Some(conv) => conv.forward(x_btc),
            None => x_btc,
        };
        dropout(second, drop) + skip
    }
}

impl TextAttention {
    fn new(init: &mut Init<'_>, channels: usize, sizes: Sizes) -> Self {
        Self {
            norm: Norm::new(init, channels),
            text_norm: Norm::new(init, sizes.text),
            query: Linear::new(init, channels, channels),
            key: Linear::new(init, sizes.text, channels),
            value: Linear::new(init, sizes.text, channels),
            full: sizes.full,
        }
    }

    /// [B, T, c] and [B, N, text] -> [B, T, c].
    fn forward(&self, x_btc: Tensor<3>, condition: &TokenCondition, drop: &mut Dropout) -> Tensor<3> {
        let query = self.query.forward(self.norm.forward(x_btc, NORM_EPS));
        let text = self.text_norm.forward(condition.text_bnc.clone(), NORM_EPS);
        let key = self.key.forward(text.clone());
        let value = self.value.forward(text);
        if self.full {
            let mask = condition.lengths.as_deref().map(|lengths| KeyMask::new(lengths, 0));
            return cross_attention(query, Tensor::cat(vec![key, value], 2), HEADS, mask.as_ref(), drop);
        }
        let [batch, frames, channels] = query.dims();
        let tokens = key.dims()[1];
        let split = |x: Tensor<3>, len: usize| x.reshape([batch, len, HEADS, channels / HEADS]).swap_dims(1, 2);
        let query_bktc = softmax(split(query, frames), 3);
        let mut key_bknc = split(key, tokens);
        let mut value_bknc = split(value, tokens);
        if let Some(lengths) = &condition.lengths {
            let live = live_tokens(lengths, tokens, &key_bknc);
            // Far below any key, but finite, so that a gradient through it is 0 and not undefined.
            key_bknc = key_bknc + (live.clone() - 1.0) * 1e9;
            value_bknc = value_bknc * live;
        }
        let key_bkcn = softmax(key_bknc, 2).swap_dims(2, 3);
        let context_bkcc = dropout(key_bkcn.matmul(value_bknc), drop);
        query_bktc.matmul(context_bkcc).swap_dims(1, 2).reshape([batch, frames, channels])
    }
}

/// A mask [B, 1, N, 1] with 1 for a valid token and 0 for the others, on the device of `like`.
fn live_tokens(lengths: &[usize], tokens: usize, like: &Tensor<4>) -> Tensor<4> {
    let live = lengths.iter().flat_map(|l| (0..tokens).map(move |n| if n < *l { 1.0_f32 } else { 0.0 })).collect();
    Tensor::from_data(TensorData::new(live, [lengths.len(), 1, tokens, 1]), &like.device())
}

impl ConditionedBlock {
    fn new(init: &mut Init<'_>, inner: usize, out: usize, sizes: Sizes) -> Self {
        Self {
            conv1d: ResidualConv::new(init, inner, out, sizes.time),
            cross_attn: CrossAttention { cross_attention: TextAttention::new(init, out, sizes) },
        }
    }

    fn forward(&self, x_btc: Tensor<3>, given: &Given<'_>, drop: &mut Dropout) -> Tensor<3> {
        let x_btc = self.conv1d.forward(x_btc, given.time_bh.clone(), drop);
        let Some(condition) = given.condition else { return x_btc };
        let attended = self.cross_attn.cross_attention.forward(x_btc.clone(), condition, drop);
        match &given.kept_b11 {
            Some(kept) => x_btc + attended * kept.clone(),
            None => x_btc + attended,
        }
    }
}

/// The inputs of every block of a pass.
struct Given<'a> {
    time_bh: Tensor<2>,
    condition: Option<&'a TokenCondition>,
    /// 1 for a sample with its caption and 0 without; `None` if all samples have theirs.
    kept_b11: Option<Tensor<3>>,
}

impl Unet {
    fn new(config: &StableMoFusionConfig, init: &mut Init<'_>) -> Self {
        let StableMoFusionConfig { features, ref network, .. } = *config;
        let StableMoFusionNetwork { width, time: time_dim, .. } = *network;
        let sizes = Sizes { time: time_dim, text: network.text, full: network.full_attention };
        let widths: Vec<usize> = network.multipliers.iter().map(|m| width * m).collect();
        let inner: Vec<usize> = std::iter::once(features).chain(widths.iter().copied()).collect();
        let deepest = *inner.last().expect("at least the features");
        let down = |init: &mut Init<'_>, (inner, out): (&usize, &usize)| Down {
            at_0: ConditionedBlock::new(init, *inner, *out, sizes),
            at_1: ConditionedBlock::new(init, *out, *out, sizes),
            at_2: Halving { conv: Conv1d::strided(init, *out, *out, 3, 2, 1) },
        };
        let up = |init: &mut Init<'_>, (inner, out): (usize, usize)| Up {
            at_0: Doubling { conv: doubling(init, inner, out) },
            at_1: ConditionedBlock::new(init, 2 * out, out, sizes),
            at_2: ConditionedBlock::new(init, out, out, sizes),
        };
        let upward = widths.iter().rev().copied();
        let from_below = std::iter::once(deepest).chain(upward.clone());
        Self {
            time_mlp_1: Linear::new(init, time_dim, 4 * time_dim),
            time_mlp_3: Linear::new(init, 4 * time_dim, time_dim),
            downs: inner.iter().zip(&widths).map(|pair| down(init, pair)).collect(),
            ups: from_below.zip(upward).map(|pair| up(init, pair)).collect(),
            mid_block1: ConditionedBlock::new(init, deepest, deepest, sizes),
            mid_block2: ConditionedBlock::new(init, deepest, deepest, sizes),
            final_conv: zero(init, *widths.first().unwrap_or(&features), features, 1),
        }
    }

    /// [B, T, F] with T a multiple of 16.
    fn forward(&self, mut x_btc: Tensor<3>, given: &Given<'_>, drop: &mut Dropout) -> Tensor<3> {
        let mut skips = Vec::with_capacity(self.downs.len());
        for level in &self.downs {
            x_btc = level.at_0.forward(x_btc, given, drop);
            x_btc = level.at_1.forward(x_btc, given, drop);
            skips.push(x_btc.clone());
            x_btc = level.at_2.conv.forward(x_btc);
        }
        x_btc = self.mid_block1.forward(x_btc, given, drop);
        x_btc = self.mid_block2.forward(x_btc, given, drop);
        for level in &self.ups {
            let skip = skips.pop().expect("as many levels up as down");
            x_btc = Tensor::cat(vec![level.at_0.conv.forward(x_btc), skip], 2);
            x_btc = level.at_1.forward(x_btc, given, drop);
            x_btc = level.at_2.forward(x_btc, given, drop);
        }
        self.final_conv.forward(x_btc)
    }
}

impl StableMoFusion {
    /// Frames are padded to a multiple of this; it limits the number of levels to 4.
    pub const MULTIPLE: usize = 16;

    /// Creates a network with initial weights.
    pub fn new(config: &StableMoFusionConfig, init: &mut Init<'_>) -> Self {
        let network = &config.network;
        let width = network.text;
        let stack = StackConfig {
            width,
            layers: network.text_layers,
            heads: network.text_heads,
            feed_forward: network.text_feed_forward,
            norm_eps: NORM_EPS,
            memory: false,
        };
        Self {
            embed_text: Linear::new(init, config.text_dim, width),
            textTransEncoder: Layers::new(init, &stack),
            text_ln: Norm::new(init, width),
            unet: Unet::new(config, init),
        }
    }

    /// Encodes the text encoder's tokens [B, N, text_dim] as [B, N, text width]; the first `lengths[b]` are valid.
    pub fn encode_text(&self, tokens_bnc: Tensor<3>, lengths: Option<&[usize]>, drop: &mut Dropout) -> Tensor<3> {
        let mask = lengths.map(|lengths| KeyMask::new(lengths, 0));
        let x = self.textTransEncoder.forward(self.embed_text.forward(tokens_bnc), mask.as_ref(), drop);
        self.text_ln.forward(x, NORM_EPS)
    }

    /// The timestep's embedding [B, time_dim].
    pub fn time_embedding(&self, timesteps: &[usize]) -> Tensor<2> {
        let weight = self.unet.time_mlp_1.weight.val();
        let sinusoid = position_sinusoid(timesteps.iter().copied(), weight.dims()[1], &weight.device());
        self.unet.time_mlp_3.forward(mish(self.unet.time_mlp_1.forward(sinusoid)))
    }

    /// The network's prediction [B, T, F] for normalised `x_btf` [B, T, F] at `timesteps`: as published, the clean
    /// motion. Without a condition, no sample has its caption.
    pub fn forward(
        &self,
        x_btf: Tensor<3>,
        timesteps: &[usize],
        condition: Option<&TokenCondition>,
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let [batch, frames, features] = x_btf.dims();
        assert_eq!(timesteps.len(), batch, "one timestep a sample");
        let device = x_btf.device();
        let condition = condition.filter(|condition| condition.kept.contains(&true));
        let kept_b11 = condition.filter(|condition| condition.kept.contains(&false)).map(|condition| {
            let kept: Vec<f32> = condition.kept.iter().map(|kept| if *kept { 1.0 } else { 0.0 }).collect();
            Tensor::from_data(TensorData::new(kept, [batch, 1, 1]), &device)
        });
        let given = Given { time_bh: mish(self.time_embedding(timesteps)), condition, kept_b11 };
        let whole = frames.next_multiple_of(Self::MULTIPLE);
        let x_btf = match whole - frames {
            0 => x_btf,
            rest => Tensor::cat(vec![x_btf, Tensor::zeros([batch, rest, features], &device)], 1),
        };
        self.unet.forward(x_btf, &given, drop).slice([0..batch, 0..frames, 0..features])
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use protocol::Seed;
    use protocol::stage::Positions;

    use super::*;
    use crate::flat;

    /// A small network whose zero layers are not zero.
    fn network(full_attention: bool, device: &Device) -> StableMoFusion {
        let network = StableMoFusionNetwork {
            width: 32,
            multipliers: vec![1, 2],
            time: 8,
            text: 8,
            text_layers: 1,
            text_heads: 2,
            text_feed_forward: 12,
            full_attention,
            dropout: 0.0,
        };
        let config = StableMoFusionConfig { features: 10, network, text_dim: 6 };
        let mut init = Init::new(Seed(5), "small", Positions::Uniform, device);
        let fresh = StableMoFusion::new(&config, &mut init);
        let values = flat::read(&fresh).into_iter().enumerate().map(|(i, v)| v + 0.1 * (i as f32 * 0.37).sin());
        let values: Vec<f32> = values.collect();
        flat::write(fresh, &values)
    }

    fn wave(shape: [usize; 3], device: &Device) -> Tensor<3> {
        let count = shape.iter().product::<usize>();
        let values = (0..count).map(|i| (i as f32 * 0.71).sin()).collect::<Vec<_>>();
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    fn off(a: Tensor<3>, b: Tensor<3>) -> f32 {
        (a - b).abs().max().into_scalar::<f32>()
    }

    #[test]
    fn tokens_past_a_length_take_no_part() {
        let device = Device::flex();
        for full in [false, true] {
            let network = network(full, &device);
            let x = wave([2, 20, 10], &device);
            let tokens = wave([2, 5, 6], &device);
            let run = |tokens: Tensor<3>, lengths: Option<Vec<usize>>, kept: [bool; 2]| {
                let drop = &mut Dropout::off();
                let text_bnc = network.encode_text(tokens, lengths.as_deref(), drop);
                let condition = TokenCondition { text_bnc, lengths, kept: kept.to_vec() };
                network.forward(x.clone(), &[3, 700], Some(&condition), drop)
            };
            let cut = run(tokens.clone().slice([0..2, 0..3, 0..6]), None, [true; 2]);
            let masked = run(tokens.clone(), Some(vec![3, 3]), [true; 2]);
            assert!(off(cut.clone(), masked.clone()) < 1e-5);
            assert!(off(cut.clone(), run(tokens.clone(), None, [true; 2])) > 1e-3, "the tokens matter");

            // A sample without its caption equals the same sample in a batch without captions; the other sample keeps
            // its caption.
            let mixed = run(tokens, Some(vec![3, 3]), [true, false]);
            let none = network.forward(x.clone(), &[3, 700], None, &mut Dropout::off());
            let row = |x: &Tensor<3>, b: usize| x.clone().slice([b..b + 1, 0..20, 0..10]);
            assert!(off(row(&mixed, 0), row(&masked, 0)) < 1e-5);
            assert!(off(row(&mixed, 1), row(&none, 1)) < 1e-5);
            assert!(off(row(&mixed, 1), row(&masked, 1)) > 1e-3);
        }
    }

    #[test]
    fn a_fresh_network_predicts_zero() {
        let device = Device::flex();
        let network = StableMoFusionNetwork {
            width: 16,
            multipliers: vec![1; 4],
            time: 8,
            text: 8,
            text_layers: 1,
            text_heads: 2,
            text_feed_forward: 12,
            full_attention: false,
            dropout: 0.0,
        };
        let config = StableMoFusionConfig { features: 6, network, text_dim: 6 };
        let network = StableMoFusion::new(&config, &mut Init::new(Seed(5), "new", Positions::Uniform, &device));
        let found = network.forward(wave([1, 19, 6], &device), &[999], None, &mut Dropout::off());
        assert_eq!(found.dims(), [1, 19, 6]);
        assert_eq!(found.abs().max().into_scalar::<f32>(), 0.0);
    }
}
