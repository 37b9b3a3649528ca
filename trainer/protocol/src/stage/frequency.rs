//! Losses on a motion's frequencies and on its meaning, each at the noise levels where it helps. Source: Free-T2M (Chen
//! et al., 2025).
//!
//! The paper prints no K, no threshold and no step between its two stages. The stages here are those of its code for
//! MDM with 50 steps (30 to 49 and 0 to 20), as shares of the noise schedule. K is 8 by default, our choice; the code
//! keeps one coefficient. The paper's text puts slow parts early in denoising, as here; its code for StableMoFusion has
//! the two stages exchanged.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Problems, Ref};
use crate::ArtifactKind;

/// Distance of two numbers with difference d.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Norm {
    /// Absolute error `|d|`: Free-T2M's paper.
    #[default]
    L1,
    /// Squared error `d^2`: its code.
    L2,
}

/// Divisor of a term's sum over samples.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Over {
    /// The samples of the batch at noise levels of the term.
    #[default]
    Stage,
    /// All samples of the batch.
    Batch,
}

/// Coefficients of the cosine transform that a term compares.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Band {
    /// The lowest `keep`.
    #[default]
    Slow,
    /// All others: Free-T2M's table 6, in which training fails.
    Fast,
}

/// The term on the slow part of the predicted motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct LowFrequency {
    /// Weight of the term; 0 leaves it out.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub weight: f64,
    /// Number K of compared coefficients of the cosine transform. Coefficient k is at `k fps / 2n` Hz in n frames.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "coefficients"))]
    pub keep: usize,
    /// Side of K that is compared.
    pub band: Band,
    /// Distance of these parts.
    pub distance: Norm,
    /// Lowest noise at which the term acts, as a share of the timesteps.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the timesteps"))]
    pub from: f64,
    /// Highest noise at which the term acts, as a share of the timesteps.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the timesteps"))]
    pub to: f64,
    /// Transforms only a clip's own frames; the published code transforms padding too.
    pub masked: bool,
    /// Samples over which the mean is taken.
    pub over: Over,
}

impl Default for LowFrequency {
    fn default() -> Self {
        let distance = Norm::default();
        let over = Over::default();
        Self { weight: 0.0, keep: 8, band: Band::default(), distance, from: 0.6, to: 1.0, masked: true, over }
    }
}

/// The term on the meaning of the predicted motion: agreement of its embedding with that of the real motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Semantic {
    /// Weight of the term; 0 leaves it out.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub weight: f64,
    /// Stage that gives the evaluator for the embeddings. No evaluation may measure with the same one.
    pub evaluator: String,
    /// Lowest noise at which the term acts, as a share of the timesteps.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the timesteps"))]
    pub from: f64,
    /// Highest noise at which the term acts, as a share of the timesteps.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the timesteps"))]
    pub to: f64,
    /// Threshold of the embeddings' cosine, below which the term has a gradient; with 1 it always has, as in the
    /// published code.
    #[schemars(range(min = -1.0, max = 1.0))]
    pub threshold: f64,
    /// Samples over which the mean is taken.
    pub over: Over,
}

impl Default for Semantic {
    fn default() -> Self {
        Self { weight: 0.0, evaluator: "semantics".into(), from: 0.0, to: 0.4, threshold: 1.0, over: Over::default() }
    }
}

/// Losses in addition to the denoising loss; off by default.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct FrequencyLosses {
    /// Term on the slow part.
    pub low_frequency: LowFrequency,
    /// Term on the meaning.
    pub semantic: Semantic,
}

impl FrequencyLosses {
    /// The field of the semantic term's evaluator.
    pub const EVALUATOR: &'static str = "losses.semantic.evaluator";

    /// Returns true if any term has a weight.
    pub fn any(&self) -> bool {
        self.low_frequency.weight > 0.0 || self.semantic.weight > 0.0
    }

    pub(super) fn reference(&mut self) -> Ref<'_> {
        let read = self.semantic.weight > 0.0;
        Ref::stage(Self::EVALUATOR, &mut self.semantic.evaluator, ArtifactKind::Evaluator).only_if(read)
    }

    pub(super) fn check(&self, p: &mut Problems) {
        let low = &self.low_frequency;
        let semantic = &self.semantic;
        for (name, from, to) in [("low_frequency", low.from, low.to), ("semantic", semantic.from, semantic.to)] {
            if from > to {
                let message =
                    format!("`losses.{name}` has `from` {from} and `to` {to}; expected `from` to be the smaller one");
                p.add(&format!("losses.{name}.from"), message, "0 is no noise, 1 is all noise");
            }
        }
    }
}
