//! Noising of a sample, and the network's prediction.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Problems;

/// Growth of the noise over the timesteps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoiseSchedule {
    /// The square roots of the betas are equidistant. MLD, MotionLCM, MotionPCM.
    #[default]
    ScaledLinear,
    /// The betas are equidistant. DDPM; StableMoFusion with .0001 to .02.
    Linear,
    /// The signal's share of the variance is a squared cosine, without betas. Improved DDPM, MDM.
    Cosine,
    /// A straight line from sample to noise (rectified flow). DisCoRD.
    Flow,
}

/// Quantity that a network predicts from a noised sample.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Prediction {
    /// The noise, called epsilon. MLD, MotionLCM.
    #[default]
    Noise,
    /// The clean sample, called x0. MDM, StableMoFusion.
    Sample,
    /// For a diffusion `alpha noise - sigma sample` (Salimans and Ho), for a flow `noise - sample`.
    Velocity,
}

/// Noise schedule and prediction. The defaults are MLD's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Diffusion {
    /// Growth of the noise over the timesteps.
    pub schedule: NoiseSchedule,
    /// Share of the variance that becomes noise at the first timestep; for `scaled_linear` and `linear`.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the variance"))]
    pub beta_first: f64,
    /// Share of the variance that becomes noise at the last timestep.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the variance"))]
    pub beta_last: f64,
    /// Quantity that the network predicts.
    pub prediction: Prediction,
}

impl Default for Diffusion {
    fn default() -> Self {
        Self {
            schedule: NoiseSchedule::ScaledLinear,
            beta_first: 0.000_85,
            beta_last: 0.012,
            prediction: Prediction::Noise,
        }
    }
}

impl Diffusion {
    pub(super) fn check(&self, p: &mut Problems) {
        let first = self.beta_first;
        let last = self.beta_last;
        if !(first > 0.0 && first <= last && last < 1.0) {
            let message = format!("the betas of `diffusion` are {first} to {last}; expected 0 < first <= last < 1");
            p.add("diffusion.beta_first", message, "published: .00085 to .012 (MLD), .0001 to .02 (StableMoFusion)");
        }
        if self.schedule == NoiseSchedule::Flow && self.prediction == Prediction::Noise {
            let message = "a flow ends in pure noise, where a predicted noise does not determine the sample";
            p.add("diffusion.prediction", message, "write `prediction: velocity` or `prediction: sample`");
        }
        let uses_betas = matches!(self.schedule, NoiseSchedule::ScaledLinear | NoiseSchedule::Linear);
        let given = Self::default();
        if !uses_betas && (first, last) != (given.beta_first, given.beta_last) {
            let message = "`beta_first` and `beta_last` have no effect with the schedules `cosine` and `flow`";
            p.add("diffusion.beta_first", message, "remove `beta_first` and `beta_last`, or use a linear schedule");
        }
    }

    /// Checks also that samplers of features have the schedule.
    pub(super) fn check_for_features(&self, p: &mut Problems) {
        self.check(p);
        if self.schedule == NoiseSchedule::Flow {
            let message = "this stage has no sampler for the schedule `flow`";
            p.add("diffusion.schedule", message, "write `schedule: cosine` or `schedule: linear`");
        }
    }
}
