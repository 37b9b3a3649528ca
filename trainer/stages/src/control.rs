//! The part of a model that makes its denoiser heed the positions that a motion is told to pass. Source: MotionLCM (Dai et al., ECCV 2024; v2 of
//! late 2024). Its training is `train.control`; the positions are [`Hint`]s.

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::kernels::Dropout;
use models::networks::{Denoiser, Feedback, FeedbackConfig, Init, StackConfig, TrajectoryConfig, TrajectoryEncoder};
use protocol::stage::{ControlHints, DataFormat, Network, Positions};
use protocol::{Manifest, Seed, limits};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, DenoiserMeta};
use crate::context::StageError;
use crate::feedback;
use crate::hint::{AXES, Hint, NormalisedHints};
use crate::networks::Autoencoder;
use crate::steering::Steering;
use crate::weights;

/// Added to variances in layer norms.
const NORM_EPS: f64 = 1e-5;
/// What names of the ControlNet's weights begin with, as in MotionLCM's checkpoints.
pub(crate) const CONTROLNET_PREFIX: &str = "controlnet.";
/// What names of the trajectory encoder's weights begin with.
pub(crate) const TRAJECTORY_PREFIX: &str = "traj_encoder.";
/// What names of the feedback network's weights begin with.
pub(crate) const FEEDBACK_PREFIX: &str = "feedback.";

/// How told positions are heeded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heed {
    /// What the ControlNet's residuals, and what feedback changes, are multiplied by; 1 as trained, 0 not at all.
    pub scale: f64,
    /// Rounds of feedback; `None` as many as the control part was trained with.
    pub feedback: Option<usize>,
    /// Steps of descent that the drawn latents are refined by.
    pub refine: usize,
}

impl Default for Heed {
    fn default() -> Self {
        Self { scale: 1.0, feedback: None, refine: 0 }
    }
}

/// Meta of an artifact of kind `control`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ControlMeta {
    /// The skeleton whose joints are told.
    pub format: DataFormat,
    /// What was told in training.
    pub hints: ControlHints,
    /// Width of the layers between trajectory tokens and ControlNet.
    pub embedding: usize,
    /// Size of the trajectory encoder.
    pub network: Network,
    /// Mean of the joints' coordinates, `[joints x 3]` in metres.
    pub mean: Vec<f32>,
    /// Their deviation.
    pub std: Vec<f32>,
    /// The denoiser whose copy the ControlNet is; for another one it says nothing.
    pub fits: Parts,
    /// A Linear behind the trajectory encoder. Where nothing is said there is one if a latent token has another width than it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub projection: Option<bool>,
    /// Rounds of feedback; 0 has no network for it.
    #[serde(default, skip_serializing_if = "none")]
    pub feedback: usize,
}

fn none(rounds: &usize) -> bool {
    *rounds == 0
}

impl ControlMeta {
    /// A fresh ControlNet for a denoiser; what the two have in common is not copied yet. In v2, whose latents are projected, its condition has
    /// activations.
    pub fn controlnet(&self, denoiser: &DenoiserMeta, init: &mut Init<'_>) -> Denoiser {
        let config = denoiser.config();
        Denoiser::controlnet(&config, self.embedding, config.projection, init)
    }

    /// A fresh trajectory encoder, whose tokens are shaped as the denoiser's latents are.
    pub fn trajectory(&self, denoiser: &DenoiserMeta, init: &mut Init<'_>) -> TrajectoryEncoder {
        let config = TrajectoryConfig {
            joints: self.mean.len() / AXES,
            tokens: denoiser.latent.tokens,
            dim: denoiser.latent.dim,
            width: self.network.width,
            layers: self.network.layers,
            heads: self.network.heads,
            feed_forward: self.network.feed_forward,
            projection: self.projection.unwrap_or(denoiser.latent.dim != self.network.width),
            norm_eps: NORM_EPS,
        };
        TrajectoryEncoder::new(&config, init)
    }

    /// A fresh feedback network, if there is one, for latents as the denoiser's.
    pub fn feedback(&self, denoiser: &DenoiserMeta, init: &mut Init<'_>) -> Option<Feedback> {
        let Network { width, layers, heads, feed_forward, .. } = self.network;
        let config = FeedbackConfig {
            tokens: denoiser.latent.tokens,
            dim: denoiser.latent.dim,
            inputs: feedback::inputs(self.mean.len() / AXES),
            stack: StackConfig { width, layers, heads, feed_forward, norm_eps: NORM_EPS, memory: false },
        };
        (self.feedback > 0).then(|| Feedback::new(&config, init))
    }
}

/// A trained control part.
#[derive(Debug)]
pub struct TrainedControl {
    control: Denoiser,
    trajectory: TrajectoryEncoder,
    feedback: Option<Feedback>,
    meta: ControlMeta,
    device: Device,
}

impl TrainedControl {
    /// Reads an artifact of kind `control`, made for a denoiser of this meta.
    pub fn read(
        blobs: &dyn Blobs,
        manifest: &Manifest,
        denoiser: &DenoiserMeta,
        device: &Device,
    ) -> Result<Self, StageError> {
        let meta: ControlMeta = artifacts::meta(manifest, "the control part")?;
        let device = device.clone().inner();
        let mut blank = Init::new(Seed(0), "blank", Positions::Uniform, &device);
        let (control, trajectory) = (meta.controlnet(denoiser, &mut blank), meta.trajectory(denoiser, &mut blank));
        let what = "the control part's weights";
        let control = weights::load_under(control, blobs, manifest, CONTROLNET_PREFIX, what)?;
        let trajectory = weights::load_under(trajectory, blobs, manifest, TRAJECTORY_PREFIX, what)?;
        if meta.feedback > limits::FEEDBACK_ROUNDS {
            let (found, most) = (meta.feedback, limits::FEEDBACK_ROUNDS);
            let why = format!("the control part asks for {found} rounds of feedback; expected at most {most}");
            return Err(StageError::Input(why));
        }
        let feedback = meta.feedback(denoiser, &mut blank);
        let feedback = feedback.map(|blank| weights::load_under(blank, blobs, manifest, FEEDBACK_PREFIX, what));
        Ok(Self { control, trajectory, feedback: feedback.transpose()?, meta, device })
    }

    /// What it is.
    pub fn meta(&self) -> &ControlMeta {
        &self.meta
    }

    /// Latents `[batch, N, d]` of motions of `lengths` frames after the rounds of feedback that are asked for, on how far their motions are from `hints`.
    pub(crate) fn correct(
        &self,
        vae: &Autoencoder,
        z: Vec<f32>,
        lengths: &[usize],
        (hints, heed): (&[Hint], Heed),
    ) -> Vec<f32> {
        match &self.feedback {
            Some(network) => {
                let rounds = heed.feedback.unwrap_or(self.meta.feedback);
                feedback::correct(network, vae, z, (lengths, hints), rounds, heed.scale)
            }
            None => z,
        }
    }

    /// What steers a batch that is told `hints`, with residuals multiplied by `scale`.
    pub fn steer(&self, hints: &[Hint], scale: f64) -> Steering<'_> {
        let hints = NormalisedHints::of(hints, &self.meta.mean, &self.meta.std).on(&self.device);
        let tokens_bnd = self.trajectory.forward(&hints, &mut Dropout::off());
        Steering { control: &self.control, tokens_bnd, scale }
    }
}
