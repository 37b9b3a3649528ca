//! Losses that look at a motion's frequencies and at its meaning, each at the noise levels where it helps. Source: Free-T2M (Chen et al., 2025).
//!
//! The paper prints no K, no threshold and no step at which its two stages part. Stages are here as its code has them for MDM of 50 steps
//! (30 to 49 and 0 to 20), in shares of the noise schedule. K is 8 by default, a choice of ours; the code keeps one coefficient. The
//! paper's text wants slow parts early in denoising, which is what this does; its code for StableMoFusion has the two stages the other way round.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Problems, Ref};
use crate::ArtifactKind;

/// How far apart two numbers are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Norm {
    /// `|d|`: Free-T2M's paper.
    #[default]
    L1,
    /// `d^2`: its code.
    L2,
}

/// What a term's sum over samples is divided by.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Over {
    /// The samples of the batch at whose noise levels the term acts.
    #[default]
    Stage,
    /// All samples of the batch.
    Batch,
}

/// The slow part of the predicted motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct LowFrequency {
    /// Weight; 0 leaves the term out.
    pub weight: f64,
    /// K: coefficients of the cosine transform that are compared. Number k stands for `k fps / 2n` Hz in n frames.
    pub keep: usize,
    /// Distance of the slow parts.
    pub distance: Norm,
    /// Least noise at which the term acts, as a share of the timesteps.
    pub from: f64,
    /// Most noise at which the term acts.
    pub to: f64,
    /// Transforms a clip's own frames; the published code transforms padding too.
    pub masked: bool,
    /// What the mean is over.
    pub over: Over,
}

impl Default for LowFrequency {
    fn default() -> Self {
        let (distance, over) = (Norm::default(), Over::default());
        Self { weight: 0.0, keep: 8, distance, from: 0.6, to: 1.0, masked: true, over }
    }
}

/// The meaning of the predicted motion: how well its embedding agrees with that of the real one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Semantic {
    /// Weight; 0 leaves the term out.
    pub weight: f64,
    /// Stage that gives the evaluator which embeds. No evaluation may measure with the same one.
    pub evaluator: String,
    /// Least noise at which the term acts, as a share of the timesteps.
    pub from: f64,
    /// Most noise at which the term acts.
    pub to: f64,
    /// Pulls only while the cosine of the two embeddings is below this; at 1 it pulls everywhere, as the published code does.
    pub threshold: f64,
    /// What the mean is over.
    pub over: Over,
}

impl Default for Semantic {
    fn default() -> Self {
        Self { weight: 0.0, evaluator: "semantics".into(), from: 0.0, to: 0.4, threshold: 1.0, over: Over::default() }
    }
}

/// Losses besides that of denoising; none by default.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct FrequencyLosses {
    /// On the slow part.
    pub low_frequency: LowFrequency,
    /// On the meaning.
    pub semantic: Semantic,
}

impl FrequencyLosses {
    /// The field of the semantic term's evaluator.
    pub const EVALUATOR: &'static str = "losses.semantic.evaluator";

    /// Whether there is any term.
    pub fn any(&self) -> bool {
        self.low_frequency.weight > 0.0 || self.semantic.weight > 0.0
    }

    pub(super) fn reference(&mut self) -> Ref<'_> {
        let read = self.semantic.weight > 0.0;
        Ref::stage(Self::EVALUATOR, &mut self.semantic.evaluator, ArtifactKind::Evaluator).only_if(read)
    }

    pub(super) fn check(&self, p: &mut Problems) {
        let (low, semantic) = (&self.low_frequency, &self.semantic);
        p.not_negative("losses.low_frequency.weight", low.weight);
        p.not_negative("losses.semantic.weight", semantic.weight);
        p.positive("losses.low_frequency.keep", low.keep);
        for (name, from, to) in [("low_frequency", low.from, low.to), ("semantic", semantic.from, semantic.to)] {
            p.fraction(&format!("losses.{name}.from"), from, false);
            p.fraction(&format!("losses.{name}.to"), to, false);
            if from > to {
                let message =
                    format!("`losses.{name}` acts from {from} to {to}; expected `from` to be the smaller one");
                p.add(&format!("losses.{name}.from"), message, "0 is no noise, 1 is all noise");
            }
        }
        if !(-1.0..=1.0).contains(&semantic.threshold) {
            let message = format!("`losses.semantic.threshold` is {}; expected a cosine, -1 to 1", semantic.threshold);
            p.add("losses.semantic.threshold", message, "");
        }
    }
}
