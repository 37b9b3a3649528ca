//! `train.control`: motion through target positions. Source: MotionLCM (Dai et al., ECCV 2024; v2 of late 2024).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::limits;
use crate::stage::control::check_skeleton;
use crate::stage::{ControlHints, Neighbours, Network, Output, Problems, Ref, Shape, StageSpec, Training};

/// Distance d of a joint from its target.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ControlDistance {
    /// Squared error `d^2`: temporal.
    #[default]
    L2,
    /// Absolute error `|d|`.
    L1,
    /// Smooth L1, `d^2 / 2` up to 1, `|d| - 1/2` beyond: spatial.
    SmoothL1,
}

/// Divisor of the sum over targets.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ControlMean {
    /// Targets of the whole batch (`sum` upstream): temporal.
    #[default]
    Batch,
    /// Targets of the sample, then the mean over samples (`sum_mask`).
    Sample,
    /// Coordinates of the sample, three per target, then the mean over samples (`mask`): spatial.
    Coordinate,
}

/// Terms of the loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ControlLoss {
    /// Weight of the latent term: on a student's clean latent, or on a teacher's predicted noise.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub latent: f64,
    /// Weight of a term of ours on the trajectory encoder's tokens, which have the shape of latents: their distance
    /// from the clean latent. It trains the encoder directly, without the ControlNet, whose layers are initialised to
    /// zero.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub tokens: f64,
    /// Weight of the motion term, which compares joints through the frozen decoder; 0 leaves the decoder out.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub control: f64,
    /// Distance of the motion term.
    pub distance: ControlDistance,
    /// Divisor of the motion term.
    pub mean: ControlMean,
    /// Compares metres (spatial) instead of normalised coordinates (temporal).
    pub metres: bool,
}

impl Default for ControlLoss {
    fn default() -> Self {
        let distance = ControlDistance::default();
        let mean = ControlMean::default();
        Self { latent: 1.0, tokens: 0.0, control: 1.0, distance, mean, metres: false }
    }
}

/// Rounds that correct a generated latent, ours: the latent is decoded, and a network changes it by its motion's
/// distance from the targets. The denoiser does not run again.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ControlFeedback {
    /// Number of rounds. Each decodes the latent, and a network changes it by the motion's distance from the targets.
    /// 0, as published, has no such network.
    #[schemars(range(min = 0, max = limits::FEEDBACK_ROUNDS), extend("x-unit" = "rounds"))]
    pub rounds: usize,
    /// Learning rate of the network of `feedback`; 0 uses `lr`.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub lr: f64,
}

/// `train.control`: trains a trajectory encoder and a ControlNet beside the frozen denoiser of a latent model. Defaults
/// are those of MotionLCM v2's temporal setting.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainControl {
    /// Stage that gives the model to be controlled, of `train.mld`, `distill.lcm` or `distill.pcm`. None of its parts
    /// changes.
    pub model: String,
    /// Stage that gives the clips of `latents`.
    pub dataset: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Target positions in training.
    pub hints: ControlHints,
    /// Terms of the loss.
    pub loss: ControlLoss,
    /// Range of a student's guidance scale w, which is drawn from it; v1 fixes it at 6.5. A teacher has none.
    #[schemars(extend("minimum" = 0.0, "maximum" = 1e3))]
    pub guidance: (f64, f64),
    /// A student trains at timesteps `k - 1`, `2k - 1` and so on to 999 (v2: k = 100); 1 uses all timesteps (v1). A
    /// teacher uses all.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "timesteps"))]
    pub skip: usize,
    /// Rounds of feedback on generated latents.
    pub feedback: ControlFeedback,
    /// Size of the trajectory encoder, and of the network of `feedback`. The ControlNet has the denoiser's size.
    pub network: Network,
    /// Width of the layers between trajectory tokens and ControlNet.
    #[schemars(range(min = 1, max = 16_384), extend("x-unit" = "channels"))]
    pub embedding: usize,
    /// Learning rate of the trajectory encoder; 0 uses `lr`.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub trajectory_lr: f64,
    /// Stage or version, such as `motionlcm@prod`, whose control part supplies initial weights where shapes fit; empty
    /// starts from the denoiser's weights.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer. Gradients of ControlNet and trajectory encoder are clipped together, those of the
    /// network of `feedback` separately.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainControl {
    fn default() -> Self {
        Self {
            model: "lcm".into(),
            dataset: "dataset".into(),
            latents: "latents".into(),
            text: "text".into(),
            hints: ControlHints::default(),
            loss: ControlLoss::default(),
            guidance: (5.0, 15.0),
            skip: 100,
            feedback: ControlFeedback::default(),
            network: Network::default(),
            embedding: 256,
            trajectory_lr: 0.0,
            init: String::new(),
            training: Training::published(192_000, 128, 1e-4),
        }
    }
}

impl StageSpec for TrainControl {
    const KIND: &'static str = "train.control";
    // Version 2 has batches of similar length.
    const VERSION: u32 = 5;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "model", kind: ArtifactKind::Model };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("model", &mut self.model, ArtifactKind::Model),
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("latents", &mut self.latents, ArtifactKind::Latents),
            Ref::stage("text", &mut self.text, ArtifactKind::Embeddings),
            Ref::init(&mut self.init, ArtifactKind::Model, ArtifactKind::Control),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.hints.check(p);
        if self.loss.latent == 0.0 && self.loss.control == 0.0 {
            p.add("loss.latent", "`loss.latent` and `loss.control` are both 0, so nothing is learned", "");
        }
        p.ascending("guidance", self.guidance);
        p.divides_timesteps("skip", self.skip, "published: 100 (v2) and 1 (v1)");
        self.network.check(p);
        self.training.check(p);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let model = &self.model;
        if stages.family(model).is_some_and(|family| !family.draws_latents()) {
            let message = format!("`{model}` is not a latent diffusion model; a ControlNet needs one");
            p.add("model", message, "use a `train.mld`, `distill.lcm` or `distill.pcm` stage");
        }
        if stages.stage(model).is_some_and(|stage| stage.kind() == Self::KIND) {
            let message = format!("`{model}` already has a control part");
            p.add("model", message, "use the stage of the model that the control part controls");
        }
        stages.same_vae(p, ("model", stages.vae_of_model(model)), &self.latents);
        stages.same_data(p, &self.latents, &self.text);
        stages.same_clips(p, &self.dataset, &self.latents);
        check_skeleton(p, "hints.joints", &self.hints.joints, stages.format(&self.dataset));
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        match self.feedback.rounds {
            0 => &["loss", "latent", "tokens", "control"],
            _ => &["loss", "latent", "tokens", "control", "feedback_latent", "feedback_control"],
        }
    }
}
