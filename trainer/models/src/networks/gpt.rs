//! The autoregressive token generator. Source: T2M-GPT (Zhang et al., CVPR 2023).
//!
//! The sequence is a token for the caption, then the tokens of the motion so far, with fixed positions on all of them.
//! Causal pre-norm blocks follow; their first half is called base and their second half head. Classes are the codes and
//! the end; one further id pads.
//!
//! Departs: the published state holds an unused learned position table, its fixed table and its causal masks; here they
//! are not parameters.

use burn::module::Module;
use burn::tensor::Tensor;
use protocol::stage::TokenNetwork;

use super::attend::{Embedding, GptBlock, GptHead, Sight, linear, sinusoids};
use super::{Init, Linear};
use crate::kernels::Dropout;

/// Size of the generator.
#[derive(Debug, Clone, PartialEq)]
pub struct GptConfig {
    /// Number of codes K.
    pub codes: usize,
    /// Size of the network, with `layers` blocks in each half. Its dropout is an argument of each pass.
    pub network: TokenNetwork,
    /// Number of positions, the caption's included.
    pub block: usize,
    /// Width of a caption embedding.
    pub text_dim: usize,
}

impl GptConfig {
    /// The id that ends a motion.
    pub fn end(&self) -> usize {
        self.codes
    }

    /// The id that pads after the end.
    pub fn pad(&self) -> usize {
        self.codes + 1
    }
}

/// The embeddings and the first half of the blocks.
#[derive(Module, Debug)]
pub struct GptBase {
    /// Codes, end, pad -> H.
    pub tok_emb: Embedding,
    /// Caption -> H.
    pub cond_emb: Linear,
    pub blocks: Vec<GptBlock>,
}

/// The token generator of T2M-GPT.
#[derive(Module, Debug)]
pub struct Gpt {
    /// Embeddings and the first blocks.
    pub trans_base: GptBase,
    /// The second half of the blocks, and the logits.
    pub trans_head: GptHead,
    block: usize,
}

impl Gpt {
    /// Creates a generator: weights normal with deviation 0.02, biases 0.
    pub fn new(config: &GptConfig, init: &mut Init<'_>) -> Self {
        let codes = config.codes;
        let TokenNetwork { width, heads, layers, feed_forward, .. } = config.network;
        let rate = feed_forward / width;
        Self {
            trans_base: GptBase {
                tok_emb: Embedding::new(init, codes + 2, width),
                cond_emb: linear(init, config.text_dim, width),
                blocks: (0..layers).map(|_| GptBlock::new(init, width, heads, rate)).collect(),
            },
            trans_head: GptHead::new(init, (width, heads, rate), layers, codes + 1),
            block: config.block,
        }
    }

    /// Logits [B, T + 1, K + 1] of the id after the caption and after each of `ids` [B T]. `text_bc` [B, C].
    ///
    /// # Panics
    /// If there are more positions than the network has.
    pub fn forward(&self, ids: &[usize], text_bc: Tensor<2>, dropout: &mut Dropout) -> Tensor<3> {
        let batch = text_bc.dims()[0];
        let len = ids.len() / batch + 1;
        assert!(len <= self.block, "{len} positions, the network has {}", self.block);
        let device = text_bc.device();
        let condition = self.trans_base.cond_emb.forward(text_bc);
        let width = condition.dims()[1];
        let condition = condition.reshape([batch, 1, width]);
        let x = match len {
            1 => condition,
            _ => Tensor::cat(vec![condition, self.trans_base.tok_emb.rows(ids, batch)], 1),
        };
        let x = x + sinusoids(len, width, &device);
        let x = self.trans_base.blocks.iter().fold(x, |x, block| block.forward(x, &Sight::Before, dropout));
        self.trans_head.forward(x, &Sight::Before, dropout)
    }
}
