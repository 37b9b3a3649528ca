//! A plain stack of post-norm transformer blocks: PyTorch's `TransformerEncoder`, without a norm at its end.
//!
//! Initial values are those of PyTorch's class: Xavier for the packed projection, the Linear default for the other
//! weights, zero for the biases of attention. Departs: blocks are drawn separately; upstream copies one block.

use burn::module::Module;
use burn::tensor::Tensor;

use super::{Block, Init, Linear, StackConfig};
use crate::kernels::{Dropout, KeyMask};

/// Blocks, one after the other.
#[derive(Module, Debug)]
pub struct Layers {
    /// Blocks, first to last.
    pub layers: Vec<Block>,
}

impl Layers {
    /// Creates `config.layers` blocks with initial weights. They attend only to their own sequence.
    pub fn new(init: &mut Init<'_>, config: &StackConfig) -> Self {
        let StackConfig { width, feed_forward, layers, .. } = *config;
        let mut block = || {
            let mut block = Block::new(init, config);
            block.self_attn.out_proj.weight = init.fan_in(width, [width, width]);
            block.linear1 = Linear::new(init, width, feed_forward);
            block.linear2 = Linear::new(init, feed_forward, width);
            block
        };
        Self { layers: (0..layers).map(|_| block()).collect() }
    }

    /// [B, T, H] -> [B, T, H].
    pub fn forward(&self, x_bth: Tensor<3>, mask: Option<&KeyMask>, dropout: &mut Dropout) -> Tensor<3> {
        self.layers.iter().fold(x_bth, |x, block| block.forward(x, None, mask, dropout))
    }
}
