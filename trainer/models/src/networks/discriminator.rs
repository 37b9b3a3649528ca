//! MotionPCM's discriminator: small heads on the block features of the frozen teacher. Source: MotionPCM
//! (arXiv:2501.19083), which says "linear layers, layer norm, activation, residual" and gives no sizes, and the image
//! repository that it follows.
//!
//! A head is `h1 = a(LN(W1 f))`, `h2 = h1 + a(LN(W2 h1))`, `score = W3 h2` for each latent token, with `a` a leaky ReLU,
//! of slope 0.01 in the image repository. There is one head per block. Our choice: width of the blocks, LayerNorm (the image heads have
//! GroupNorm), a score per token.

use burn::module::Module;
use burn::tensor::Tensor;

use super::{Init, Linear, Norm};

/// The scoring layers of one teacher block.
#[derive(Module, Debug)]
pub struct Head {
    /// H -> H.
    pub linear1: Linear,
    pub norm1: Norm,
    /// H -> H.
    pub linear2: Linear,
    pub norm2: Norm,
    /// H -> 1.
    pub score: Linear,
}

/// Heads, one per block of the teacher.
#[derive(Module, Debug)]
pub struct Discriminator {
    /// Heads in the order of the blocks.
    pub heads: Vec<Head>,
    /// Slope of the leaky ReLUs below zero.
    pub slope: f64,
}

impl Discriminator {
    /// Creates heads for a teacher of `layers` blocks of `width`, with leaky ReLUs of `slope`.
    pub fn new(layers: usize, width: usize, slope: f64, init: &mut Init<'_>) -> Self {
        let head = |_| Head {
            linear1: Linear::new(init, width, width),
            norm1: Norm::new(init, width),
            linear2: Linear::new(init, width, width),
            norm2: Norm::new(init, width),
            score: Linear::new(init, width, 1),
        };
        Self { heads: (0..layers).map(head).collect(), slope }
    }

    /// Scores [B, N, 1] of each head on its features [B, N, H].
    pub fn forward(&self, features: Vec<Tensor<3>>) -> Vec<Tensor<3>> {
        const EPS: f64 = 1e-5;
        let one = |(head, f): (&Head, Tensor<3>)| {
            let h1 = head.norm1.leaky(head.linear1.forward(f), None, EPS, self.slope);
            let h2 = head.norm2.leaky(head.linear2.forward(h1.clone()), Some(h1), EPS, self.slope);
            head.score.forward(h2)
        };
        self.heads.iter().zip(features).map(one).collect()
    }
}
