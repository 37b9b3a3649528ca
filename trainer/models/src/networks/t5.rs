//! T5's encoder, and the pooling and dense layer of Sentence-T5. Sources: Raffel et al., arXiv:1910.10683; Ni et al.,
//! arXiv:2108.08877. Tensor names are those of Hugging Face's `T5EncoderModel` and of sentence-transformers' dense
//! layer.
//!
//! Pre-norm blocks with root-mean-square norms. Attention has no biases, and its scores are not divided by the root of
//! the head's width. A bias by the distance of the positions, in buckets, is added to them. Its table is in the first
//! block, and all blocks use it.

#![expect(non_snake_case, reason = "fields have the published names")]

use burn::module::{Module, Param};
use burn::tensor::activation::{gelu_approximate, relu};
use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

use super::attend::{DEVIATION, Embedding, attend_at, hiding, rows_of};
use super::{Init, Linear};
use crate::kernels::Dropout;

/// Size of the encoder, as in a published `config.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct T5Config {
    /// Rows of the token table.
    pub vocab_size: usize,
    pub d_model: usize,
    /// Width of a head; heads times this width may differ from H.
    pub d_kv: usize,
    pub d_ff: usize,
    /// Number of blocks.
    pub num_layers: usize,
    /// Number of attention heads.
    pub num_heads: usize,
    /// Number of buckets of distances, both directions together.
    pub relative_attention_num_buckets: usize,
    /// Distances from this one on share a bucket.
    pub relative_attention_max_distance: usize,
    /// Added to mean squares in norms.
    pub layer_norm_epsilon: f64,
    /// `relu`, or `gated-gelu` as in T5 1.1.
    pub feed_forward_proj: T5FeedForward,
}

/// Activation between the feed-forward's layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum T5FeedForward {
    /// ReLU, as in T5 and Sentence-T5.
    Relu,
    /// GELU with the tanh approximation, times a second layer (T5 1.1).
    GatedGelu,
}

/// `x / sqrt(mean(x^2) + eps)` times a scale.
#[derive(Module, Debug)]
pub struct RootMeanSquareNorm {
    /// Scale of shape [H].
    pub weight: Param<Tensor<1>>,
}

impl RootMeanSquareNorm {
    fn forward(&self, x: Tensor<3>, eps: f64) -> Tensor<3> {
        let root = (x.clone().square().mean_dim(2) + eps).sqrt();
        x / root * self.weight.val().reshape([1, 1, -1])
    }
}

/// Attention with separate projections without biases.
#[derive(Module, Debug)]
pub struct T5SelfAttention {
    /// H -> heads times their width.
    pub q: Linear,
    /// H -> heads times their width.
    pub k: Linear,
    /// H -> heads times their width.
    pub v: Linear,
    /// Heads times their width -> H.
    pub o: Linear,
    /// Buckets -> heads; only in the first block.
    pub relative_attention_bias: Option<Embedding>,
}

/// The attention sublayer: `x += Attn(norm x)`.
#[derive(Module, Debug)]
pub struct T5AttentionLayer {
    pub SelfAttention: T5SelfAttention,
    /// Norm before the attention.
    pub layer_norm: RootMeanSquareNorm,
}

/// The feed-forward: two layers, or three with a gate.
#[derive(Module, Debug)]
pub struct T5Dense {
    /// H -> feed-forward width, without a gate.
    pub wi: Option<Linear>,
    /// H -> feed-forward width; the input of the GELU of a gated layer.
    pub wi_0: Option<Linear>,
    /// H -> feed-forward width; the factor of a gated layer.
    pub wi_1: Option<Linear>,
    /// Feed-forward width -> H.
    pub wo: Linear,
}

/// The feed-forward sublayer: `x += FF(norm x)`.
#[derive(Module, Debug)]
pub struct T5FeedForwardLayer {
    pub DenseReluDense: T5Dense,
    /// Norm before the feed-forward.
    pub layer_norm: RootMeanSquareNorm,
}

/// An attention and a feed-forward sublayer.
#[derive(Module, Debug)]
pub struct T5Block {
    /// Attention, then feed-forward.
    pub layer: (T5AttentionLayer, T5FeedForwardLayer),
}

/// The blocks and the final norm.
#[derive(Module, Debug)]
pub struct T5Stack {
    /// Blocks, first to last.
    pub block: Vec<T5Block>,
    pub final_layer_norm: RootMeanSquareNorm,
}

/// T5's encoder under its published names.
#[derive(Module, Debug)]
pub struct T5Encoder {
    /// Token -> H.
    pub shared: Embedding,
    pub encoder: T5Stack,
    #[module(skip)]
    config: T5Config,
}

impl T5Encoder {
    /// Creates an encoder with untrained weights.
    pub fn new(config: &T5Config, init: &mut Init<'_>) -> Self {
        let width = config.d_model;
        let inner = config.num_heads * config.d_kv;
        let mut block = |first: bool| {
            let mut plain = |from, to| Linear { weight: init.scaled_normal(DEVIATION, [to, from]), bias: None };
            let q = plain(width, inner);
            let k = plain(width, inner);
            let v = plain(width, inner);
            let o = plain(inner, width);
            let mut up = |is_there: bool| is_there.then(|| plain(width, config.d_ff));
            let is_gated = config.feed_forward_proj == T5FeedForward::GatedGelu;
            let wi = up(!is_gated);
            let wi_0 = up(is_gated);
            let wi_1 = up(is_gated);
            let wo = plain(config.d_ff, width);
            let buckets = config.relative_attention_num_buckets;
            let relative_attention_bias = first.then(|| Embedding::new(init, buckets, config.num_heads));
            let norm = || RootMeanSquareNorm { weight: init.constant(1.0, [width]) };
            T5Block {
                layer: (
                    T5AttentionLayer {
                        SelfAttention: T5SelfAttention { q, k, v, o, relative_attention_bias },
                        layer_norm: norm(),
                    },
                    T5FeedForwardLayer { DenseReluDense: T5Dense { wi, wi_0, wi_1, wo }, layer_norm: norm() },
                ),
            }
        };
        let blocks = (0..config.num_layers).map(|i| block(i == 0)).collect();
        Self {
            shared: Embedding::new(init, config.vocab_size, width),
            encoder: T5Stack {
                block: blocks,
                final_layer_norm: RootMeanSquareNorm { weight: init.constant(1.0, [width]) },
            },
            config: config.clone(),
        }
    }

    /// States [B, T, H] of `ids` [B T]. The first `lengths` ids of each row are valid; the states of padding are
    /// undefined.
    ///
    /// # Panics
    /// If an id is not in the table.
    pub fn forward(&self, ids: &[usize], lengths: &[usize]) -> Tensor<3> {
        let batch = lengths.len();
        let rows = self.config.vocab_size;
        let len = ids.len() / batch;
        assert!(ids.iter().all(|id| *id < rows), "an id is beyond the table of {rows} tokens");
        let x = self.shared.rows(ids, batch);
        let visible: Vec<bool> = lengths.iter().flat_map(|own| (0..len).map(move |t| t < *own)).collect();
        let bias = self.position_bias(len) + hiding(&visible, batch, &x.device());
        let x = self.encoder.block.iter().fold(x, |x, block| self.block(block, x, &bias));
        self.encoder.final_layer_norm.forward(x, self.config.layer_norm_epsilon)
    }

    /// The bias on the scores of `len` positions: [1, heads, queries, keys].
    ///
    /// # Panics
    /// If there is no block.
    pub fn position_bias(&self, len: usize) -> Tensor<4> {
        let table = self.encoder.block.first().and_then(|b| b.layer.0.SelfAttention.relative_attention_bias.as_ref());
        let table = table.expect("the first block has the table").weight.val();
        let all = self.config.relative_attention_num_buckets;
        let most = self.config.relative_attention_max_distance;
        let at = |q: usize, k: usize| distance_bucket(k as i64 - q as i64, all, most);
        let buckets: Vec<usize> = (0..len).flat_map(|q| (0..len).map(move |k| at(q, k))).collect();
        rows_of(table, &buckets, 1).reshape([1, len, len, self.config.num_heads]).permute([0, 3, 1, 2])
    }

    fn block(&self, block: &T5Block, x_bth: Tensor<3>, bias: &Tensor<4>) -> Tensor<3> {
        let (eps, (attention, feed_forward)) = (self.config.layer_norm_epsilon, &block.layer);
        let normed = attention.layer_norm.forward(x_bth.clone(), eps);
        let T5SelfAttention { q, k, v, o, .. } = &attention.SelfAttention;
        let q = q.forward(normed.clone());
        let k = k.forward(normed.clone());
        let v = v.forward(normed);
        let attended = attend_at(1.0, q, k, v, self.config.num_heads, Some(bias.clone()), &mut Dropout::off());
        let x = x_bth + o.forward(attended);
        let normed = feed_forward.layer_norm.forward(x.clone(), eps);
        let T5Dense { wi, wi_0, wi_1, wo } = &feed_forward.DenseReluDense;
        let inner = match (wi, wi_0, wi_1) {
            (Some(wi), ..) => relu(wi.forward(normed)),
            (None, Some(gelu), Some(gate)) => gelu_approximate(gelu.forward(normed.clone())) * gate.forward(normed),
            _ => unreachable!("a feed-forward has one layer before the last, or two with a gate"),
        };
        x + wo.forward(inner)
    }
}

/// The bucket of a key `distance` positions after its query (before it, if negative). Each direction has half of the
/// buckets. Half of those hold one near distance each; the others hold logarithmically growing ranges up to `most`.
/// Computed in f32, as published.
pub fn distance_bucket(distance: i64, buckets: usize, most: usize) -> usize {
    let each = buckets / 2;
    let exact = each / 2;
    let behind = if distance > 0 { each } else { 0 };
    let distance = distance.unsigned_abs() as usize;
    if distance < exact {
        return behind + distance;
    }
    let span = (most as f64 / exact as f64).ln() as f32;
    let grown = (distance as f32 / exact as f32).ln() / span * (each - exact) as f32;
    behind + (exact + grown as usize).min(each - 1)
}

/// The mean over each row's first `lengths` states: `states_bth` [B, T, H] -> [B, H].
pub fn mean_of_tokens(states_bth: Tensor<3>, lengths: &[usize]) -> Tensor<2> {
    let [batch, len, width] = states_bth.dims();
    let shares = lengths.iter().flat_map(|own| (0..len).map(move |t| if t < *own { 1.0 / *own as f32 } else { 0.0 }));
    let shares = TensorData::new(shares.collect::<Vec<f32>>(), [batch, 1, len]);
    Tensor::<3>::from_data(shares, &states_bth.device()).matmul(states_bth).reshape([batch, width])
}

/// Each row divided by its length, which is at least 1e-12: [B, C].
pub fn normalised(x_bc: Tensor<2>) -> Tensor<2> {
    let length = x_bc.clone().square().sum_dim(1).sqrt().clamp_min(1e-12);
    x_bc / length
}
