//! The size of networks and of latents.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Problems;

/// Size of a transformer. The published networks: width 256, 9 layers, 4 heads, feed-forward 1024, dropout 0.1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Network {
    /// Width H of the tokens.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub width: usize,
    /// Number of transformer blocks in the skip stack; odd.
    #[schemars(range(min = 1, max = 255), extend("x-unit" = "layers"))]
    pub layers: usize,
    /// Number of attention heads; divides `width`.
    #[schemars(range(min = 1, max = 1_024), extend("x-unit" = "heads"))]
    pub heads: usize,
    /// Width of the feed-forward layer.
    #[schemars(range(min = 1, max = 65_536), extend("x-unit" = "channels"))]
    pub feed_forward: usize,
    /// Probability of dropout.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
    /// Initial values of the learned position tables.
    pub positions: Positions,
}

impl Default for Network {
    fn default() -> Self {
        Self { width: 256, layers: 9, heads: 4, feed_forward: 1024, dropout: 0.1, positions: Positions::Uniform }
    }
}

impl Network {
    pub(super) fn check(&self, p: &mut Problems) {
        p.parameters(transformer_parameters(self.width, self.feed_forward, self.layers));
        if self.layers > 0 && self.layers.is_multiple_of(2) {
            let message = format!("`network.layers` is {}; expected an odd number", self.layers);
            p.add("network.layers", message, "the skip stack has as many blocks before its middle block as after it");
        }
        p.equal_heads("network.heads", self.heads, "network.width", self.width);
    }
}

/// Number of parameters of a transformer's weights: four projections of attention and two of the feed-forward block.
pub(super) fn transformer_parameters(width: usize, feed_forward: usize, layers: usize) -> usize {
    let wide = width.saturating_mul(4).saturating_add(feed_forward.saturating_mul(2));
    width.saturating_mul(wide).saturating_mul(layers)
}

/// Initial values of learned position tables. The tables are trained, imported and exported in either case.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Positions {
    /// Uniform on [0, 1), as published: frames are almost equal at first.
    #[default]
    Uniform,
    /// `[sin | cos]` of the position at frequencies `10000^(-2i/width)`. Measured on the mini HumanML3D set with a
    /// 5+5-layer VAE of width 128, one core: feature loss .136 after 1,500 updates, .188 with the published
    /// initialisation.
    Sinusoid,
}

/// Shape of a latent: `tokens` x `dim`. 1x256 is v1, 16x32 is v2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct LatentShape {
    /// Number N of latent tokens.
    #[schemars(range(min = 1, max = crate::limits::LATENT_TOKENS), extend("x-unit" = "tokens"))]
    pub tokens: usize,
    /// Width d of a latent token.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "numbers a token"))]
    pub dim: usize,
}

impl Default for LatentShape {
    fn default() -> Self {
        Self { tokens: 16, dim: 32 }
    }
}

impl LatentShape {
    pub(super) fn check(self, p: &mut Problems) {
        if self.tokens.saturating_mul(self.dim) > 1 << 20 {
            let message = format!("the latent is {}x{}; expected at most 1048576 numbers", self.tokens, self.dim);
            p.add("latent.tokens", message, "published: 1x256 and 16x32");
        }
    }
}
