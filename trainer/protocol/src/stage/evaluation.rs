//! What evaluations share: which clips, how motions are drawn, which direction of a metric is better.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Problems;

/// Which clips an evaluation looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// `train.txt`.
    Train,
    /// `val.txt`.
    Val,
    /// `test.txt`.
    Test,
    /// All three.
    All,
}

/// Whether a smaller or a larger value is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}

/// How motions are drawn from a denoiser.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Sampler {
    /// Network evaluations. A PCM student has as many as phases.
    pub steps: usize,
    /// Teacher: g in `uncond + g (cond - uncond)`. Student: the embedded w, which is g - 1.
    pub guidance: f64,
    /// LCM only: timesteps, first to last; empty takes evenly spaced points of the training grid from 999 down.
    pub timesteps: Vec<usize>,
}

impl Default for Sampler {
    fn default() -> Self {
        Self { steps: 1, guidance: 7.5, timesteps: Vec::new() }
    }
}

impl Sampler {
    pub(super) fn check(&self, p: &mut Problems) {
        if !(1..=1000).contains(&self.steps) {
            p.add("sampler.steps", format!("`sampler.steps` is {}; expected 1 to 1000", self.steps), "");
        }
        p.not_negative("sampler.guidance", self.guidance);
        if let Some(t) = self.timesteps.iter().find(|t| **t > 999) {
            p.add("sampler.timesteps", format!("timestep {t} is out of range; expected 0 to 999"), "");
        }
        if self.timesteps.windows(2).any(|pair| pair[0] < pair[1]) {
            p.add("sampler.timesteps", "`sampler.timesteps` rise; expected the noisiest first", "");
        }
        if !self.timesteps.is_empty() && self.timesteps.len() != self.steps {
            let entries = self.timesteps.len();
            let message = format!("`sampler.timesteps` has {entries} entries, but `sampler.steps` is {}", self.steps);
            p.add("sampler.timesteps", message, "");
        }
    }

    /// For models that choose their timesteps themselves.
    pub(super) fn refuse_timesteps(&self, model: &str, p: &mut Problems) {
        if !self.timesteps.is_empty() {
            let message = format!("`sampler.timesteps` are for LCM students, and `{model}` is none");
            p.add("sampler.timesteps", message, "leave them out");
        }
    }
}
