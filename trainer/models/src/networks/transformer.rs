//! Post-norm transformer blocks and the skip stack of MLD (Chen et al., arXiv:2212.04048, after DETR and U-ViT).
//!
//! A block is `x <- LN(x + Attention(x))`, with memory also `x <- LN(x + CrossAttention(x, memory))`, then
//! `x <- LN(x + W2 GELU(W1 x))`. A stack of 2k + 1 blocks keeps the outputs of the first k. Before each of the last k
//! the newest kept output is appended, `[x, skip]`, and a Linear restores the width. A LayerNorm ends the stack.
//!
//! Departs: biases of cloned layers are drawn separately; upstream copies one layer.

use burn::module::{Module, Param};
use burn::tensor::Tensor;
use protocol::stage::Network;

use super::Init;
use crate::kernels::{self, Dropout, KeyMask};

/// Size of a stack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StackConfig {
    pub width: usize,
    /// Number of blocks; odd for a skip stack.
    pub layers: usize,
    /// Number of attention heads.
    pub heads: usize,
    pub feed_forward: usize,
    /// Added to variances in layer norms.
    pub norm_eps: f64,
    /// Adds attention to a memory to every block.
    pub memory: bool,
}

/// Added to variances in the layer norms of all published transformers of motion.
pub(super) const NORM_EPS: f64 = 1e-5;

impl StackConfig {
    /// The size in a stage's settings, without memory.
    pub fn of(network: &Network) -> Self {
        let Network { width, layers, heads, feed_forward, .. } = *network;
        Self { width, layers, heads, feed_forward, norm_eps: NORM_EPS, memory: false }
    }
}

/// `y = x W^T + b`; `weight` [out, in] as published.
#[derive(Module, Debug)]
pub struct Linear {
    /// Weights of shape [out, in].
    pub weight: Param<Tensor<2>>,
    /// Bias of shape [out].
    pub bias: Option<Param<Tensor<1>>>,
}

impl Linear {
    /// Initialises in PyTorch's default range.
    pub fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.fan_in(inner, [out, inner]), bias: Some(init.fan_in(inner, [out])) }
    }

    /// Initialises the weight Xavier-uniform and the bias by default, as inside skip stacks.
    pub fn xavier(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.xavier(out, inner), bias: Some(init.fan_in(inner, [out])) }
    }

    /// Initialises to zero, without a bias.
    pub fn zero(init: &Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.constant(0.0, [out, inner]), bias: None }
    }

    /// Maps [..., in] to [..., out].
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        kernels::linear(x, self.weight.val(), self.bias.as_ref().map(Param::val))
    }
}

/// Layer norm's scale and shift.
#[derive(Module, Debug)]
pub struct Norm {
    /// Scale of shape [width].
    pub weight: Param<Tensor<1>>,
    /// Shift of shape [width].
    pub bias: Param<Tensor<1>>,
}

impl Norm {
    /// Initialises the scale to ones and the shift to zeros.
    pub fn new(init: &Init<'_>, width: usize) -> Self {
        Self { weight: init.constant(1.0, [width]), bias: init.constant(0.0, [width]) }
    }

    /// Computes `LN(x)` over the last axis.
    pub fn forward<const D: usize>(&self, x: Tensor<D>, eps: f64) -> Tensor<D> {
        kernels::layer_norm(x, self.weight.val(), self.bias.val(), eps)
    }

    /// Computes a leaky ReLU of `LN(x)`, added to `y` if there is one, in one pass.
    pub fn leaky<const D: usize>(&self, x: Tensor<D>, y: Option<Tensor<D>>, eps: f64, slope: f64) -> Tensor<D> {
        kernels::leaky_layer_norm(x, y, self.weight.val(), self.bias.val(), eps, slope)
    }

    /// Computes `LN(x + y)` in one pass.
    pub fn after<const D: usize>(&self, x: Tensor<D>, y: Tensor<D>, eps: f64) -> Tensor<D> {
        kernels::add_layer_norm(x, y, self.weight.val(), self.bias.val(), eps)
    }
}

/// Multi-head attention with one packed projection.
#[derive(Module, Debug)]
pub struct Attention {
    /// [3H, H]: queries, keys, values.
    pub in_proj_weight: Param<Tensor<2>>,
    /// Bias of shape [3H].
    pub in_proj_bias: Param<Tensor<1>>,
    /// H -> H.
    pub out_proj: Linear,
    heads: usize,
}

impl Attention {
    fn new(init: &mut Init<'_>, width: usize, heads: usize) -> Self {
        Self {
            in_proj_weight: init.xavier(3 * width, width),
            in_proj_bias: init.constant(0.0, [3 * width]),
            out_proj: Linear { weight: init.xavier(width, width), bias: Some(init.constant(0.0, [width])) },
            heads,
        }
    }

    fn own(&self, x_bth: Tensor<3>, mask: Option<&KeyMask>, dropout: &mut Dropout) -> Tensor<3> {
        let qkv = kernels::linear(x_bth, self.in_proj_weight.val(), Some(self.in_proj_bias.val()));
        self.out_proj.forward(kernels::self_attention(qkv, self.heads, mask, dropout))
    }

    fn cross(&self, x_bth: Tensor<3>, memory_bnh: Tensor<3>, dropout: &mut Dropout) -> Tensor<3> {
        let width = x_bth.dims()[2];
        let weight = self.in_proj_weight.val();
        let bias = self.in_proj_bias.val();
        let q = kernels::linear(x_bth, weight.clone().slice([0..width, 0..width]), Some(bias.clone().slice(0..width)));
        let kv =
            kernels::linear(memory_bnh, weight.slice([width..3 * width, 0..width]), Some(bias.slice(width..3 * width)));
        self.out_proj.forward(kernels::cross_attention(q, kv, self.heads, None, dropout))
    }
}

/// A transformer block; with `multihead_attn` and `norm3` it is a decoder layer.
#[derive(Module, Debug)]
pub struct Block {
    /// Attention among the tokens.
    pub self_attn: Attention,
    /// Attention to the memory.
    pub multihead_attn: Option<Attention>,
    /// H -> feed-forward.
    pub linear1: Linear,
    /// Feed-forward -> H.
    pub linear2: Linear,
    /// Norm after self-attention.
    pub norm1: Norm,
    /// Norm after the feed-forward, or after cross-attention if the block has it.
    pub norm2: Norm,
    /// Norm after the feed-forward, if the block has cross-attention.
    pub norm3: Option<Norm>,
    eps: f64,
}

impl Block {
    /// Creates a block of `config`'s size.
    pub fn new(init: &mut Init<'_>, config: &StackConfig) -> Self {
        let StackConfig { width, heads, feed_forward, memory, norm_eps, .. } = *config;
        Self {
            self_attn: Attention::new(init, width, heads),
            multihead_attn: memory.then(|| Attention::new(init, width, heads)),
            linear1: Linear::xavier(init, width, feed_forward),
            linear2: Linear::xavier(init, feed_forward, width),
            norm1: Norm::new(init, width),
            norm2: Norm::new(init, width),
            norm3: memory.then(|| Norm::new(init, width)),
            eps: norm_eps,
        }
    }

    /// [B, T, H] -> [B, T, H].
    pub fn forward(
        &self,
        x_bth: Tensor<3>,
        memory_bnh: Option<Tensor<3>>,
        mask: Option<&KeyMask>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let attended = self.self_attn.own(x_bth.clone(), mask, dropout);
        let mut x_bth = self.norm1.after(x_bth, kernels::dropout(attended, dropout), self.eps);
        let mut last = &self.norm2;
        if let (Some(attention), Some(memory), Some(norm3)) = (&self.multihead_attn, memory_bnh, &self.norm3) {
            let attended = attention.cross(x_bth.clone(), memory, dropout);
            x_bth = self.norm2.after(x_bth, kernels::dropout(attended, dropout), self.eps);
            last = norm3;
        }
        let hidden = kernels::dropout(kernels::gelu(self.linear1.forward(x_bth.clone())), dropout);
        let out = kernels::dropout(self.linear2.forward(hidden), dropout);
        last.after(x_bth, out, self.eps)
    }
}

/// Blocks with skip connections, and the final norm.
#[derive(Module, Debug)]
pub struct SkipStack {
    /// Blocks of the first half.
    pub input_blocks: Vec<Block>,
    /// Block between the halves.
    pub middle_block: Block,
    /// Blocks of the second half.
    pub output_blocks: Vec<Block>,
    /// [x, skip] -> H before each block of the second half.
    pub linear_blocks: Vec<Linear>,
    /// Norm after the last block; a ControlNet has none.
    pub norm: Option<Norm>,
    eps: f64,
}

impl SkipStack {
    /// Creates a stack of `config`'s size.
    ///
    /// # Panics
    /// If the number of layers is even; the pipeline reader refuses that earlier.
    pub fn new(init: &mut Init<'_>, config: &StackConfig) -> Self {
        assert!(config.layers % 2 == 1, "a skip stack has an odd number of layers");
        let half = config.layers / 2;
        Self {
            input_blocks: (0..half).map(|_| Block::new(init, config)).collect(),
            middle_block: Block::new(init, config),
            output_blocks: (0..half).map(|_| Block::new(init, config)).collect(),
            linear_blocks: (0..half).map(|_| Linear::xavier(init, 2 * config.width, config.width)).collect(),
            norm: Some(Norm::new(init, config.width)),
            eps: config.norm_eps,
        }
    }

    /// [B, T, H] -> [B, T, H].
    pub fn forward(
        &self,
        x_bth: Tensor<3>,
        memory_bnh: Option<&Tensor<3>>,
        mask: Option<&KeyMask>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        self.forward_blocks(x_bth, memory_bnh, mask, dropout, |_, x| x)
    }

    /// Like [`forward`](Self::forward), but `pass` replaces the output of every block, in order; it also receives the
    /// block's number.
    pub fn forward_blocks(
        &self,
        mut x_bth: Tensor<3>,
        memory_bnh: Option<&Tensor<3>>,
        mask: Option<&KeyMask>,
        dropout: &mut Dropout,
        mut pass: impl FnMut(usize, Tensor<3>) -> Tensor<3>,
    ) -> Tensor<3> {
        let mut block_number = 0;
        let mut pass = |x: Tensor<3>| {
            block_number += 1;
            pass(block_number - 1, x)
        };
        let mut skips = Vec::with_capacity(self.input_blocks.len());
        for block in &self.input_blocks {
            x_bth = pass(block.forward(x_bth, memory_bnh.cloned(), mask, dropout));
            skips.push(x_bth.clone());
        }
        x_bth = pass(self.middle_block.forward(x_bth, memory_bnh.cloned(), mask, dropout));
        for (block, merge) in self.output_blocks.iter().zip(&self.linear_blocks) {
            let skip = skips.pop().expect("as many skips as output blocks");
            x_bth = merge.forward(Tensor::cat(vec![x_bth, skip], 2));
            x_bth = pass(block.forward(x_bth, memory_bnh.cloned(), mask, dropout));
        }
        match &self.norm {
            Some(norm) => norm.forward(x_bth, self.eps),
            None => x_bth,
        }
    }
}
