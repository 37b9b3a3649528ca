//! The vector field of a rectified flow that turns frozen tokens into motion: a U-Net over time. Source: DisCoRD (Cho et al.,
//! arXiv:2411.19527), after the one-dimensional U-Net of Ho et al., arXiv:2006.11239.
//!
//! The noisy motion and the projected tokens are joined per frame. A level is residual blocks with the time's scale and shift, and a
//! convolution that halves the frames (not on the last level); the way up mirrors it, each residual block with its counterpart's output
//! appended. Norms are root mean square over channels. Time runs from noise at 0 to data at 1 and enters unscaled.
//!
//! Departs: batch norms of the projection named `Upsample` use their stored statistics, in training too.

use burn::module::{Module, Param};
use burn::tensor::activation::{leaky_relu, silu, softmax};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use super::conv::{Conv1d, Doubling, GAP, Gap, repeat};
use super::{Init, Linear};
use crate::kernels::{Dropout, dropout, gelu};

/// Frames that one token stands for.
const UNIT: usize = 4;
/// Heads of the linear attentions, and their width.
const LINEAR_HEADS: (usize, usize) = (4, 32);
/// The least norm that is divided by.
const LEAST: f32 = 1e-12;
/// Added to variances in batch norms.
const BATCH_EPS: f64 = 1e-5;

/// How tokens become a condition on each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Projection {
    /// Repeat, stack four frames, a linear layer, unstack, another: as published.
    Stack,
    /// Repeat and a linear layer; nearest-neighbour up-sampling is the same.
    Repeat,
    /// Two transposed convolutions with GELUs.
    Transposed,
    /// Convolutions with leaky ReLU and batch norm, each before a doubling.
    Upsample,
}

/// How the time enters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeFeatures {
    /// Sines and cosines of fixed frequencies.
    Sinusoid,
    /// The time, sines and cosines of trained frequencies, so many in all.
    Learned(usize),
    /// The same with frequencies drawn once.
    Random(usize),
}

/// Size of the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnetConfig {
    /// Features per frame.
    pub features: usize,
    /// Width of the first level.
    pub width: usize,
    /// Widths of what the levels give, over the first.
    pub multiples: Vec<usize>,
    /// Width of a token.
    pub token_dim: usize,
    /// Width of the condition on a frame.
    pub condition_dim: usize,
    /// Residual blocks of a level.
    pub blocks: usize,
    /// Tokens to condition.
    pub projection: Projection,
    /// Attention on each level and in the middle: heads and their width in the middle; those of the levels are fixed.
    pub attention: Option<(usize, usize)>,
    /// Time to features.
    pub time: TimeFeatures,
    /// Base of the sinusoid's frequencies.
    pub theta: f64,
    /// Twice the features come out: upstream's option of a learned variance.
    pub learned_variance: bool,
}

/// Scales rows to a root mean square of 1, then by a learned gain.
#[derive(Module, Debug)]
pub struct RmsNorm {
    /// [1, C, 1].
    pub g: Param<Tensor<3>>,
}

impl RmsNorm {
    fn new(init: &Init<'_>, width: usize) -> Self {
        Self { g: init.constant(1.0, [1, width, 1]) }
    }

    fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        let width = x_btc.dims()[2];
        let norm = x_btc.clone().square().sum_dim(2).sqrt().clamp_min(LEAST);
        x_btc / norm * self.g.val().reshape([1, 1, width]) * (width as f32).sqrt()
    }
}

/// Convolution, norm, SiLU.
#[derive(Module, Debug)]
pub struct ConvBlock {
    /// Three taps.
    pub proj: Conv1d,
    /// After it.
    pub norm: RmsNorm,
}

impl ConvBlock {
    fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { proj: Conv1d::same(init, inner, out, 3), norm: RmsNorm::new(init, out) }
    }

    fn normed(&self, x_btc: Tensor<3>) -> Tensor<3> {
        self.norm.forward(self.proj.forward(x_btc))
    }
}

/// Two convolutions with the time's scale and shift between them.
#[derive(Module, Debug)]
pub struct TimedBlock {
    /// After SiLU: time -> scale and shift.
    pub mlp: (Gap, Linear),
    /// In -> out.
    pub block1: ConvBlock,
    /// Out -> out.
    pub block2: ConvBlock,
    /// In -> out around them, if the widths differ.
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
        let moved = self.mlp.1.forward(silu(time_bc.clone()));
        let [batch, both] = moved.dims();
        let out = both / 2;
        let part = |at: usize| moved.clone().slice([0..batch, at..at + out]).reshape([batch, 1, out]);
        let h = self.block1.normed(x_btc.clone()) * (part(0) + 1.0) + part(out);
        let h = silu(self.block2.normed(dropout(silu(h), drop)));
        match &self.res_conv {
            Some(conv) => h + conv.forward(x_btc),
            None => h + x_btc,
        }
    }
}

/// Attention that is linear in the frames: queries over the width of a head, keys over the frames.
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

/// A norm and what comes after it.
#[derive(Module, Debug)]
pub struct Normed<M: Module> {
    /// Attention.
    #[allow(clippy::struct_field_names, reason = "published name")]
    pub r#fn: M,
    /// Before it.
    pub norm: RmsNorm,
}

/// `x + F(norm x)`.
#[derive(Module, Debug)]
pub struct Residual<M: Module> {
    /// The norm and the attention.
    pub r#fn: Normed<M>,
}

impl<M: Module> Residual<M> {
    fn around(init: &Init<'_>, width: usize, inner: M) -> Self {
        Self { r#fn: Normed { r#fn: inner, norm: RmsNorm::new(init, width) } }
    }

    /// `2 x + F(norm x)`: the network adds what is a residual already to its input once more.
    fn twice(&self, x_btc: Tensor<3>, inner: impl FnOnce(&M, Tensor<3>) -> Tensor<3>) -> Tensor<3> {
        let normed = self.r#fn.norm.forward(x_btc.clone());
        x_btc * 2.0 + inner(&self.r#fn.r#fn, normed)
    }
}

/// An entry of a level.
#[derive(Module, Debug)]
#[expect(clippy::large_enum_variant, reason = "a network has a dozen, and a box is no module")]
pub enum LevelPart {
    /// Convolutions.
    Block(TimedBlock),
    /// Attention.
    Attention(Residual<LinearAttention>),
    /// To the next level, without or with halving the frames.
    Conv(Conv1d),
    /// Doubles the frames first.
    Up((Gap, Conv1d)),
}

/// Scale and shift by stored statistics.
#[derive(Module, Debug)]
pub struct BatchNorm {
    /// [C].
    pub weight: Param<Tensor<1>>,
    /// [C].
    pub bias: Param<Tensor<1>>,
    /// [C]; not trained.
    pub running_mean: Param<Tensor<1>>,
    /// [C]; not trained.
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
        let (mean, variance) = (self.running_mean.val().detach(), self.running_var.val().detach());
        let centred = (x_btc - row(mean)) / row((variance + BATCH_EPS).sqrt());
        centred * row(self.weight.val()) + row(self.bias.val())
    }
}

/// An entry of the condition's projection.
#[derive(Module, Debug)]
#[expect(clippy::large_enum_variant, reason = "a network has a handful, and a box is no module")]
pub enum ProjectionPart {
    /// Without parameters.
    Gap(Gap),
    /// One tap.
    Linear(Conv1d),
    /// Twice the frames.
    Doubling(Doubling),
    /// Five taps with repeated edges, leaky ReLU, batch norm.
    Normed((Conv1d, Gap, BatchNorm)),
}

/// An entry of the time's layers.
#[derive(Module, Debug)]
pub enum TimePart {
    /// Fixed frequencies, or GELU.
    Gap(Gap),
    /// Frequencies of its own.
    Frequencies(Frequencies),
    /// Linear.
    Linear(Linear),
}

/// Frequencies of the time's sines and cosines.
#[derive(Module, Debug)]
pub struct Frequencies {
    /// [n / 2].
    pub weights: Param<Tensor<1>>,
    random: bool,
}

/// The network's parts; the published names begin with `net`.
#[derive(Module, Debug)]
pub struct UnetParts {
    /// Motion and condition -> the first width.
    pub init_proj: Conv1d,
    /// Time -> features of it.
    pub time_mlp: Vec<TimePart>,
    /// Tokens -> condition.
    pub condition_projection: Vec<ProjectionPart>,
    /// The way down.
    pub downs: Vec<Vec<LevelPart>>,
    /// In the middle.
    pub mid_block1: TimedBlock,
    /// Between them.
    pub mid_attn: Option<Residual<FullAttention>>,
    /// In the middle.
    pub mid_block2: TimedBlock,
    /// The way up.
    pub ups: Vec<Vec<LevelPart>>,
    /// With the first layer's output appended.
    pub final_res_block: TimedBlock,
    /// To features.
    pub final_conv: Conv1d,
}

/// The vector field.
#[derive(Module, Debug)]
pub struct FlowUnet {
    /// All of it.
    pub net: UnetParts,
    width: usize,
    levels: usize,
    theta: f64,
    stack: bool,
}

impl FlowUnet {
    /// A fresh one, in PyTorch's default ranges.
    pub fn new(config: &UnetConfig, init: &mut Init<'_>) -> Self {
        let &UnetConfig { features, width, condition_dim, .. } = config;
        let time = 4 * width;
        let widths: Vec<usize> = [width].into_iter().chain(config.multiples.iter().map(|m| m * width)).collect();
        let pairs: Vec<(usize, usize)> = widths.windows(2).map(|pair| (pair[0], pair[1])).collect();
        let (levels, deepest) = (pairs.len(), widths[pairs.len()]);
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

    /// What frames must be a multiple of: of a token's, and of what the levels halve.
    pub fn multiple(&self) -> usize {
        UNIT.max(1 << (self.levels - 1))
    }

    /// The condition on each frame, [B, n, token] -> [B, 4 n, condition].
    pub fn condition(&self, tokens_bnc: Tensor<3>) -> Tensor<3> {
        let [batch, tokens, dim] = tokens_bnc.dims();
        let mut x = tokens_bnc;
        let mut linears = 0;
        for part in &self.net.condition_projection {
            x = match part {
                ProjectionPart::Gap(_) => x,
                ProjectionPart::Linear(conv) if self.stack && linears == 0 => {
                    linears += 1;
                    // Four equal frames side by side, each with a part of what comes out.
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

    /// Features of the time, [B, 4 width].
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

    /// Velocity [B, T, F] of the noisy motion `x_btf` [B, T, F] at `times` (noise 0, data 1) under `tokens_bnc` [B, T / 4, token].
    ///
    /// # Panics
    /// If T is no multiple of [`multiple`](Self::multiple), or there is not a token for every four frames.
    pub fn forward(&self, x_btf: Tensor<3>, times: &[f32], tokens_bnc: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        let frames = x_btf.dims()[1];
        let multiple = self.multiple();
        assert!(frames.is_multiple_of(multiple), "{frames} frames are no multiple of {multiple}");
        assert_eq!(UNIT * tokens_bnc.dims()[1], frames, "a token for every {UNIT} frames");
        let condition = self.condition(tokens_bnc);
        let time = self.time(times, &x_btf.device());
        let first = self.net.init_proj.forward(Tensor::cat(vec![x_btf, condition], 2));
        let (mut x, mut kept) = (first.clone(), Vec::new());
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
                            // What is appended on the way up is what the attention made of it.
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

/// An entry that is no residual block.
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
    let (inner, out) = (config.token_dim, config.condition_dim);
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
