//! Post-norm transformer blocks and the skip stack of MLD (Chen et al., arXiv:2212.04048, after DETR and U-ViT).
//!
//! A block is `x <- LN(x + Attention(x))`, with memory also `x <- LN(x + CrossAttention(x, memory))`, then
//! `x <- LN(x + W2 GELU(W1 x))`. In a stack of 2k + 1 blocks the outputs of the first k are kept; before each of the last k the
//! newest one is appended, `[x, skip]`, and brought back to width by a Linear. A LayerNorm ends the stack.
//!
//! Departs: biases of cloned layers are drawn apart, upstream they start equal.

use burn::module::{Module, Param};
use burn::tensor::Tensor;

use super::Init;
use crate::kernels::{self, Dropout, KeyMask};

/// Size of a stack.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StackConfig {
    /// Width H.
    pub width: usize,
    /// Blocks; odd.
    pub layers: usize,
    /// Heads.
    pub heads: usize,
    /// Feed-forward width.
    pub feed_forward: usize,
    /// Added to variances.
    pub norm_eps: f64,
    /// Whether blocks attend to a memory.
    pub memory: bool,
}

/// `y = x W^T + b`; `weight` [out, in] as published.
#[derive(Module, Debug)]
pub struct Linear {
    /// [out, in].
    pub weight: Param<Tensor<2>>,
    /// [out].
    pub bias: Option<Param<Tensor<1>>>,
}

impl Linear {
    /// PyTorch's default initialisation.
    pub fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.fan_in(inner, [out, inner]), bias: Some(init.fan_in(inner, [out])) }
    }

    /// Xavier-uniform weight, default bias: as inside skip stacks.
    pub fn xavier(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.xavier(out, inner), bias: Some(init.fan_in(inner, [out])) }
    }

    /// All zeros and no bias.
    pub fn zero(init: &Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.constant(0.0, [out, inner]), bias: None }
    }

    /// [..., in] -> [..., out].
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        kernels::linear(x, self.weight.val(), self.bias.as_ref().map(Param::val))
    }
}

/// Layer norm's scale and shift.
#[derive(Module, Debug)]
pub struct Norm {
    /// [width].
    pub weight: Param<Tensor<1>>,
    /// [width].
    pub bias: Param<Tensor<1>>,
}

impl Norm {
    /// Ones and zeros.
    pub fn new(init: &Init<'_>, width: usize) -> Self {
        Self { weight: init.constant(1.0, [width]), bias: init.constant(0.0, [width]) }
    }

    /// `LN(x)`.
    pub fn forward<const D: usize>(&self, x: Tensor<D>, eps: f64) -> Tensor<D> {
        kernels::layer_norm(x, self.weight.val(), self.bias.val(), eps)
    }

    /// `LN(x + y)`.
    pub fn after<const D: usize>(&self, x: Tensor<D>, y: Tensor<D>, eps: f64) -> Tensor<D> {
        kernels::add_layer_norm(x, y, self.weight.val(), self.bias.val(), eps)
    }
}

/// Multi-head attention with one packed projection.
#[derive(Module, Debug)]
pub struct Attention {
    /// [3H, H]: queries, keys, values.
    pub in_proj_weight: Param<Tensor<2>>,
    /// [3H].
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
        let (weight, bias) = (self.in_proj_weight.val(), self.in_proj_bias.val());
        let q = kernels::linear(x_bth, weight.clone().slice([0..width, 0..width]), Some(bias.clone().slice(0..width)));
        let kv =
            kernels::linear(memory_bnh, weight.slice([width..3 * width, 0..width]), Some(bias.slice(width..3 * width)));
        self.out_proj.forward(kernels::cross_attention(q, kv, self.heads, None, dropout))
    }
}

/// One block; with `multihead_attn` and `norm3` it is a decoder layer.
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
    /// After self-attention.
    pub norm1: Norm,
    /// After the feed-forward, or after cross-attention if there is one.
    pub norm2: Norm,
    /// After the feed-forward, if there is cross-attention.
    pub norm3: Option<Norm>,
    eps: f64,
}

impl Block {
    /// A block of `config`'s size.
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

/// Blocks with skip connections, and the norm that ends them.
#[derive(Module, Debug)]
pub struct SkipStack {
    /// The first half.
    pub input_blocks: Vec<Block>,
    /// Between the halves.
    pub middle_block: Block,
    /// The second half.
    pub output_blocks: Vec<Block>,
    /// [x, skip] -> H before each block of the second half.
    pub linear_blocks: Vec<Linear>,
    /// After the last block; a ControlNet has none.
    pub norm: Option<Norm>,
    eps: f64,
}

impl SkipStack {
    /// A stack of `config`'s size.
    ///
    /// # Panics
    /// If the number of layers is even; the pipeline reader refuses that before.
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

    /// As [`forward`](Self::forward), with the output of every block, in order, replaced by what `pass` makes of it; it is told the block's number.
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
