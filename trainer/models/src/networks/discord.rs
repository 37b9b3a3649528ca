//! The vector field of a rectified flow that converts frozen tokens into motion: a U-Net over time. Source: DisCoRD
//! (Cho et al., arXiv:2411.19527), after the one-dimensional U-Net of Ho et al., arXiv:2006.11239.
//!
//! The noisy motion and the projected tokens are joined per frame. A level is residual blocks with the time's scale and
//! shift, and a convolution that halves the frames (not on the last level). The way up mirrors it: the output of the
//! matching residual block is appended. Norms are root mean square over channels. Time is 0 at noise and 1 at data, and
//! enters unscaled.
//!
//! Departs: the batch norms of the projection `Upsample` use their stored statistics in training too.

use burn::module::{Module, Param};
use burn::tensor::activation::{leaky_relu, silu, softmax};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use super::conv::{Conv1d, Doubling, GAP, Gap, repeat};
use super::{Init, Linear};
use crate::kernels::{self, Dropout, dropout, gelu};

/// Frames per token.
const UNIT: usize = 4;
/// Number of heads of the linear attentions, and the width of each.
const LINEAR_HEADS: (usize, usize) = (4, 32);
/// Added to variances in batch norms.
const BATCH_EPS: f64 = 1e-5;

/// Conversion of tokens into a condition on each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Projection {
    /// Repeat, stack four frames, a linear layer, unstack, a second linear layer, as published.
    Stack,
    /// Repeat and a linear layer; nearest-neighbour up-sampling is the same.
    Repeat,
    /// Two transposed convolutions with GELUs.
    Transposed,
    /// Convolutions with leaky ReLU and batch norm, each before a doubling.
    Upsample,
}

/// Encoding of the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeFeatures {
    /// Sines and cosines of fixed frequencies.
    Sinusoid,
    /// The time itself, then sines and cosines of trained frequencies; the number counts all of them.
    Learned(usize),
    /// Like [`Learned`](Self::Learned), with frequencies drawn once and not trained.
    Random(usize),
}

/// Size of the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnetConfig {
    /// Features per frame.
    pub features: usize,
    /// Width of the first level.
    pub width: usize,
    /// Output widths of the levels as multiples of `width`.
    pub multiples: Vec<usize>,
    /// Width of a token.
    pub token_dim: usize,
    /// Width of the condition on a frame.
    pub condition_dim: usize,
    /// Residual blocks per level.
    pub blocks: usize,
    /// Conversion of tokens into the condition.
    pub projection: Projection,
    /// Attention on each level and in the middle, as heads and their width in the middle. The levels' are fixed.
    pub attention: Option<(usize, usize)>,
    /// Encoding of the time.
    pub time: TimeFeatures,
    /// Base of the sinusoid's frequencies.
    pub theta: f64,
    /// Doubles the output features: upstream's option of a learned variance.
    pub learned_variance: bool,
}

/// Scales rows to a root mean square of 1, then by a learned gain.
#[derive(Module, Debug)]
pub struct RmsNorm {
    /// Gain of shape [1, C, 1].
    pub g: Param<Tensor<3>>,
}

impl RmsNorm {
    fn new(init: &Init<'_>, width: usize) -> Self {
        Self { g: init.constant(1.0, [1, width, 1]) }
    }

    fn gain(&self) -> Tensor<1> {
        let width = self.g.dims()[1];
        self.g.val().reshape([width])
    }

    fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        kernels::rms_norm(x_btc, self.gain())
    }
}

/// Convolution, norm, SiLU.
#[derive(Module, Debug)]
pub struct ConvBlock {
    /// Convolution with three taps.
    pub proj: Conv1d,
    /// Norm after the convolution.
    pub norm: RmsNorm,
}

impl ConvBlock {
    fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { proj: Conv1d::same(init, inner, out, 3), norm: RmsNorm::new(init, out) }
    }

    /// `change` [B, 2 out] is a scale and a shift between norm and SiLU.
    fn forward(&self, x_btc: Tensor<3>, change: Option<Tensor<2>>) -> Tensor<3> {
        kernels::rms_norm_silu(self.proj.forward(x_btc), self.norm.gain(), change)
    }
}

/// Two convolutions with the time's scale and shift between them.
#[derive(Module, Debug)]
pub struct TimedBlock {
    /// Time -> scale and shift, after a SiLU.
    pub mlp: (Gap, Linear),
    /// In -> out.
    pub block1: ConvBlock,
    /// Out -> out.
    pub block2: ConvBlock,
    /// In -> out on the residual path, if the widths differ.
    pub res_conv: Option<Conv1d>,
}

impl TimedBlock {
    fn new(init: &mut Init<'_>, inner: usize, out: usize, time: usize) -> Self {
        Self {
            mlp: (GAP, Linear::new(init, time, 2 * out)),
            block1: ConvBlock::new(init, inner, out),
            block2: ConvBlock::new(init, out, out),
            res_conv: (inner != out).then(|| Conv1d::same(init, inner, out, 1)),
        }
    }

    fn forward(&self, x_btc: Tensor<3>, time_bc: &Tensor<2>, drop: &mut Dropout) -> Tensor<3> {
        let change = self.mlp.1.forward(silu(time_bc.clone()));
        let h = self.block1.forward(x_btc.clone(), Some(change));
        let h = self.block2.forward(dropout(h, drop), None);
        match &self.res_conv {
            Some(conv) => h + conv.forward(x_btc),
            None => h + x_btc,
        }
    }
}

/// Attention linear in the frames: softmax of queries over a head's width, and of keys over the frames.
#[derive(Module, Debug)]
pub struct LinearAttention {
    /// C -> queries, keys, values; no bias.
    pub to_qkv: Conv1d,
    /// Heads -> C, and a norm.
    pub to_out: (Conv1d, RmsNorm),
}

impl LinearAttention {
    fn new(init: &mut Init<'_>, width: usize) -> Self {
        let hidden = LINEAR_HEADS.0 * LINEAR_HEADS.1;
        Self {
            to_qkv: Conv1d::same(init, width, 3 * hidden, 1).without_bias(),
            to_out: (Conv1d::same(init, hidden, width, 1), RmsNorm::new(init, width)),
        }
    }

    fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        let (heads, head) = LINEAR_HEADS;
        let [q, k, v] = split(self.to_qkv.forward(x_btc), heads, head);
        let q = softmax(q, 3) * (1.0 / (head as f32).sqrt());
        let context = softmax(k, 2).swap_dims(2, 3).matmul(v);
        self.to_out.1.forward(self.to_out.0.forward(joined(q.matmul(context))))
    }
}

/// Softmax attention among frames.
#[derive(Module, Debug)]
pub struct FullAttention {
    /// C -> queries, keys, values; no bias.
    pub to_qkv: Conv1d,
    /// Heads -> C.
    pub to_out: Conv1d,
    heads: usize,
}

impl FullAttention {
    fn new(init: &mut Init<'_>, width: usize, (heads, head): (usize, usize)) -> Self {
        Self {
            to_qkv: Conv1d::same(init, width, 3 * heads * head, 1).without_bias(),
            to_out: Conv1d::same(init, heads * head, width, 1),
            heads,
        }
    }

    fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        let qkv = self.to_qkv.forward(x_btc);
        let head = qkv.dims()[2] / (3 * self.heads);
        let [q, k, v] = split(qkv, self.heads, head);
        let scores = (q * (1.0 / (head as f32).sqrt())).matmul(k.swap_dims(2, 3));
        self.to_out.forward(joined(softmax(scores, 3).matmul(v)))
    }
}

/// [B, T, 3 heads head] -> queries, keys, values [B, heads, T, head].
fn split(qkv_btc: Tensor<3>, heads: usize, head: usize) -> [Tensor<4>; 3] {
    let ([batch, frames, _], hidden) = (qkv_btc.dims(), heads * head);
    [0, 1, 2].map(|i| {
        let part = qkv_btc.clone().slice([0..batch, 0..frames, i * hidden..(i + 1) * hidden]);
        part.reshape([batch, frames, heads, head]).swap_dims(1, 2)
    })
}

/// [B, heads, T, head] -> [B, T, heads head].
fn joined(x: Tensor<4>) -> Tensor<3> {
    let [batch, heads, frames, head] = x.dims();
    x.swap_dims(1, 2).reshape([batch, frames, heads * head])
}

/// A layer with a norm before it.
#[derive(Module, Debug)]
pub struct Normed<M: Module> {
    /// The layer after the norm, an attention.
    #[allow(clippy::struct_field_names, reason = "published name")]
    pub r#fn: M,
    pub norm: RmsNorm,
}

/// A residual connection: `x + F(norm x)`.
#[derive(Module, Debug)]
pub struct Residual<M: Module> {
    /// The norm and the attention.
    pub r#fn: Normed<M>,
}

impl<M: Module> Residual<M> {
    fn around(init: &Init<'_>, width: usize, inner: M) -> Self {
        Self { r#fn: Normed { r#fn: inner, norm: RmsNorm::new(init, width) } }
    }

    /// Computes `2 x + F(norm x)`: the network adds the input a second time to a residual output.
    fn twice(&self, x_btc: Tensor<3>, inner: impl FnOnce(&M, Tensor<3>) -> Tensor<3>) -> Tensor<3> {
        let normed = self.r#fn.norm.forward(x_btc.clone());
        x_btc * 2.0 + inner(&self.r#fn.r#fn, normed)
    }
}

/// An entry of a level.
#[derive(Module, Debug)]
#[expect(clippy::large_enum_variant, reason = "a network has a dozen, and a box is no module")]
pub enum LevelPart {
    /// Two convolutions with the time's scale and shift.
    Block(TimedBlock),
    /// Linear attention with a residual.
    Attention(Residual<LinearAttention>),
    /// Convolution to the next level; it halves the frames or keeps them.
    Conv(Conv1d),
    /// Doubling of the frames, then a convolution.
    Up((Gap, Conv1d)),
}

/// Scale and shift with stored statistics.
#[derive(Module, Debug)]
pub struct BatchNorm {
    /// Gain of shape [C].
    pub weight: Param<Tensor<1>>,
    /// Bias of shape [C].
    pub bias: Param<Tensor<1>>,
    /// Mean of shape [C]; not trained.
    pub running_mean: Param<Tensor<1>>,
    /// Variance of shape [C]; not trained.
    pub running_var: Param<Tensor<1>>,
}

impl BatchNorm {
    fn new(init: &Init<'_>, width: usize) -> Self {
        let all = |value| init.constant(value, [width]);
        Self { weight: all(1.0), bias: all(0.0), running_mean: all(0.0), running_var: all(1.0) }
    }

    fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        let width = x_btc.dims()[2];
        let row = |x: Tensor<1>| x.reshape([1, 1, width]);
        let mean = self.running_mean.val().detach();
        let variance = self.running_var.val().detach();
        let centred = (x_btc - row(mean)) / row((variance + BATCH_EPS).sqrt());
        centred * row(self.weight.val()) + row(self.bias.val())
    }
}

/// An entry of the projection from tokens to the condition.
#[derive(Module, Debug)]
#[expect(clippy::large_enum_variant, reason = "a network has a handful, and a box is no module")]
pub enum ProjectionPart {
    /// An activation or a reshape.
    Gap(Gap),
    /// A linear layer, as a convolution of one tap.
    Linear(Conv1d),
    /// A transposed convolution that doubles the frames.
    Doubling(Doubling),
    /// Five taps with repeated edges, leaky ReLU, batch norm.
    Normed((Conv1d, Gap, BatchNorm)),
}

/// An entry of the layers that encode the time.
#[derive(Module, Debug)]
pub enum TimePart {
    /// Fixed frequencies, or GELU.
    Gap(Gap),
    /// Learned or drawn frequencies.
    Frequencies(Frequencies),
    /// A linear layer.
    Linear(Linear),
}

/// Frequencies of the time's sines and cosines.
#[derive(Module, Debug)]
pub struct Frequencies {
    /// Frequencies of shape [n / 2].
    pub weights: Param<Tensor<1>>,
    random: bool,
}

/// The network's parts. All published names have the prefix `net`.
#[derive(Module, Debug)]
pub struct UnetParts {
    /// Motion and condition -> the first width.
    pub init_proj: Conv1d,
    /// Layers from the time to its features.
    pub time_mlp: Vec<TimePart>,
    /// Tokens -> condition.
    pub condition_projection: Vec<ProjectionPart>,
    /// Levels of the way down.
    pub downs: Vec<Vec<LevelPart>>,
    /// First block in the middle.
    pub mid_block1: TimedBlock,
    /// Attention between the two middle blocks.
    pub mid_attn: Option<Residual<FullAttention>>,
    /// Second block in the middle.
    pub mid_block2: TimedBlock,
    /// Levels of the way up.
    pub ups: Vec<Vec<LevelPart>>,
    /// The last block; its input has the first layer's output appended.
    pub final_res_block: TimedBlock,
    /// Last width -> features.
    pub final_conv: Conv1d,
}

/// The vector field.
#[derive(Module, Debug)]
pub struct FlowUnet {
    /// The whole network, under the prefix of the published names.
    pub net: UnetParts,
    width: usize,
    levels: usize,
    theta: f64,
    stack: bool,
}

impl FlowUnet {
    /// Creates a network initialised in PyTorch's default ranges.
    pub fn new(config: &UnetConfig, init: &mut Init<'_>) -> Self {
        let &UnetConfig { features, width, condition_dim, .. } = config;
        let time = 4 * width;
        let widths: Vec<usize> = [width].into_iter().chain(config.multiples.iter().map(|m| m * width)).collect();
        let pairs: Vec<(usize, usize)> = widths.windows(2).map(|pair| (pair[0], pair[1])).collect();
        let levels = pairs.len();
        let deepest = widths[pairs.len()];
        let init_proj = Conv1d::same(init, features + condition_dim, width, 1);
        let time_mlp = time_layers(config, time, init);
        let condition_projection = projection_layers(config, init);
        let downs = pairs.iter().enumerate().map(|(i, (inner, out))| {
            let mut level = level_blocks(config, (*inner, *inner), time, init);
            level.push(LevelPart::Conv(if i + 1 == levels {
                Conv1d::same(init, *inner, *out, 3)
            } else {
                Conv1d::strided(init, *inner, *out, 4, 2, 1)
            }));
            level
        });
        let downs = downs.collect();
        let mid_block1 = TimedBlock::new(init, deepest, deepest, time);
        let mid_attn = config.attention.map(|sizes| {
            let attention = FullAttention::new(init, deepest, sizes);
            Residual::around(init, deepest, attention)
        });
        let mid_block2 = TimedBlock::new(init, deepest, deepest, time);
        let ups = pairs.iter().rev().enumerate().map(|(i, (inner, out))| {
            let mut level = level_blocks(config, (inner + out, *out), time, init);
            let conv = Conv1d::same(init, *out, *inner, 3);
            level.push(if i + 1 == levels { LevelPart::Conv(conv) } else { LevelPart::Up((GAP, conv)) });
            level
        });
        let ups = ups.collect();
        let outputs = if config.learned_variance { 2 * features } else { features };
        Self {
            net: UnetParts {
                init_proj,
                time_mlp,
                condition_projection,
                downs,
                mid_block1,
                mid_attn,
                mid_block2,
                ups,
                final_res_block: TimedBlock::new(init, 2 * width, width, time),
                final_conv: Conv1d::same(init, width, outputs, 1),
            },
            width,
            levels,
            theta: config.theta,
            stack: config.projection == Projection::Stack,
        }
    }

    /// The number of frames must be a multiple of this: a token's frames, and the halvings of the levels.
    pub fn multiple(&self) -> usize {
        UNIT.max(1 << (self.levels - 1))
    }

    /// Computes the condition on each frame, [B, n, token] -> [B, 4 n, condition].
    pub fn condition(&self, tokens_bnc: Tensor<3>) -> Tensor<3> {
        let [batch, tokens, dim] = tokens_bnc.dims();
        let mut x = tokens_bnc;
        let mut linears = 0;
        for part in &self.net.condition_projection {
            x = match part {
                ProjectionPart::Gap(_) => x,
                ProjectionPart::Linear(conv) if self.stack && linears == 0 => {
                    linears += 1;
                    // Four equal frames are stacked; each gets its own part of the output.
                    let stacked = Tensor::cat(vec![x; UNIT], 2);
                    conv.forward(stacked).reshape([batch, UNIT * tokens, dim])
                }
                ProjectionPart::Linear(conv) if self.stack => conv.forward(x),
                ProjectionPart::Linear(conv) => conv.forward(repeat(x, UNIT)),
                ProjectionPart::Doubling(layer) => gelu(layer.forward(x)),
                ProjectionPart::Normed((conv, _, norm)) => repeat(norm.forward(leaky_relu(conv.forward(x), 0.2)), 2),
            };
        }
        x
    }

    /// Encodes the time as features [B, 4 width].
    pub fn time(&self, times: &[f32], device: &Device) -> Tensor<2> {
        let at = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [times.len(), 1]), device);
        let mut x = sines(times, self.width, self.theta, device);
        let mut linears = 0;
        for part in &self.net.time_mlp {
            x = match part {
                TimePart::Gap(_) => x,
                TimePart::Frequencies(own) => {
                    let weights = own.weights.val();
                    let weights = if own.random { weights.detach() } else { weights };
                    let half = weights.dims()[0];
                    let turned = at(times.to_vec()) * weights.reshape([1, half]) * std::f32::consts::TAU;
                    Tensor::cat(vec![at(times.to_vec()), turned.clone().sin(), turned.cos()], 1)
                }
                TimePart::Linear(layer) => {
                    linears += 1;
                    let x = layer.forward(x);
                    if linears == 1 { gelu(x) } else { x }
                }
            };
        }
        x
    }

    /// The velocity [B, T, F] of the noisy motion `x_btf` [B, T, F] at `times` (noise 0, data 1) given `tokens_bnc` [B,
    /// T / 4, token].
    ///
    /// # Panics
    /// If T is not a multiple of [`multiple`](Self::multiple), or there is not one token for every four frames.
    pub fn forward(&self, x_btf: Tensor<3>, times: &[f32], tokens_bnc: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        let frames = x_btf.dims()[1];
        let multiple = self.multiple();
        assert!(frames.is_multiple_of(multiple), "{frames} frames are no multiple of {multiple}");
        assert_eq!(UNIT * tokens_bnc.dims()[1], frames, "a token for every {UNIT} frames");
        let condition = self.condition(tokens_bnc);
        let time = self.time(times, &x_btf.device());
        let first = self.net.init_proj.forward(Tensor::cat(vec![x_btf, condition], 2));
        let mut x = first.clone();
        let mut kept = Vec::new();
        for level in &self.net.downs {
            for part in level {
                x = match part {
                    LevelPart::Block(block) => {
                        x = block.forward(x, &time, drop);
                        kept.push(x.clone());
                        x
                    }
                    other => {
                        let out = aside(other, x);
                        if matches!(other, LevelPart::Attention(_)) {
                            // The way up appends the output after the attention, not before it.
                            kept.pop();
                            kept.push(out.clone());
                        }
                        out
                    }
                };
            }
        }
        x = self.net.mid_block1.forward(x, &time, drop);
        if let Some(attention) = &self.net.mid_attn {
            x = attention.twice(x, FullAttention::forward);
        }
        x = self.net.mid_block2.forward(x, &time, drop);
        for level in &self.net.ups {
            for part in level {
                x = match part {
                    LevelPart::Block(block) => {
                        let other = kept.pop().expect("as many blocks up as down");
                        block.forward(Tensor::cat(vec![x, other], 2), &time, drop)
                    }
                    other => aside(other, x),
                };
            }
        }
        let x = self.net.final_res_block.forward(Tensor::cat(vec![x, first], 2), &time, drop);
        self.net.final_conv.forward(x)
    }
}

/// Applies an entry that is not a residual block.
fn aside(part: &LevelPart, x_btc: Tensor<3>) -> Tensor<3> {
    match part {
        LevelPart::Attention(attention) => attention.twice(x_btc, LinearAttention::forward),
        LevelPart::Up((_, conv)) => conv.forward(repeat(x_btc, 2)),
        LevelPart::Conv(conv) => conv.forward(x_btc),
        LevelPart::Block(_) => x_btc,
    }
}

fn level_blocks(config: &UnetConfig, (inner, out): (usize, usize), time: usize, init: &mut Init<'_>) -> Vec<LevelPart> {
    let mut level: Vec<LevelPart> =
        (0..config.blocks).map(|_| LevelPart::Block(TimedBlock::new(init, inner, out, time))).collect();
    if config.attention.is_some() {
        let attention = LinearAttention::new(init, out);
        level.push(LevelPart::Attention(Residual::around(init, out, attention)));
    }
    level
}

fn time_layers(config: &UnetConfig, time: usize, init: &mut Init<'_>) -> Vec<TimePart> {
    let (first, width) = match config.time {
        TimeFeatures::Sinusoid => (TimePart::Gap(GAP), config.width),
        TimeFeatures::Learned(n) | TimeFeatures::Random(n) => {
            let random = matches!(config.time, TimeFeatures::Random(_));
            (TimePart::Frequencies(Frequencies { weights: init.normal([n / 2]), random }), n + 1)
        }
    };
    let linear = |init: &mut Init<'_>, inner| TimePart::Linear(Linear::new(init, inner, time));
    let hidden = linear(init, width);
    vec![first, hidden, TimePart::Gap(GAP), linear(init, time)]
}

fn projection_layers(config: &UnetConfig, init: &mut Init<'_>) -> Vec<ProjectionPart> {
    let inner = config.token_dim;
    let out = config.condition_dim;
    let mut linear = |inner, out| ProjectionPart::Linear(Conv1d::same(init, inner, out, 1));
    let gap = || ProjectionPart::Gap(GAP);
    match config.projection {
        Projection::Stack => {
            let stacked = linear(UNIT * inner, UNIT * inner);
            vec![gap(), stacked, gap(), linear(inner, out)]
        }
        Projection::Repeat => vec![gap(), linear(inner, out)],
        Projection::Transposed => {
            let mut layer = |out| ProjectionPart::Doubling(Doubling::new(init, inner, out));
            vec![layer(inner), gap(), layer(out)]
        }
        Projection::Upsample => {
            let mut layer = |out| {
                let conv = Conv1d::same(init, inner, out, 5).replicating();
                ProjectionPart::Normed((conv, GAP, BatchNorm::new(init, out)))
            };
            vec![layer(inner), layer(out)]
        }
    }
}

/// `[sin(t f) | cos(t f)]` with `f_i = theta^(-i / (width / 2 - 1))`, [B, width].
fn sines(times: &[f32], width: usize, theta: f64, device: &Device) -> Tensor<2> {
    let half = width / 2;
    let step = theta.ln() / (half as f64 - 1.0);
    let frequencies: Vec<f32> = (0..half).map(|i| (i as f32 * -(step as f32)).exp()).collect();
    let rows = times.iter().flat_map(|t| {
        let angles: Vec<f32> = frequencies.iter().map(|f| t * f).collect();
        let sines: Vec<f32> = angles.iter().map(|a| a.sin()).collect();
        sines.into_iter().chain(angles.into_iter().map(f32::cos)).collect::<Vec<_>>()
    });
    Tensor::from_data(TensorData::new(rows.collect(), [times.len(), 2 * half]), device)
}
