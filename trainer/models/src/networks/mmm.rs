//! The masked token generator of MMM (Pinyoanuntapong et al., CVPR 2024).
//!
//! A token is its frozen code, or a learned row for end, pad and mask, through one Linear. Positions are added. Cross
//! blocks attend to the words of the caption (published without a mask on the words). Then the caption's embedding is
//! put in front and positions are added again, starting at its place. So a token carries two neighbouring rows of the
//! table. Pre-norm blocks without a causal mask follow. Classes are the codes.
//!
//! Departs: the published state holds the frozen tokenizer, an unused learned position table, and masks. Here the codes
//! are an argument and the others are not parameters.

use burn::module::Module;
use burn::tensor::Tensor;
use protocol::stage::TokenNetwork;

use super::attend::{CrossBlock, Embedding, GptBlock, GptHead, Sight, hiding, linear, rows_of, sinusoids};
use super::{Init, Linear};
use crate::kernels::{Dropout, KeyMask};

/// Size of the generator.
#[derive(Debug, Clone, PartialEq)]
pub struct MmmConfig {
    /// Number of codes K.
    pub codes: usize,
    /// Width of a code.
    pub dim: usize,
    /// Size of the network: `layers` blocks in each half, `word_blocks` of the first half attend to words. Its dropout
    /// is an argument of each pass.
    pub network: TokenNetwork,
    /// Number of positions, those of the caption and the end included.
    pub block: usize,
    /// Width of the embeddings of captions and words.
    pub text_dim: usize,
}

impl MmmConfig {
    /// The id that ends a motion.
    pub fn end(&self) -> usize {
        self.codes
    }

    /// The id that pads after the end.
    pub fn pad(&self) -> usize {
        self.codes + 1
    }

    /// The id of a token to be generated.
    pub fn mask(&self) -> usize {
        self.codes + 2
    }

    /// Number of positions of tokens and the end.
    pub fn positions(&self) -> usize {
        self.block - 1
    }
}

/// The embeddings and the first half of the blocks.
#[derive(Module, Debug)]
pub struct MmmBase {
    /// End, pad, mask -> code width.
    pub learn_tok_emb: Embedding,
    /// Code width -> H.
    pub to_emb: Linear,
    /// Caption -> H.
    pub cond_emb: Linear,
    /// Word -> H.
    pub word_emb: Linear,
    /// Blocks that attend to the words.
    pub cross_att: Vec<CrossBlock>,
    /// Blocks after the cross blocks.
    pub blocks: Vec<GptBlock>,
}

/// The token generator of MMM.
#[derive(Module, Debug)]
pub struct Mmm {
    /// Embeddings and the first blocks.
    pub trans_base: MmmBase,
    /// The second half of the blocks, and the logits.
    pub trans_head: GptHead,
}

/// The inputs of the network besides the ids.
#[derive(Debug, Clone)]
pub struct MmmCondition {
    /// The tokenizer's codes [K, d].
    pub codes_kd: Tensor<2>,
    /// Captions [B, C].
    pub text_bc: Tensor<2>,
    /// Words [B, W, C].
    pub words_bnc: Tensor<3>,
    /// Number of words of each caption; later words are masked. `None` counts all W, as published, where W is always
    /// 77.
    pub words: Option<Vec<usize>>,
}

impl Mmm {
    /// Creates a generator: weights normal with deviation 0.02, biases 0.
    ///
    /// # Panics
    /// If there are more cross blocks than blocks.
    pub fn new(config: &MmmConfig, init: &mut Init<'_>) -> Self {
        let MmmConfig { codes, dim, text_dim, .. } = *config;
        let TokenNetwork { width, heads, layers, feed_forward, word_blocks: local, .. } = config.network;
        let rate = feed_forward / width;
        assert!(local <= layers, "{local} of {layers} blocks look at the words");
        Self {
            trans_base: MmmBase {
                learn_tok_emb: Embedding::new(init, 3, dim),
                to_emb: linear(init, dim, width),
                cond_emb: linear(init, text_dim, width),
                word_emb: linear(init, text_dim, width),
                cross_att: (0..local).map(|_| CrossBlock::new(init, width, heads, rate)).collect(),
                blocks: (local..layers).map(|_| GptBlock::new(init, width, heads, rate)).collect(),
            },
            trans_head: GptHead::new(init, (width, heads, rate), layers, codes),
        }
    }

    /// Logits [B, 1 + P, K] of the caption's place, which are unused, and of each position of `ids` [B P].
    ///
    /// The first `visible[b]` positions of sequence b are attended to; all of them if it is `None`. The caption's place
    /// is hidden where `text_visible` is false.
    pub fn forward(
        &self,
        ids: &[usize],
        condition: &MmmCondition,
        visible: Option<&[usize]>,
        text_visible: Option<&[bool]>,
        dropout: &mut Dropout,
    ) -> Tensor<3> {
        let MmmCondition { codes_kd, text_bc, words_bnc, words } = condition.clone();
        let base = &self.trans_base;
        let batch = text_bc.dims()[0];
        let device = text_bc.device();
        let positions = ids.len() / batch;
        let table = Tensor::cat(vec![codes_kd, base.learn_tok_emb.weight.val()], 0);
        let x = base.to_emb.forward(rows_of(table, ids, batch));
        let width = x.dims()[2];
        let x = x + sinusoids(positions, width, &device);
        let mask = words.map(|counts| KeyMask::new(&counts, 0));
        let words = base.word_emb.forward(words_bnc);
        let x = base.cross_att.iter().fold(x, |x, block| block.forward(x, words.clone(), mask.as_ref(), dropout));
        let condition = base.cond_emb.forward(text_bc).reshape([batch, 1, width]);
        let x = Tensor::cat(vec![condition, x], 1) + sinusoids(positions + 1, width, &device);
        let sight = match (visible, text_visible) {
            (visible, Some(text)) => {
                let of = |b: usize, p: usize| visible.is_none_or(|visible| p < visible[b]);
                let seen: Vec<bool> = (0..batch)
                    .flat_map(|b| [text[b]].into_iter().chain((0..positions).map(move |p| of(b, p))))
                    .collect();
                Sight::Bias(Box::new(hiding(&seen, batch, &device)))
            }
            (visible, None) => Sight::Keys(visible.map(|visible| KeyMask::new(visible, 1))),
        };
        let x = base.blocks.iter().fold(x, |x, block| block.forward(x, &sight, dropout));
        self.trans_head.forward(x, &sight, dropout)
    }
}
