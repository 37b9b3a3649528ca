//! Settings of the teacher and of its students.

use serde::{Deserialize, Serialize};

use super::{Network, Optimizer, Training};

/// `train.mld`: the latent-diffusion teacher. Source: MLD, MotionLCM v1/v2.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TrainMld {
    /// Stage that gives the VAE; its latent shape must be that of `latents`.
    pub vae: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Size.
    pub network: Network,
    /// A ReLU on the text embedding (v1); v2 removed it.
    pub text_relu: bool,
    /// Probability that a caption is replaced by the empty one.
    pub guidance_dropout: f64,
    /// EMA of the weights that is kept as the result; 0 keeps the weights themselves.
    pub ema: f64,
    /// The rest.
    #[serde(flatten)]
    pub training: Training,
}

impl Default for TrainMld {
    fn default() -> Self {
        Self {
            vae: "vae".into(),
            latents: "latents".into(),
            text: "text".into(),
            network: Network::default(),
            text_relu: false,
            guidance_dropout: 0.1,
            ema: 0.0,
            training: Training::published(1_150_000, 64, 1e-4),
        }
    }
}

/// Which distance consistency losses use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Distance {
    /// `sqrt(d^2 + c^2) - c`.
    Huber,
    /// Mean squared error.
    L2,
}

/// What both distillations share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default = "Distillation::motion_lcm")]
pub struct Distillation {
    /// Stage that gives the teacher.
    pub teacher: String,
    /// Stage that gives the latents.
    pub latents: String,
    /// Stage that gives the caption embeddings.
    pub text: String,
    /// Guidance scale w is drawn from this range, in the form `cond + w (cond - uncond)`.
    pub guidance: (f64, f64),
    /// Width of the guidance embedding.
    pub guidance_dim: usize,
    /// Solver step k; the grid has 1000/k points.
    pub skip: usize,
    /// Distance.
    pub distance: Distance,
    /// Pseudo-Huber constant c.
    pub huber_c: f64,
    /// Decay of the target network.
    pub ema: f64,
    /// Dropout in the frozen networks, as the original script has it by accident.
    pub upstream_dropout: bool,
    /// The rest.
    #[serde(flatten)]
    pub training: Training,
}

impl Distillation {
    fn motion_lcm() -> Self {
        Self::published(192_000, 128)
    }

    fn published(steps: u64, global: usize) -> Self {
        Self {
            teacher: "mld".into(),
            latents: "latents".into(),
            text: "text".into(),
            guidance: (5.0, 15.0),
            guidance_dim: 256,
            skip: 100,
            distance: Distance::Huber,
            huber_c: 0.5,
            ema: 0.95,
            upstream_dropout: false,
            training: Training::published(steps, global, 2e-4),
        }
    }
}

/// `distill.lcm`. Source: MotionLCM.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct DistillLcm {
    /// Everything.
    #[serde(flatten)]
    pub distillation: Distillation,
}

impl Default for DistillLcm {
    fn default() -> Self {
        Self { distillation: Distillation::motion_lcm() }
    }
}

/// `distill.pcm`. Source: MotionPCM, Algorithm 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct DistillPcm {
    /// M: phases, and sampling steps.
    pub phases: usize,
    /// Weight of the adversarial term; 0 trains without a discriminator.
    pub adversarial: f64,
    /// The discriminator's learning rate; 0 takes `lr`.
    pub discriminator_lr: f64,
    /// The discriminator's AdamW.
    pub discriminator_optimizer: Optimizer,
    /// Everything else.
    #[serde(flatten)]
    pub distillation: Distillation,
}

impl Default for DistillPcm {
    fn default() -> Self {
        Self {
            phases: 1,
            adversarial: 0.1,
            discriminator_lr: 0.0,
            discriminator_optimizer: Optimizer::default(),
            distillation: Distillation::published(384_000, 128),
        }
    }
}
