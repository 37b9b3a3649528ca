//! `train.mdm`: diffusion of motion itself with a transformer. Source: MDM (Tevet et al., arXiv:2209.14916).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::network::transformer_parameters;
use crate::stage::{
    Batch, Decay, Diffusion, Family, FrequencyLosses, Neighbours, NoiseSchedule, Optimizer, Output, Prediction,
    Problems, Ref, Replicas, Shape, Solver, StageSpec, Training,
};
use crate::{ArtifactKind, Steps};

/// Size of an MDM. The default is the published size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MdmNetwork {
    /// Width of the tokens; even.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub width: usize,
    /// Number of transformer blocks.
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
}

impl Default for MdmNetwork {
    fn default() -> Self {
        Self { width: 512, layers: 8, heads: 4, feed_forward: 1024, dropout: 0.1 }
    }
}

impl MdmNetwork {
    fn check(&self, p: &mut Problems) {
        p.equal_heads("network.heads", self.heads, "network.width", self.width);
        if !self.width.is_multiple_of(2) {
            let message = format!("`network.width` is {}; expected an even number", self.width);
            p.add("network.width", message, "positions are pairs of a sine and a cosine");
        }
        p.parameters(transformer_parameters(self.width, self.feed_forward, self.layers));
    }
}

/// `train.mdm`: diffusion of motion itself with a transformer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainMdm {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Stage or version, such as `motionlcm@prod`, whose denoiser supplies initial weights where shapes fit; empty
    /// starts from random ones.
    pub init: String,
    /// Size of the network.
    pub network: MdmNetwork,
    /// Noise schedule and prediction.
    pub diffusion: Diffusion,
    /// Number of timesteps of the schedule: 1000 in the paper, 50 in its authors' later model.
    #[schemars(range(min = 2, max = 1_000), extend("x-unit" = "timesteps"))]
    pub timesteps: usize,
    /// Masks frames of padding in attention, which the authors call a fix; the paper's model attends to them.
    pub mask_frames: bool,
    /// Frames of the longest motion.
    #[schemars(range(min = 4, max = 10_000), extend("x-unit" = "frames"))]
    pub max_frames: usize,
    /// Probability that a caption is dropped.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the captions"))]
    pub guidance_dropout: f64,
    /// Decay of the moving average of the weights, which is the result; 0 uses the weights themselves. The authors'
    /// model of 50 steps has 0.9999.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Losses of Free-T2M.
    pub losses: FrequencyLosses,
    /// Batch, schedule and optimizer.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainMdm {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            text: "text".into(),
            init: String::new(),
            network: MdmNetwork::default(),
            diffusion: Diffusion {
                schedule: NoiseSchedule::Cosine,
                prediction: Prediction::Sample,
                ..Diffusion::default()
            },
            timesteps: 1000,
            mask_frames: false,
            max_frames: 196,
            guidance_dropout: 0.1,
            ema: 0.0,
            losses: FrequencyLosses::default(),
            training: Training {
                steps: Steps(600_000),
                batch: Batch { global: 64, slices: 8 },
                lr: 1e-4,
                warmup: Steps(0),
                decay: Decay::Constant,
                optimizer: Optimizer::default(),
                max_grad_norm: 0.0,
                sync: Replicas::default(),
                stop: None,
            },
        }
    }
}

impl StageSpec for TrainMdm {
    const KIND: &'static str = "train.mdm";
    const VERSION: u32 = 4;
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
        Some(Family::Features { timesteps: self.timesteps, solver: Solver::Ddpm })
    }
}
