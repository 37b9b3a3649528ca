//! `train.tokens`: generators of tokens: autoregressive (T2M-GPT), masked with residual layers (MoMask), masked with words (MMM).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{
    Batch, Decay, Family, Neighbours, Optimizer, Output, Problems, Ref, Shape, StageSpec, TrainTokenizer, Training,
};
use crate::{ArtifactKind, Steps, limits};

/// How tokens are generated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TokenGenerator {
    /// One after the other, until an end is drawn (T2M-GPT).
    #[default]
    Autoregressive,
    /// All at once, again and again; then the layers above the first (MoMask).
    Masked,
    /// All at once, again and again, by a network that looks at the caption's words, without guidance (MMM).
    Mmm,
}

/// Size of a token generator. The default is T2M-GPT's, and MMM's; MoMask's two networks have 384, 8, 6, 1024, 0.2 and 512.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TokenNetwork {
    /// Width H.
    pub width: usize,
    /// Blocks: of each half of T2M-GPT's and MMM's, of each of MoMask's two networks.
    pub layers: usize,
    /// Attention heads; divides `width`.
    pub heads: usize,
    /// Width of the feed-forward layer; T2M-GPT's and MMM's are a multiple of `width`.
    pub feed_forward: usize,
    /// Dropout probability.
    pub dropout: f64,
    /// Width of MoMask's token embeddings; T2M-GPT's are as wide as the network, MMM's are the tokenizer's codes.
    pub embedding: usize,
    /// MMM: blocks, counted among `layers` of the first half, that look at the caption's words.
    pub word_blocks: usize,
}

impl Default for TokenNetwork {
    fn default() -> Self {
        Self { width: 1024, layers: 9, heads: 16, feed_forward: 4096, dropout: 0.1, embedding: 512, word_blocks: 2 }
    }
}

impl TokenNetwork {
    fn check(&self, p: &mut Problems) {
        for (field, value) in [
            ("network.width", self.width),
            ("network.layers", self.layers),
            ("network.heads", self.heads),
            ("network.feed_forward", self.feed_forward),
            ("network.embedding", self.embedding),
        ] {
            p.positive(field, value);
        }
        let wide = self.width.saturating_mul(4).saturating_add(self.feed_forward.saturating_mul(2));
        let parameters = self.width.saturating_mul(wide).saturating_mul(self.layers).saturating_mul(2);
        if parameters > limits::PARAMETERS {
            let message = format!("its layers have {parameters} parameters; expected at most {}", limits::PARAMETERS);
            p.add("network", message, "take fewer layers, or narrower ones");
        }
        if self.heads > 0 && !self.width.is_multiple_of(self.heads) {
            let (heads, width) = (self.heads, self.width);
            let message = format!("`network.heads` is {heads}, which does not divide `network.width`, {width}");
            p.add("network.heads", message, "");
        }
        p.fraction("network.dropout", self.dropout, true);
    }
}

/// `train.tokens`. The default is T2M-GPT's recipe.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainTokens {
    /// Stage that gives the tokens.
    pub tokens: String,
    /// Stage that gives the tokenizer that encoded them.
    pub tokenizer: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// MMM: stage that gives the clips of the tokens, whose captions are read word by word.
    pub dataset: String,
    /// How tokens are generated.
    pub generator: TokenGenerator,
    /// Size.
    pub network: TokenNetwork,
    /// Tokens of the longest motion; of longer ones a drawn part is learned.
    pub longest: usize,
    /// Autoregressive and MMM: probability that the network sees another code instead of a token.
    pub corruption: f64,
    /// Masked: probability that the first layer's network sees no caption; half of what the other one has, 0.1 and 0.2 as published.
    pub guidance_dropout: f64,
    /// Stage that gives a model whose generator training begins with where shapes fit, or a version such as `momask@prod`; empty begins with random
    /// weights.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// The rest. Published: T2M-GPT and MMM 300,000 steps whose rate, 1e-4 and 2e-4, falls once, at half of them; here it follows a cosine.
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
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainTokens {
    const KIND: &'static str = "train.tokens";
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
        p.positive("longest", self.longest);
        p.fraction("corruption", self.corruption, false);
        if self.generator == TokenGenerator::Masked && self.guidance_dropout > 0.5 {
            let message = format!("`guidance_dropout` is {}; expected at most 0.5", self.guidance_dropout);
            p.add("guidance_dropout", message, "the network of the layers above the first has twice as much");
        }
        p.fraction("guidance_dropout", self.guidance_dropout, false);
        let TokenNetwork { width, layers, feed_forward, word_blocks, .. } = self.network;
        if self.generator != TokenGenerator::Masked && width > 0 && !feed_forward.is_multiple_of(width) {
            let message = format!(
                "`network.feed_forward` is {feed_forward}, no multiple of `network.width`, {width}; expected one"
            );
            p.add("network.feed_forward", message, "published: four times the width");
        }
        if self.generator == TokenGenerator::Mmm && word_blocks > layers {
            let message = format!("`network.word_blocks` is {word_blocks}, of `network.layers`, {layers}");
            p.add("network.word_blocks", message, "expected at most as many; published: 2 of 9");
        }
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        if let Some(other) = stages.read_by(&self.tokens, ArtifactKind::Tokenizer)
            && other != self.tokenizer
        {
            let (tokens, ours) = (&self.tokens, &self.tokenizer);
            let message = format!("`tokenizer` is `{ours}`, but `{tokens}` was encoded with `{other}`");
            p.add(
                "tokenizer",
                message,
                "tokens of another codebook mean other motions; name the same tokenizer in both places",
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
                p.add("generator", message, "write `generator: masked`, or `quantizers: 1` at the tokenizer");
            }
            (TokenGenerator::Masked, Some(2)) => {
                let message =
                    format!("`generator` is `masked`, but `{tokenizer}` has 2 codebooks; expected 1, or at least 3");
                p.add("generator", message, "the network of the layers above the first shares tables between them");
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
