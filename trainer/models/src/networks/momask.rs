//! The two token generators of MoMask (Guo et al., CVPR 2024): one generates the first layer's tokens, the other those
//! of the layers above.
//!
//! Both are post-norm blocks over [caption, tokens], or [caption, layer, tokens]. Only the tokens have positions, and
//! the outputs of the leading entries are dropped. The null condition is a caption embedding of zeros before its
//! Linear, whose bias stays.
//!
//! Departs: the constant position table is not a parameter. As upstream, weights that are not shared double the logits
//! before the bias is added, and their bias table has an extra row.

#![allow(non_snake_case, reason = "published names")]

use burn::module::{Module, Param};
use burn::tensor::{Tensor, TensorData};
use protocol::stage::TokenNetwork;

use super::attend::{DEVIATION, Embedding, linear, rows_of, sinusoids};
use super::transformer::NORM_EPS;
use super::{Block, Init, Linear, Norm, StackConfig};
use crate::kernels::{self, Dropout, KeyMask, dropout, gelu};

/// Added to variances in the heads.
const HEAD_EPS: f64 = 1e-12;

/// Size of a generator.
#[derive(Debug, Clone, PartialEq)]
pub struct MomaskConfig {
    /// Number of codes K of a layer.
    pub codes: usize,
    /// Number of layers Q of codes.
    pub quantizers: usize,
    /// Size of the network, whose dropout is an argument of each pass.
    pub network: TokenNetwork,
    /// Width of a caption embedding.
    pub text_dim: usize,
}

impl MomaskConfig {
    /// The masked generator's id of a token to be generated.
    pub fn mask(&self) -> usize {
        self.codes
    }

    /// The masked generator's id that pads after the end.
    pub fn pad(&self) -> usize {
        self.codes + 1
    }

    /// The residual generator's id that pads after the end, which it may also draw.
    pub fn residual_pad(&self) -> usize {
        self.codes
    }
}

/// Embedding -> H.
#[derive(Module, Debug)]
pub struct InputProcess {
    /// Linear applied to every token.
    pub poseEmbedding: Linear,
}

/// The stack of post-norm blocks.
#[derive(Module, Debug)]
pub struct Blocks {
    /// Blocks, first to last.
    pub layers: Vec<Block>,
}

impl Blocks {
    fn new(config: &MomaskConfig, init: &mut Init<'_>) -> Self {
        Self { layers: (0..config.network.layers).map(|_| block(&config.network, init)).collect() }
    }

    fn forward(&self, x_bth: Tensor<3>, mask: &KeyMask, drop: &mut Dropout) -> Tensor<3> {
        self.layers.iter().fold(x_bth, |x, block| block.forward(x, None, Some(mask), drop))
    }
}

/// Creates a block as published: weights normal with deviation 0.02 and biases 0. Only the packed projection is
/// Xavier-uniform.
fn block(network: &TokenNetwork, init: &mut Init<'_>) -> Block {
    let TokenNetwork { width, layers, heads, feed_forward, .. } = *network;
    let mut block =
        Block::new(init, &StackConfig { width, layers, heads, feed_forward, norm_eps: NORM_EPS, memory: false });
    block.self_attn.out_proj = linear(init, width, width);
    block.linear1 = linear(init, width, feed_forward);
    block.linear2 = linear(init, feed_forward, width);
    block
}

/// H -> classes, or H -> the width of embeddings.
#[derive(Module, Debug)]
pub struct OutputProcess {
    /// H -> H.
    pub dense: Linear,
    /// Norm after the GELU.
    pub LayerNorm: Norm,
    /// H -> out.
    pub poseFinal: Linear,
}

impl OutputProcess {
    fn new(init: &mut Init<'_>, width: usize, out: usize) -> Self {
        Self {
            dense: linear(init, width, width),
            LayerNorm: Norm::new(init, width),
            poseFinal: linear(init, width, out),
        }
    }

    fn forward(&self, x_bth: Tensor<3>) -> Tensor<3> {
        let hidden = gelu(self.dense.forward(x_bth));
        self.poseFinal.forward(self.LayerNorm.forward(hidden, HEAD_EPS))
    }
}

/// Applies the blocks to `leading` tokens followed by `tokens` through a Linear with positions. Returns the outputs of
/// the latter.
fn trunk(
    (input, blocks): (&InputProcess, &Blocks),
    leading: Vec<Tensor<3>>,
    tokens_btc: Tensor<3>,
    lengths: &[usize],
    drop: &mut Dropout,
) -> Tensor<3> {
    let count = leading.len();
    let x = input.poseEmbedding.forward(tokens_btc);
    let [batch, len, width] = x.dims();
    let device = x.device();
    let x = dropout(x + sinusoids(len, width, &device), drop);
    let x = Tensor::cat(leading.into_iter().chain([x]).collect(), 1);
    let out = blocks.forward(x, &KeyMask::new(lengths, count), drop);
    out.slice([0..batch, count..count + len, 0..width])
}

/// Generator of the masked tokens of the first layer.
#[derive(Module, Debug)]
pub struct MaskedTransformer {
    /// Embedding -> H.
    pub input_process: InputProcess,
    pub seqTransEncoder: Blocks,
    /// Caption -> H.
    pub cond_emb: Linear,
    /// Codes, mask, pad -> embedding.
    pub token_emb: Embedding,
    /// H -> codes.
    pub output_process: OutputProcess,
}

impl MaskedTransformer {
    /// Creates a generator with initial weights.
    pub fn new(config: &MomaskConfig, init: &mut Init<'_>) -> Self {
        let TokenNetwork { width, embedding, .. } = config.network;
        Self {
            input_process: InputProcess { poseEmbedding: linear(init, embedding, width) },
            seqTransEncoder: Blocks::new(config, init),
            cond_emb: linear(init, config.text_dim, width),
            token_emb: Embedding::new(init, config.codes + 2, embedding),
            output_process: OutputProcess::new(init, width, config.codes),
        }
    }

    /// Logits [B, n, K] of each position of `ids` [B n]; the first `lengths[b]` are valid. `text_bc` [B, C] is zero for
    /// the null condition.
    pub fn forward(&self, ids: &[usize], text_bc: Tensor<2>, lengths: &[usize], drop: &mut Dropout) -> Tensor<3> {
        let batch = lengths.len();
        let condition = leading(&self.cond_emb, text_bc);
        let tokens = self.token_emb.rows(ids, batch);
        let parts = (&self.input_process, &self.seqTransEncoder);
        self.output_process.forward(trunk(parts, vec![condition], tokens, lengths, drop))
    }
}

/// Maps [B, C] to [B, 1, H].
fn leading(layer: &Linear, x_bc: Tensor<2>) -> Tensor<3> {
    let out = layer.forward(x_bc);
    let [batch, width] = out.dims();
    out.reshape([batch, 1, width])
}

/// Generator of the tokens of layer j, given those of the layers below it.
#[derive(Module, Debug)]
pub struct ResidualTransformer {
    /// Tables between the first input and the last output, if tables are shared: `[Q - 2, K + 1, d]`. The output table of
    /// layer k is the input table of layer k.
    pub embed_proj_shared_weight: Option<Param<Tensor<3>>>,
    /// Input table of layer 0, if tables are shared: `[1, K + 1, d]`.
    pub token_embed_weight_: Option<Param<Tensor<3>>>,
    /// Output table of the last layer, if tables are shared: `[1, K + 1, d]`.
    pub output_proj_weight_: Option<Param<Tensor<3>>>,
    /// Output tables of layers 1 to Q - 1, if tables are not shared: `[Q - 1, K + 1, d]`.
    pub output_proj_weight: Option<Param<Tensor<3>>>,
    /// Output biases, if tables are not shared: `[Q, K + 1]`. The last row is unused.
    pub output_proj_bias: Option<Param<Tensor<2>>>,
    /// Input tables of layers 0 to Q - 2, if tables are not shared: `[Q - 1, K + 1, d]`.
    pub token_embed_weight: Option<Param<Tensor<3>>>,
    /// Embedding -> H.
    pub input_process: InputProcess,
    pub seqTransEncoder: Blocks,
    /// One-hot layer -> H.
    pub quant_emb: Linear,
    /// Caption -> H.
    pub cond_emb: Linear,
    /// H -> embedding.
    pub output_process: OutputProcess,
    quantizers: usize,
}

impl ResidualTransformer {
    /// Creates a generator with initial weights; `shared` selects shared tables, as published.
    ///
    /// # Panics
    /// If there are fewer than three layers of codes: upstream's shared tables start at the third.
    pub fn new(config: &MomaskConfig, shared: bool, init: &mut Init<'_>) -> Self {
        let MomaskConfig { codes, quantizers, .. } = *config;
        let TokenNetwork { width, embedding: dim, .. } = config.network;
        assert!(quantizers > 2, "a residual generator has at least three layers of codes");
        let mut table = |rows: usize| init.scaled_normal(DEVIATION, [rows, codes + 1, dim]);
        let mut part = |wanted: bool, rows: usize| wanted.then(|| table(rows));
        let between = part(shared, quantizers - 2);
        let first = part(shared, 1);
        let last = part(shared, 1);
        let outputs = part(!shared, quantizers - 1);
        let inputs = part(!shared, quantizers - 1);
        Self {
            embed_proj_shared_weight: between,
            token_embed_weight_: first,
            output_proj_weight_: last,
            output_proj_weight: outputs,
            output_proj_bias: (!shared).then(|| init.constant(0.0, [quantizers, codes + 1])),
            token_embed_weight: inputs,
            input_process: InputProcess { poseEmbedding: linear(init, dim, width) },
            seqTransEncoder: Blocks::new(config, init),
            quant_emb: linear(init, quantizers, width),
            cond_emb: linear(init, config.text_dim, width),
            output_process: OutputProcess::new(init, width, dim),
            quantizers,
        }
    }

    /// Selects table `row` [K + 1, d] of the concatenated tables.
    ///
    /// # Panics
    /// If neither the shared nor the unshared tables are present, which [`new`](Self::new) rules out.
    fn table(parts: [&Option<Param<Tensor<3>>>; 3], row: usize) -> Tensor<2> {
        let mut row = row;
        for part in parts.into_iter().flatten() {
            let [rows, classes, dim] = part.dims();
            if row < rows {
                return part.val().slice([row..row + 1, 0..classes, 0..dim]).reshape([classes, dim]);
            }
            row -= rows;
        }
        panic!("a residual generator has tables for all of its layers")
    }

    /// Embeds the tokens of layer `layer` (0 to Q - 2), [B n] ids -> [B, n, d].
    pub fn embed(&self, ids: &[usize], layer: usize, batch: usize) -> Tensor<3> {
        let parts = [&self.token_embed_weight_, &self.embed_proj_shared_weight, &self.token_embed_weight];
        rows_of(Self::table(parts, layer), ids, batch)
    }

    /// The network's output before the classes, [B, n, d], for the sum of embeddings `sum_bnd` [B, n, d]. `layers[b]`
    /// (1 to Q - 1) is the layer to generate.
    pub fn features(
        &self,
        sum_bnd: Tensor<3>,
        layers: &[usize],
        text_bc: Tensor<2>,
        lengths: &[usize],
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let batch = layers.len();
        let mut own = vec![0.0_f32; batch * self.quantizers];
        layers.iter().enumerate().for_each(|(b, layer)| own[b * self.quantizers + layer] = 1.0);
        let own = Tensor::from_data(TensorData::new(own, [batch, self.quantizers]), &sum_bnd.device());
        let ahead = vec![leading(&self.cond_emb, text_bc), leading(&self.quant_emb, own)];
        let parts = (&self.input_process, &self.seqTransEncoder);
        self.output_process.forward(trunk(parts, ahead, sum_bnd, lengths, drop))
    }

    /// Logits [B, n, K + 1] of the tokens of layer `layers[b]`; the last class is the pad.
    pub fn forward(
        &self,
        sum_bnd: Tensor<3>,
        layers: &[usize],
        text_bc: Tensor<2>,
        lengths: &[usize],
        drop: &mut Dropout,
    ) -> Tensor<3> {
        let out = self.features(sum_bnd, layers, text_bc, lengths, drop);
        let [_, len, dim] = out.dims();
        let parts = [&self.embed_proj_shared_weight, &self.output_proj_weight_, &self.output_proj_weight];
        let rows = layers.iter().enumerate().map(|(b, layer)| {
            let one = out.clone().slice([b..b + 1, 0..len, 0..dim]);
            let logits = kernels::linear(one, Self::table(parts, layer - 1), None);
            match &self.output_proj_bias {
                None => logits,
                Some(bias) => {
                    let classes = bias.dims()[1];
                    logits * 2.0 + bias.val().slice([layer - 1..*layer, 0..classes]).reshape([1, 1, classes])
                }
            }
        });
        Tensor::cat(rows.collect(), 0)
    }
}
