//! Attention with separate projections of queries, keys and values (as in GPT-style code), and with an additive bias.

use burn::module::{Module, Param};
use burn::tensor::activation::softmax;
use burn::tensor::{Device, Int, Tensor, TensorData};

use super::conv::{GAP, Gap};
use super::{Init, Linear, Norm};
use crate::kernels::{self, Dropout, HIDDEN, KeyMask};

/// Standard deviation of GPT-style initial weights.
pub(super) const DEVIATION: f64 = 0.02;
/// Added to variances in layer norms.
const EPS: f64 = 1e-5;

/// Softmax attention with `bias` added to the scores. The bias has shape [B or 1, heads or 1, Q or 1, K]. `q_bqh` [B,
/// Q, H], `k_bkh` and `v_bkh` [B, K, H] -> [B, Q, H].
pub(super) fn attend(
    q_bqh: Tensor<3>,
    k_bkh: Tensor<3>,
    v_bkh: Tensor<3>,
    heads: usize,
    bias: Option<Tensor<4>>,
    dropout: &mut Dropout,
) -> Tensor<3> {
    let scale = 1.0 / ((q_bqh.dims()[2] / heads) as f32).sqrt();
    attend_at(scale, q_bqh, k_bkh, v_bkh, heads, bias, dropout)
}

/// Like [`attend`], with another scale of the scores.
pub(super) fn attend_at(
    scale: f32,
    q_bqh: Tensor<3>,
    k_bkh: Tensor<3>,
    v_bkh: Tensor<3>,
    heads: usize,
    bias: Option<Tensor<4>>,
    dropout: &mut Dropout,
) -> Tensor<3> {
    let ([batch, queries, width], keys) = (q_bqh.dims(), k_bkh.dims()[1]);
    let split = |x: Tensor<3>, len: usize| x.reshape([batch, len, heads, width / heads]).swap_dims(1, 2);
    let mut scores = split(q_bqh, queries).matmul(split(k_bkh, keys).swap_dims(2, 3)) * scale;
    if let Some(bias) = bias {
        scores = scores + bias;
    }
    let weights = kernels::dropout(softmax(scores, 3), dropout);
    weights.matmul(split(v_bkh, keys)).swap_dims(1, 2).reshape([batch, queries, width])
}

/// A bias [1, 1, len, len] that hides the positions after a query's own.
pub(super) fn causal(len: usize, device: &Device) -> Tensor<4> {
    let values = (0..len).flat_map(|q| (0..len).map(move |k| if k > q { HIDDEN } else { 0.0 })).collect();
    Tensor::from_data(TensorData::new(values, [1, 1, len, len]), device)
}

/// A bias [B, 1, 1, K] that hides the keys that are not `visible` [B K].
pub(super) fn hiding(visible: &[bool], batch: usize, device: &Device) -> Tensor<4> {
    let values = visible.iter().map(|v| if *v { 0.0 } else { HIDDEN }).collect();
    Tensor::from_data(TensorData::new(values, [batch, 1, 1, visible.len() / batch]), device)
}

/// The keys that a block's attention may see.
#[derive(Debug, Clone)]
pub(super) enum Sight {
    /// All keys up to the end of the sequence.
    Keys(Option<KeyMask>),
    /// The keys up to the query's own place.
    Before,
    /// The keys that a bias on the scores leaves visible.
    Bias(Box<Tensor<4>>),
}

/// A table with one row per id.
#[derive(Module, Debug)]
pub struct Embedding {
    /// Weights of shape [rows, width].
    pub weight: Param<Tensor<2>>,
}

impl Embedding {
    /// Initialises the table from a normal distribution with deviation 0.02.
    pub(super) fn new(init: &mut Init<'_>, rows: usize, width: usize) -> Self {
        Self { weight: init.scaled_normal(DEVIATION, [rows, width]) }
    }

    /// Looks up ids [B T] -> [B, T, width].
    pub(super) fn rows(&self, ids: &[usize], batch: usize) -> Tensor<3> {
        rows_of(self.weight.val(), ids, batch)
    }
}

/// Looks up rows [B, n / B, width] in `table` [rows, width].
pub(super) fn rows_of(table: Tensor<2>, ids: &[usize], batch: usize) -> Tensor<3> {
    let width = table.dims()[1];
    let values: Vec<i64> = ids.iter().map(|id| *id as i64).collect();
    let ids = Tensor::<1, Int>::from_data(TensorData::new(values, [ids.len()]), &table.device());
    let len = ids.dims()[0] / batch;
    table.select(0, ids).reshape([batch, len, width])
}

/// A linear layer with weights of deviation 0.02 and a bias of zeros.
pub(super) fn linear(init: &mut Init<'_>, inner: usize, out: usize) -> Linear {
    Linear { weight: init.scaled_normal(DEVIATION, [out, inner]), bias: Some(init.constant(0.0, [out])) }
}

/// Alternating sines and cosines [1, len, width]: `sin(p f_i), cos(p f_i)` with `f_i = 10000^(-2i / width)`. Computed
/// in f32 from the frequencies on, like the tables that upstream stores.
pub(super) fn sinusoids(len: usize, width: usize, device: &Device) -> Tensor<3> {
    let step = -(10_000_f64.ln()) / width as f64;
    let frequency = |i: usize| (((2 * (i / 2)) as f32) * step as f32).exp();
    let value = |p: usize, i: usize| {
        let angle = p as f32 * frequency(i);
        if i.is_multiple_of(2) { angle.sin() } else { angle.cos() }
    };
    let values = (0..len).flat_map(|p| (0..width).map(move |i| value(p, i))).collect();
    Tensor::from_data(TensorData::new(values, [1, len, width]), device)
}

/// Multi-head attention with separate projections of keys, queries and values.
#[derive(Module, Debug)]
pub struct SplitAttention {
    /// H -> H.
    pub key: Linear,
    /// H -> H.
    pub query: Linear,
    /// H -> H.
    pub value: Linear,
    /// H -> H.
    pub proj: Linear,
    heads: usize,
}

impl SplitAttention {
    pub(super) fn new(init: &mut Init<'_>, width: usize, heads: usize) -> Self {
        let mut layer = || linear(init, width, width);
        Self { key: layer(), query: layer(), value: layer(), proj: layer(), heads }
    }

    fn own(&self, x_bth: Tensor<3>, sight: &Sight, dropout: &mut Dropout) -> Tensor<3> {
        let q = self.query.forward(x_bth.clone());
        let k = self.key.forward(x_bth.clone());
        let v = self.value.forward(x_bth);
        let packed = |q, k, v| Tensor::cat(vec![q, k, v], 2);
        let attended = match sight {
            Sight::Keys(mask) => kernels::self_attention(packed(q, k, v), self.heads, mask.as_ref(), dropout),
            Sight::Before => kernels::causal_attention(packed(q, k, v), self.heads, dropout),
            Sight::Bias(bias) => attend(q, k, v, self.heads, Some((**bias).clone()), dropout),
        };
        kernels::dropout(self.proj.forward(attended), dropout)
    }

    pub(super) fn cross(
        &self,
        x_bth: Tensor<3>,
        memory_bnh: Tensor<3>,
        mask: Option<&KeyMask>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let kv = Tensor::cat(vec![self.key.forward(memory_bnh.clone()), self.value.forward(memory_bnh)], 2);
        let attended = kernels::cross_attention(self.query.forward(x_bth), kv, self.heads, mask, dropout);
        kernels::dropout(self.proj.forward(attended), dropout)
    }
}

/// Linear, GELU, Linear, dropout, as upstream's sequence numbers them.
pub(super) type Mlp = (Linear, Gap, Linear);

pub(super) fn mlp(init: &mut Init<'_>, width: usize, rate: usize) -> Mlp {
    (linear(init, width, rate * width), GAP, linear(init, rate * width, width))
}

pub(super) fn through((first, _, second): &Mlp, x_bth: Tensor<3>, dropout: &mut Dropout) -> Tensor<3> {
    kernels::dropout(second.forward(kernels::gelu(first.forward(x_bth))), dropout)
}

/// A pre-norm block: `x += Attn(LN1 x)`, `x += MLP(LN2 x)`.
#[derive(Module, Debug)]
pub struct GptBlock {
    /// Norm before the attention.
    pub ln1: Norm,
    /// Norm before the feed-forward.
    pub ln2: Norm,
    pub attn: SplitAttention,
    pub mlp: Mlp,
}

impl GptBlock {
    pub(super) fn new(init: &mut Init<'_>, width: usize, heads: usize, rate: usize) -> Self {
        Self {
            ln1: Norm::new(init, width),
            ln2: Norm::new(init, width),
            attn: SplitAttention::new(init, width, heads),
            mlp: mlp(init, width, rate),
        }
    }

    pub(super) fn forward(&self, x_bth: Tensor<3>, sight: &Sight, dropout: &mut Dropout) -> Tensor<3> {
        let x = x_bth.clone() + self.attn.own(self.ln1.forward(x_bth, EPS), sight, dropout);
        let hidden = through(&self.mlp, self.ln2.forward(x.clone(), EPS), dropout);
        x + hidden
    }
}

/// Blocks, a final norm and the logits of classes.
#[derive(Module, Debug)]
pub struct GptHead {
    pub blocks: Vec<GptBlock>,
    /// Norm after the blocks.
    pub ln_f: Norm,
    /// H -> classes, no bias.
    pub head: Linear,
}

impl GptHead {
    pub(super) fn new(
        init: &mut Init<'_>,
        (width, heads, rate): (usize, usize, usize),
        layers: usize,
        classes: usize,
    ) -> Self {
        Self {
            blocks: (0..layers).map(|_| GptBlock::new(init, width, heads, rate)).collect(),
            ln_f: Norm::new(init, width),
            head: Linear { weight: init.scaled_normal(DEVIATION, [classes, width]), bias: None },
        }
    }

    pub(super) fn forward(&self, x_bth: Tensor<3>, sight: &Sight, dropout: &mut Dropout) -> Tensor<3> {
        let x = self.blocks.iter().fold(x_bth, |x, block| block.forward(x, sight, dropout));
        self.head.forward(self.ln_f.forward(x, EPS))
    }
}

/// `x += Attn(LN1 x, LN3 w)`, `x += MLP(LN2 x)`: tokens attend to words, not to each other.
#[derive(Module, Debug)]
pub struct CrossBlock {
    /// Norm before the attention.
    pub ln1: Norm,
    /// Norm before the feed-forward.
    pub ln2: Norm,
    /// Norm on the words.
    pub ln3: Norm,
    /// Attention to the words.
    pub attn: SplitAttention,
    pub mlp: Mlp,
}

impl CrossBlock {
    pub(super) fn new(init: &mut Init<'_>, width: usize, heads: usize, rate: usize) -> Self {
        Self {
            ln1: Norm::new(init, width),
            ln2: Norm::new(init, width),
            ln3: Norm::new(init, width),
            attn: SplitAttention::new(init, width, heads),
            mlp: mlp(init, width, rate),
        }
    }

    pub(super) fn forward(
        &self,
        x_bth: Tensor<3>,
        words_bnh: Tensor<3>,
        mask: Option<&KeyMask>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let words = self.ln3.forward(words_bnh, EPS);
        let x = x_bth.clone() + self.attn.cross(self.ln1.forward(x_bth, EPS), words, mask, dropout);
        let hidden = through(&self.mlp, self.ln2.forward(x.clone(), EPS), dropout);
        x + hidden
    }
}
