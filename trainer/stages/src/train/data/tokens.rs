//! Examples for token generators: a clip's ids, one of its captions, and their keyed draws.
//!
//! With probability 1/3 a clip loses its first or its last token, as in T2M-GPT, MMM and, in frames, MoMask.

use burn::tensor::{Device, Tensor, TensorData};
use motion::Stream;
use protocol::Seed;

use crate::artifacts::Embeddings;
use crate::parts::tokenizer::Tokens;
use crate::train::{Order, Pick};

/// Tokens and captions of the training split.
pub(crate) struct TokenData {
    pub(crate) tokens: Tokens,
    pub(crate) embeddings: Embeddings,
    /// Entries of the split with tokens.
    pub(crate) train: Vec<usize>,
    pub(crate) order: Order,
    pub(crate) seed: Seed,
    pub(crate) purpose: String,
    /// Number of tokens of the longest example.
    pub(crate) longest: usize,
}

impl TokenData {
    pub(crate) fn stream(&self, what: &str, pick: Pick) -> Stream {
        Stream::new(self.seed, &format!("{}/{what}", self.purpose), pick.place, 0)
    }

    pub(crate) fn batch(&mut self, step: u64) -> Vec<Pick> {
        self.order.batch(step, |_| 0)
    }

    /// Ids `[tokens, Q]` of the clip at a place, cut to the longest.
    pub(crate) fn ids(&self, pick: Pick) -> &[i64] {
        let q = self.tokens.meta.quantizers;
        let mut draw = self.stream("clip", pick);
        let all = self.tokens.of(self.train[pick.example]);
        let len = all.len() / q;
        let mut start = 0;
        let mut kept = len;
        if len > self.longest {
            (start, kept) = (draw.below(len - self.longest + 1), self.longest);
        } else if len > 1 && draw.below(3) == 0 {
            (start, kept) = (draw.below(2), len - 1);
        }
        &all[start * q..(start + kept) * q]
    }

    /// Tokens of layer `layer` of the clip at a place.
    pub(crate) fn layer(&self, pick: Pick, layer: usize) -> Vec<usize> {
        self.ids(pick).iter().skip(layer).step_by(self.tokens.meta.quantizers).map(|id| *id as usize).collect()
    }

    /// Index of the caption of the clip at a place.
    pub(crate) fn caption(&self, pick: Pick) -> usize {
        let captions = &self.tokens.meta.captions[self.train[pick.example]];
        captions[self.stream("caption", pick).below(captions.len())]
    }

    /// Caption embeddings [B, C]; a row is zero with probability `drop`.
    pub(crate) fn text(&self, picks: &[Pick], drop: f64, what: &str, device: &Device) -> Tensor<2> {
        let width = self.embeddings.meta.dim;
        let mut values = Vec::with_capacity(picks.len() * width);
        for pick in picks {
            match self.stream(what, *pick).uniform() < drop {
                true => values.resize(values.len() + width, 0.0),
                false => values.extend_from_slice(self.embeddings.captions.row(self.caption(*pick))),
            }
        }
        Tensor::from_data(TensorData::new(values, [picks.len(), width]), device)
    }
}

/// Makes `count` uniform draws.
pub(crate) fn uniforms(draw: &mut Stream, count: usize) -> Vec<f32> {
    (0..count).map(|_| draw.uniform() as f32).collect()
}
