//! `train.vae`: the motion VAE. Source: MLD (v1, 1x256), MotionLCM v2 (16x32).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{
    Augment, Batch, LatentShape, LossChange, Network, Output, Problems, Ref, Shape, StageSpec, Training,
};

/// Weights of the VAE loss. Source: MotionLCM v2 (feature 1, joint 1, velocity 0, KL 1e-4).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct VaeLoss {
    /// Smooth L1 on normalised features.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub feature: f64,
    /// Smooth L1 on recovered joints, in metres.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub joint: f64,
    /// Smooth L1 on local positions ("velocity" upstream).
    #[schemars(range(min = 0.0, max = 1e6))]
    pub velocity: f64,
    /// Smooth L1 on the speed of ankles and feet, in m/s, which reduces sliding (our choice, similar to MDM's L_vel and
    /// L_foot).
    #[schemars(range(min = 0.0, max = 1e6))]
    pub feet: f64,
    /// As `feet`, only where an ankle or a foot stands in the clip, so that swinging feet do not outweigh sliding ones (our
    /// choice; MDM's L_foot has the target zero).
    #[schemars(range(min = 0.0, max = 1e6))]
    pub contact: f64,
    /// Smooth L1 on the velocity of all joints, in m/s (our choice).
    #[schemars(range(min = 0.0, max = 1e6))]
    pub joint_velocity: f64,
    /// Smooth L1 on the acceleration of all joints, in m/s^2, which reduces shaking (our choice).
    #[schemars(range(min = 0.0, max = 1e6))]
    pub joint_acceleration: f64,
    /// KL divergence from the standard normal, a mean over all elements.
    #[schemars(range(min = 0.0, max = 1e6))]
    pub kl: f64,
    /// Leaves out padded frames (v2); false is v1's plain mean.
    pub masked: bool,
    /// Share of the steps before the terms on joints start; early, the root drift dominates the posture.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the steps"))]
    pub joint_from: f64,
}

impl Default for VaeLoss {
    fn default() -> Self {
        Self {
            feature: 1.0,
            joint: 1.0,
            velocity: 0.0,
            feet: 0.0,
            contact: 0.0,
            joint_velocity: 0.0,
            joint_acceleration: 0.0,
            kl: 1e-4,
            masked: true,
            joint_from: 0.0,
        }
    }
}

/// Short crops for the first part of the training: most steps per second, best result per hour on small budgets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Windows {
    /// Shortest crop in frames.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "frames"))]
    pub min: usize,
    /// Longest crop in frames.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "frames"))]
    pub max: usize,
    /// Share of the steps that train on windows; 0 turns them off.
    #[schemars(range(min = 0.0, max = 1.0), extend("x-unit" = "of the steps"))]
    pub until: f64,
    /// Examples per update in this part; 0 uses `batch.global`.
    #[schemars(range(min = 0, max = 65_536), extend("x-unit" = "examples"))]
    pub batch: usize,
}

impl Default for Windows {
    fn default() -> Self {
        Self { min: 40, max: 64, until: 0.0, batch: 0 }
    }
}

/// `train.vae`: trains the motion VAE. Source: MLD (v1, 1x256), MotionLCM v2 (16x32).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TrainVae {
    /// Stage that gives the clips.
    pub dataset: String,
    /// Shape of the latent.
    pub latent: LatentShape,
    /// Size of encoder and decoder.
    pub network: Network,
    /// Weights of the loss terms.
    pub loss: VaeLoss,
    /// Short crops for the first part of the training.
    pub windows: Windows,
    /// Exponent by which clips with rare words are drawn more often, as `balance` of `encode.latents` says.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub balance: f64,
    /// Changes the paths of clips, differently each time. With little data the VAE otherwise memorises paths and fails
    /// on new ones.
    pub augment: Augment,
    /// Decay of the moving average of the weights, which is the result; 0 uses the weights themselves.
    #[schemars(range(min = 0.0), extend("exclusiveMaximum" = 1.0))]
    pub ema: f64,
    /// Stage or version, such as `motionlcm@prod`, whose VAE supplies initial weights where shapes fit; empty starts
    /// from random ones.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub init: String,
    /// Batch, schedule and optimizer.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainVae {
    fn default() -> Self {
        Self {
            dataset: "dataset".into(),
            latent: LatentShape::default(),
            network: Network::default(),
            loss: VaeLoss::default(),
            windows: Windows::default(),
            balance: 0.0,
            augment: Augment::default(),
            ema: 0.0,
            init: String::new(),
            training: Training::published(1_150_000, 128, 2e-4),
        }
    }
}

impl StageSpec for TrainVae {
    const KIND: &'static str = "train.vae";
    const VERSION: u32 = 4;
    const SHAPE: Shape = Shape::Gang;
    const OUTPUT: Output = Output { name: "vae", kind: ArtifactKind::Vae };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::init(&mut self.init, ArtifactKind::Vae, ArtifactKind::Vae),
        ]
    }

    fn check(&self, p: &mut Problems) {
        self.latent.check(p);
        self.network.check(p);
        self.loss.check(p);
        self.windows.check(p, self.training.batch.slices);
        self.training.check(p);
    }

    fn training(&mut self) -> Option<&mut Training> {
        Some(&mut self.training)
    }

    fn recorded(&self) -> &'static [&'static str] {
        let VaeLoss { contact, joint_velocity, joint_acceleration, .. } = self.loss;
        if [contact, joint_velocity, joint_acceleration].iter().any(|weight| *weight != 0.0) {
            &["loss", "feature", "joint", "kl", "feet", "contact", "joint_velocity", "joint_acceleration"]
        } else if self.loss.feet != 0.0 {
            &["loss", "feature", "joint", "kl", "feet"]
        } else {
            &["loss", "feature", "joint", "kl"]
        }
    }

    fn loss_changes(&self) -> Vec<LossChange> {
        let steps = self.training.steps;
        let weighted = self.loss.compares_joints();
        let terms = "the loss includes the terms on joints";
        let terms = LossChange::behind(self.loss.joint_from, steps, terms, "loss.joint_from").filter(|_| weighted);
        let clips = "training changes from short crops to whole clips, which have a higher loss";
        terms.into_iter().chain(LossChange::behind(self.windows.until, steps, clips, "windows.until")).collect()
    }

    fn latent(&self) -> Option<LatentShape> {
        Some(self.latent)
    }
}

impl VaeLoss {
    /// Returns true if a term compares recovered joints or their derivatives.
    pub fn compares_joints(&self) -> bool {
        let Self { joint, feet, contact, joint_velocity, joint_acceleration, .. } = *self;
        [joint, feet, contact, joint_velocity, joint_acceleration].iter().any(|weight| *weight != 0.0)
    }

    /// The loss without these terms.
    pub fn without_joints(&self) -> Self {
        Self { joint: 0.0, feet: 0.0, contact: 0.0, joint_velocity: 0.0, joint_acceleration: 0.0, ..self.clone() }
    }

    fn check(&self, p: &mut Problems) {
        if self.feature == 0.0 && self.joint == 0.0 {
            p.add("loss.feature", "`loss.feature` and `loss.joint` are both 0, so nothing is reconstructed", "");
        }
    }
}

impl Windows {
    fn check(&self, p: &mut Problems, slices: usize) {
        if self.until > 0.0 {
            if self.min < 4 {
                p.add("windows.min", format!("`windows.min` is {}; expected at least 4 frames", self.min), "");
            }
            if self.min > self.max {
                let min = self.min;
                let max = self.max;
                p.add("windows.max", format!("`windows.max` is {max}, which is less than `windows.min` ({min})"), "");
            }
            if self.batch != 0 {
                Batch { global: self.batch, slices }.check_division(p, "windows.batch");
            }
        }
    }
}
