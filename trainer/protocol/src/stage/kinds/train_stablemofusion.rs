//! `train.stablemofusion`: diffusion of motion itself with a U-Net over frames. Source: StableMoFusion (Huang et al., arXiv:2405.05691).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::network::transformer_parameters;
use crate::stage::{
    Batch, Decay, Diffusion, Family, FrequencyLosses, Neighbours, NoiseSchedule, Optimizer, Output, Prediction,
    Problems, Ref, Replicas, Shape, Solver, StageSpec, Training,
};
use crate::{ArtifactKind, Steps};

/// Heads of the cross-attention, and groups of the group norms.
const PARTS: usize = 8;
/// Frames are padded to a multiple of 16, so that they can be halved this often.
const LEVELS: usize = 4;

/// Size of a StableMoFusion network. The default is the published size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct StableMoFusionNetwork {
    /// Number of channels that the multipliers scale.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub width: usize,
    /// Channels of each level of the U-Net as a multiple of `width`; at most 4 levels.
    #[schemars(inner(range(min = 1, max = 64)))]
    pub multipliers: Vec<usize>,
    /// Width of the timestep's embedding; even.
    #[schemars(range(min = 2, max = 16_384), extend("x-unit" = "channels"))]
    pub time: usize,
    /// Width of a token.
    #[schemars(range(min = 1, max = 4_096), extend("x-unit" = "channels"))]
    pub text: usize,
    /// Number of blocks of the text transformer.
    #[schemars(range(min = 1, max = 255), extend("x-unit" = "layers"))]
    pub text_layers: usize,
    /// Number of heads of the text transformer; divides `text`.
    #[schemars(range(min = 1, max = 1_024), extend("x-unit" = "heads"))]
    pub text_heads: usize,
    /// Feed-forward width of the text transformer.
    #[schemars(range(min = 1, max = 65_536), extend("x-unit" = "channels"))]
    pub text_feed_forward: usize,
    /// Uses softmax cross-attention instead of the linear one.
    pub full_attention: bool,
    /// Probability of dropout.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub dropout: f64,
}

impl Default for StableMoFusionNetwork {
    fn default() -> Self {
        Self {
            width: 512,
            multipliers: vec![2; 4],
            time: 512,
            text: 256,
            text_layers: 4,
            text_heads: 4,
            text_feed_forward: 2048,
            full_attention: false,
            dropout: 0.1,
        }
    }
}

impl StableMoFusionNetwork {
    fn check(&self, p: &mut Problems) {
        if !(1..=LEVELS).contains(&self.multipliers.len()) || self.multipliers.contains(&0) {
            let message =
                format!("`network.multipliers` is {:?}; expected 1 to {LEVELS} numbers above 0", self.multipliers);
            p.add("network.multipliers", message, "published: [2, 2, 2, 2]");
        }
        for channels in self.multipliers.iter().map(|m| self.width.saturating_mul(*m)) {
            if !channels.is_multiple_of(PARTS) {
                let message = format!(
                    "a level has {channels} channels; expected a multiple of {PARTS}, the number of heads and groups"
                );
                p.add("network.width", message, "");
                break;
            }
        }
        p.equal_heads("network.text_heads", self.text_heads, "network.text", self.text);
        if !self.time.is_multiple_of(2) {
            let message = format!("`network.time` is {}; expected an even number", self.time);
            p.add("network.time", message, "the timestep becomes pairs of a sine and a cosine");
        }
        // Two convolutions of five taps per block, five blocks per level.
        let widest = self.multipliers.iter().max().map_or(0, |m| self.width.saturating_mul(*m));
        let block = widest.saturating_mul(widest.saturating_mul(10));
        p.parameters(block.saturating_mul(5 * self.multipliers.len().min(LEVELS)));
        p.parameters(transformer_parameters(self.text, self.text_feed_forward, self.text_layers));
    }
}

/// `train.stablemofusion`: diffusion of motion itself with a U-Net over frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainStableMoFusion {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that embeds the captions; its encoder supplies the tokens.
    pub text: String,
    /// Stage or version, such as `motionlcm@prod`, whose denoiser supplies initial weights where shapes fit; empty
    /// starts from random ones.
    pub init: String,
    /// Size of the network.
    pub network: StableMoFusionNetwork,
    /// Noise schedule and prediction.
    pub diffusion: Diffusion,
    /// Number of timesteps of the schedule.
    #[schemars(range(min = 2, max = 1_000), extend("x-unit" = "timesteps"))]
    pub timesteps: usize,
    /// Divisor of the deviations of root and contact features, which increases their weight.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub feature_bias: f64,
    /// Frames of the longest motion.
    #[schemars(range(min = 4, max = 10_000), extend("x-unit" = "frames"))]
    pub max_frames: usize,
    /// Probability that a caption is dropped.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the captions"))]
    pub guidance_dropout: f64,
    /// Decay of the moving average of the weights, which is the result; 0 uses the weights themselves. As published,
    /// the weight of an update is `1 - ema` times `106667 ema_every / steps`, at most 1.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Updates of the weights per update of the average; the first of these copies.
    #[schemars(range(min = 1, max = 1_000_000), extend("x-unit" = "updates"))]
    pub ema_every: u64,
    /// Losses of Free-T2M.
    pub losses: FrequencyLosses,
    /// Batch, schedule and optimizer.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainStableMoFusion {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            text: "text".into(),
            init: String::new(),
            network: StableMoFusionNetwork::default(),
            diffusion: Diffusion {
                schedule: NoiseSchedule::Linear,
                beta_first: 1e-4,
                beta_last: 0.02,
                prediction: Prediction::Sample,
            },
            timesteps: 1000,
            feature_bias: 5.0,
            max_frames: 196,
            guidance_dropout: 0.1,
            ema: 0.9999,
            ema_every: 32,
            losses: FrequencyLosses::default(),
            training: Training {
                steps: Steps(50_000),
                batch: Batch { global: 64, slices: 8 },
                lr: 2e-4,
                warmup: Steps(0),
                decay: Decay::Staircase,
                optimizer: Optimizer { weight_decay: 0.01, ..Optimizer::default() },
                max_grad_norm: 1.0,
                sync: Replicas::default(),
                stop: None,
            },
        }
    }
}

impl TrainStableMoFusion {
    /// Decay of the average in one of its updates. Published: .99317 for 50,000 steps.
    pub fn ema_decay(&self) -> f64 {
        const UNIT: f64 = 106_667.0;
        let taken = (1.0 - self.ema) * UNIT * self.ema_every as f64 / self.training.steps.0.max(1) as f64;
        1.0 - taken.min(1.0)
    }
}

impl StageSpec for TrainStableMoFusion {
    const KIND: &'static str = "train.stablemofusion";
    const VERSION: u32 = 5;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings),
            Ref::init(&mut self.init, ArtifactKind::Model, ArtifactKind::Denoiser),
            self.losses.reference(),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.network.check(p);
        self.diffusion.check_for_features(p);
        self.losses.check(p);
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.same_captions(p, &self.text, &self.dataset);
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        if self.losses.any() { &["loss", "denoising", "low_frequency", "semantic"] } else { &["loss"] }
    }

    fn family(&self) -> Option<Family> {
        Some(Family::Features { timesteps: self.timesteps, solver: Solver::SdeDpmSolverPp })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_average_takes_in_what_is_published() {
        let of = |steps| {
            let mut settings = TrainStableMoFusion::default();
            settings.training.steps = Steps(steps);
            settings.ema_decay()
        };
        assert!((of(50_000) - 0.993_173_312).abs() < 1e-9);
        assert!((of(200_000) - 0.998_29).abs() < 1e-5);
        assert_eq!(of(100), 0.0, "short runs keep the newest weights");
    }
}
