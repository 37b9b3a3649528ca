//! `train.tokenizer`: converts motion to tokens of one codebook (T2M-GPT, MMM) or a stack of them (MoMask).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Batch, Decay, Optimizer, Output, Problems, Ref, Replicas, Shape, StageSpec, Training};
use crate::{ArtifactKind, Steps, limits};

/// Weights per residual block and its connections, divided by the square of the width: an upper bound, not a count.
const SQUARES_A_BLOCK: usize = 16;

/// Size of a tokenizer's encoder and decoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TokenizerNetwork {
    /// Width of the convolutions.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub width: usize,
    /// Number of residual blocks in each of the two levels.
    #[schemars(range(min = 1, max = 16), extend("x-unit" = "blocks"))]
    pub depth: usize,
    /// Factor between the dilations of neighbouring blocks.
    #[schemars(range(min = 1, max = 16))]
    pub growth: usize,
    /// Probability of dropout in the blocks: 0.2 in MoMask, none in T2M-GPT and MMM.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
}

impl Default for TokenizerNetwork {
    fn default() -> Self {
        Self { width: 512, depth: 3, growth: 3, dropout: 0.2 }
    }
}

/// Weights of a tokenizer's loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TokenizerLoss {
    /// Smooth L1 on normalised features.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub feature: f64,
    /// Smooth L1 on local positions ("velocity" upstream).
    #[schemars(range(min = 0.0, max = 1e6))]
    pub position: f64,
    /// Squared distance of the encoder's rows to their codes.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub commitment: f64,
}

impl Default for TokenizerLoss {
    fn default() -> Self {
        Self { feature: 1.0, position: 0.5, commitment: 0.02 }
    }
}

/// Codes that are replaced by rows of the batch.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Resets {
    /// In every update the codes with a running count below 1 (T2M-GPT, MoMask).
    #[default]
    Always,
    /// In every 21st update the codes that never had a count of 1 (MMM): none in a run from scratch.
    Remembering,
}

/// Windows that make an epoch.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum WindowsOf {
    /// Every window of every clip once (MoMask): long clips have more weight.
    #[default]
    Frames,
    /// One drawn window of every clip (T2M-GPT, MMM).
    Clips,
}

/// `train.tokenizer`: a VQ-VAE or a residual VQ-VAE. The default is MoMask's; `quantizers: 1` without dropout and draws
/// is T2M-GPT's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainTokenizer {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Number of codes of a codebook.
    #[schemars(range(min = 2, max = 65_536), extend("x-unit" = "codes"))]
    pub codes: usize,
    /// Width of a code.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "numbers a code"))]
    pub code_dim: usize,
    /// Number of codebooks; each quantises the residuals of those before it.
    #[schemars(range(min = 1, max = 64), extend("x-unit" = "codebooks"))]
    pub quantizers: usize,
    /// Probability that a step leaves out the codebooks above a drawn one.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the steps"))]
    pub quantize_dropout: f64,
    /// Draws codes by their distances in training, instead of using the nearest.
    pub drawn: bool,
    /// Codes that are replaced by rows of the batch.
    pub resets: Resets,
    /// Decay of the codebooks' running statistics in each update ("mu" upstream).
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub codebook_decay: f64,
    /// Divisor of the deviations of root and contact features, which increases their weight. 25 in MoMask, T2M-GPT and
    /// MMM, whose code divides the stored deviations by 5 twice.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub feature_bias: f64,
    /// Size of encoder and decoder.
    pub network: TokenizerNetwork,
    /// Weights of the loss terms.
    pub loss: TokenizerLoss,
    /// Frames of an example; a multiple of 4. Shorter clips are left out.
    #[schemars(range(min = 4, max = 10_000), extend("x-unit" = "frames"))]
    pub window: usize,
    /// Windows that make an epoch.
    pub windows_of: WindowsOf,
    /// Stage or version, such as `momask@prod`, whose tokenizer supplies initial weights where shapes fit; empty starts
    /// from random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer. Published: MoMask 50 epochs with batches of 256 (about 360,000 steps), T2M-GPT
    /// and MMM 300,000 steps. Both lower the rate in two steps near the end; here it follows a cosine.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainTokenizer {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            codes: 512,
            code_dim: 512,
            quantizers: 6,
            quantize_dropout: 0.2,
            drawn: true,
            resets: Resets::Always,
            codebook_decay: 0.99,
            feature_bias: 1.0,
            network: TokenizerNetwork::default(),
            loss: TokenizerLoss::default(),
            window: 64,
            windows_of: WindowsOf::Frames,
            init: String::new(),
            training: Training {
                steps: Steps(360_000),
                batch: Batch { global: 256, slices: 8 },
                lr: 2e-4,
                warmup: Steps(2_000),
                decay: Decay::Cosine,
                optimizer: Optimizer { beta2: 0.99, ..Optimizer::default() },
                max_grad_norm: 0.0,
                sync: Replicas::default(),
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainTokenizer {
    const KIND: &'static str = "train.tokenizer";
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "tokenizer", kind: ArtifactKind::Tokenizer };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::init(&mut self.init, ArtifactKind::Tokenizer, ArtifactKind::Tokenizer),
        ]
    }

    fn check(&self, p: &mut Problems) {
        p.product(
            "codes",
            &[("codes", self.codes), ("code_dim", self.code_dim), ("quantizers", self.quantizers)],
            limits::PARAMETERS / 16,
        );
        let TokenizerNetwork { width, depth, growth, .. } = self.network;
        let squares = SQUARES_A_BLOCK.saturating_mul(depth.saturating_add(2));
        p.parameters(width.saturating_mul(width).saturating_mul(squares));
        let reach = u32::try_from(depth).ok().and_then(|depth| growth.checked_pow(depth));
        if reach.is_none_or(|reach| reach > 10_000) {
            let message =
                format!("the largest dilation is `network.growth` to the power of `network.depth`, {growth}^{depth}");
            p.add("network.growth", message, "expected at most 10000 frames");
        }
        p.whole_tokens("window", self.window);
        if self.loss.feature == 0.0 && self.loss.position == 0.0 {
            p.add("loss.feature", "`loss.feature` and `loss.position` are both 0, so nothing is reconstructed", "");
        }
        if self.training.replicas().is_some() {
            let message = "a codebook follows the codes of every batch, so replicas of it cannot be averaged";
            p.add("sync", message, "remove `sync`");
        }
        self.training.check(p);
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        &["loss", "feature", "position", "commitment", "perplexity"]
    }
}
