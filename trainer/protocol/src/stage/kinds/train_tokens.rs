//! `train.tokens`: token generators: autoregressive (T2M-GPT), masked with residual layers (MoMask), masked with words
//! (MMM).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::network::transformer_parameters;
use crate::stage::{
    Batch, Decay, Family, Neighbours, Optimizer, Output, Problems, Ref, Replicas, Shape, StageSpec, TrainTokenizer,
    Training,
};
use crate::{ArtifactKind, Steps};

/// Method of generating tokens.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TokenGenerator {
    /// One after the other, until an end is drawn (T2M-GPT).
    #[default]
    Autoregressive,
    /// All tokens at once in several iterations; then the layers above the first (MoMask).
    Masked,
    /// All tokens at once in several iterations, by a network that attends to the caption's words, without guidance
    /// (MMM).
    Mmm,
}

/// Size of a token generator. The default is T2M-GPT's and MMM's; MoMask's two networks have 384, 8, 6, 1024, 0.2 and
/// 512.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TokenNetwork {
    /// Width H of the network.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub width: usize,
    /// Number of blocks: of each half of T2M-GPT's and MMM's network, of each of MoMask's two networks.
    #[schemars(range(min = 1, max = 255), extend("x-unit" = "layers"))]
    pub layers: usize,
    /// Number of attention heads; divides `width`.
    #[schemars(range(min = 1, max = 1_024), extend("x-unit" = "heads"))]
    pub heads: usize,
    /// Width of the feed-forward layer; a multiple of `width` for T2M-GPT and MMM.
    #[schemars(range(min = 1, max = 65_536), extend("x-unit" = "channels"))]
    pub feed_forward: usize,
    /// Probability of dropout.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
    /// Width of MoMask's token embeddings. T2M-GPT's have the network's width, MMM's are the tokenizer's codes.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "channels"))]
    pub embedding: usize,
    /// Number of blocks in the first half of MMM's network that attend to the caption's words; at most `layers`.
    #[schemars(range(min = 0, max = 255), extend("x-unit" = "blocks"))]
    pub word_blocks: usize,
}

impl Default for TokenNetwork {
    fn default() -> Self {
        Self { width: 1024, layers: 9, heads: 16, feed_forward: 4096, dropout: 0.1, embedding: 512, word_blocks: 2 }
    }
}

impl TokenNetwork {
    fn check(&self, p: &mut Problems) {
        p.parameters(transformer_parameters(self.width, self.feed_forward, self.layers).saturating_mul(2));
        p.equal_heads("network.heads", self.heads, "network.width", self.width);
    }
}

/// `train.tokens`: trains a token generator. The default is T2M-GPT's recipe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainTokens {
    /// Stage that gives the tokens.
    pub tokens: String,
    /// Stage that gives the tokenizer that encoded them.
    pub tokenizer: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// For MMM: stage that gives the clips of the tokens, whose captions are read word by word.
    pub dataset: String,
    /// Method of generating tokens.
    pub generator: TokenGenerator,
    /// Size of the network.
    pub network: TokenNetwork,
    /// Tokens of the longest motion; longer ones are cut at random.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "tokens"))]
    pub longest: usize,
    /// For `autoregressive` and `mmm`: probability that a random code replaces a token of the input.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the tokens"))]
    pub corruption: f64,
    /// For `masked`: probability that the first layer's network gets no caption; the residual network has twice this,
    /// 0.1 and 0.2 as published.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the captions"))]
    pub guidance_dropout: f64,
    /// Stage or version, such as `momask@prod`, whose generator supplies initial weights where shapes fit; empty starts
    /// from random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer. Published: T2M-GPT and MMM 300,000 steps with a rate of 1e-4 and 2e-4 that falls
    /// once, at half of them; here it follows a cosine.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainTokens {
    fn default() -> Self {
        Self {
            tokens: "tokens".into(),
            tokenizer: "tokenizer".into(),
            text: "text".into(),
            dataset: "dataset".into(),
            generator: TokenGenerator::Autoregressive,
            network: TokenNetwork::default(),
            longest: 49,
            corruption: 0.5,
            guidance_dropout: 0.1,
            init: String::new(),
            training: Training {
                steps: Steps(300_000),
                batch: Batch { global: 128, slices: 8 },
                lr: 1e-4,
                warmup: Steps(0),
                decay: Decay::Cosine,
                optimizer: Optimizer { beta1: 0.5, beta2: 0.9, weight_decay: 1e-6, ..Optimizer::default() },
                max_grad_norm: 0.0,
                sync: Replicas::default(),
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainTokens {
    const KIND: &'static str = "train.tokens";
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let words = self.generator == TokenGenerator::Mmm;
        vec![
            Ref::stage("tokens", &mut self.tokens, ArtifactKind::Tokens),
            Ref::stage("tokenizer", &mut self.tokenizer, ArtifactKind::Tokenizer),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset).only_if(words),
            Ref::init(&mut self.init, ArtifactKind::Model, ArtifactKind::TokenGenerator),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.network.check(p);
        if self.generator == TokenGenerator::Masked && self.guidance_dropout > 0.5 {
            let message = format!("`guidance_dropout` is {}; expected at most 0.5", self.guidance_dropout);
            p.add("guidance_dropout", message, "the residual transformer uses twice this value");
        }
        let TokenNetwork { width, layers, feed_forward, word_blocks, .. } = self.network;
        if self.generator != TokenGenerator::Masked && width > 0 && !feed_forward.is_multiple_of(width) {
            let message =
                format!("`network.feed_forward` is {feed_forward}; expected a multiple of `network.width` ({width})");
            p.add("network.feed_forward", message, "published: four times the width");
        }
        if self.generator == TokenGenerator::Mmm && word_blocks > layers {
            let message = format!("`network.word_blocks` is {word_blocks}, but `network.layers` is {layers}");
            p.add("network.word_blocks", message, "expected at most as many; published: 2 of 9");
        }
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        if let Some(other) = stages.read_by(&self.tokens, ArtifactKind::Tokenizer)
            && other != self.tokenizer
        {
            let tokens = &self.tokens;
            let ours = &self.tokenizer;
            let message = format!("`tokenizer` is `{ours}`, but `{tokens}` was encoded with `{other}`");
            p.add(
                "tokenizer",
                message,
                "tokens have a meaning only with their own tokenizer; use the same tokenizer in both places",
            );
        }
        stages.same_data(p, &self.tokens, &self.text);
        if self.generator == TokenGenerator::Mmm {
            stages.same_clips(p, &self.dataset, &self.tokens);
        }
        let quantizers =
            stages.stage(&self.tokenizer).and_then(|stage| stage.get::<TrainTokenizer>()).map(|t| t.quantizers);
        let tokenizer = &self.tokenizer;
        match (self.generator, quantizers) {
            (TokenGenerator::Autoregressive | TokenGenerator::Mmm, Some(many)) if many > 1 => {
                let word = if self.generator == TokenGenerator::Mmm { "mmm" } else { "autoregressive" };
                let message = format!("`generator` is `{word}`, but `{tokenizer}` has {many} codebooks; expected 1");
                p.add("generator", message, "write `generator: masked`, or set `quantizers: 1` in the tokenizer");
            }
            (TokenGenerator::Masked, Some(2)) => {
                let message =
                    format!("`generator` is `masked`, but `{tokenizer}` has 2 codebooks; expected 1, or at least 3");
                p.add("generator", message, "the residual transformer shares tables between its layers");
            }
            _ => {}
        }
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        match self.generator {
            TokenGenerator::Autoregressive | TokenGenerator::Mmm => &["loss"],
            TokenGenerator::Masked => &["loss", "first", "above"],
        }
    }

    fn family(&self) -> Option<Family> {
        Some(match self.generator {
            TokenGenerator::Autoregressive => Family::Autoregressive,
            TokenGenerator::Masked => Family::Masked,
            TokenGenerator::Mmm => Family::Mmm,
        })
    }
}
