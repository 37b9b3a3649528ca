//! The autoregressive token generator. Source: T2M-GPT (Zhang et al., CVPR 2023).
//!
//! One sequence: a token for the caption, then the tokens of the motion so far; fixed positions on all of them; causal pre-norm blocks, whose
//! first half is called base and whose second head. Classes are the codes and the end; a further id pads.
//!
//! Departs: the published state holds a learned position table that nothing reads, its fixed table and its causal masks; here they are not
//! parameters.

use burn::module::Module;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::attend::{Embedding, GptBlock, GptHead, Sight, causal, linear, sinusoids};
use super::{Init, Linear};
use crate::kernels::Dropout;

/// Size of the generator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GptConfig {
    /// Codes K.
    pub codes: usize,
    /// Width H.
    pub width: usize,
    /// Heads.
    pub heads: usize,
    /// Blocks of each half.
    pub layers: usize,
    /// Positions, the caption's counted.
    pub block: usize,
    /// Width of a caption embedding.
    pub text_dim: usize,
    /// Feed-forward width over H.
    pub rate: usize,
}

impl GptConfig {
    /// The id that ends a motion.
    pub fn end(&self) -> usize {
        self.codes
    }

    /// The id behind the end.
    pub fn pad(&self) -> usize {
        self.codes + 1
    }
}

/// The first half.
#[derive(Module, Debug)]
pub struct GptBase {
    /// Codes, end, pad -> H.
    pub tok_emb: Embedding,
    /// Caption -> H.
    pub cond_emb: Linear,
    /// Blocks.
    pub blocks: Vec<GptBlock>,
}

/// The generator.
#[derive(Module, Debug)]
pub struct Gpt {
    /// Embeddings and the first blocks.
    pub trans_base: GptBase,
    /// The other blocks and the logits.
    pub trans_head: GptHead,
    block: usize,
}

impl Gpt {
    /// A fresh one: weights normal with deviation 0.02, biases 0.
    pub fn new(config: &GptConfig, init: &mut Init<'_>) -> Self {
        let GptConfig { codes, width, heads, layers, rate, .. } = *config;
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
        let sight = Sight::Bias(Box::new(causal(len, &device)));
        let x = self.trans_base.blocks.iter().fold(x, |x, block| block.forward(x, &sight, dropout));
        self.trans_head.forward(x, &sight, dropout)
    }
}
