//! The part of a model that steers its denoiser towards given joint positions. Source: MotionLCM (Dai et al., ECCV
//! 2024; v2 of late 2024). Stage `train.control` trains it; the positions are [`Hint`]s.

use burn::tensor::Device;
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::kernels::Dropout;
use models::networks::{Denoiser, Feedback, FeedbackConfig, Init, TrajectoryConfig, TrajectoryEncoder};
use protocol::stage::{ControlHints, DataFormat, Network};
use protocol::{Manifest, limits};
use serde::{Deserialize, Serialize};

use super::hint::{AXES, Hint, NormalisedHints};
use super::latent_networks::Autoencoder;
use super::steering::Steering;
use super::{feedback, weights};
use crate::artifacts::{self, DenoiserMeta};
use crate::context::StageError;

/// Prefix of the ControlNet's weights, as in MotionLCM's checkpoints.
pub(crate) const CONTROLNET_PREFIX: &str = "controlnet.";
/// Prefix of the trajectory encoder's weights.
pub(crate) const TRAJECTORY_PREFIX: &str = "traj_encoder.";
/// Prefix of the feedback network's weights.
pub(crate) const FEEDBACK_PREFIX: &str = "feedback.";

/// Options of the steering towards given positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlOptions {
    /// Factor on the ControlNet's residuals and on the changes by feedback; 1 as trained, 0 for none.
    pub scale: f64,
    /// Rounds of feedback; `None` for the number used in training.
    pub feedback: Option<usize>,
    /// Steps of gradient descent that refine the drawn latents.
    pub refine: usize,
}

impl Default for ControlOptions {
    fn default() -> Self {
        Self { scale: 1.0, feedback: None, refine: 0 }
    }
}

/// Meta of an artifact of kind `control`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ControlMeta {
    /// The skeleton whose joints have targets.
    pub format: DataFormat,
    /// The hints of the training.
    pub hints: ControlHints,
    /// Width of the layers between trajectory tokens and ControlNet.
    pub embedding: usize,
    /// Size of the trajectory encoder.
    pub network: Network,
    /// Mean of the joints' coordinates, `[joints x 3]` in metres.
    pub mean: Vec<f32>,
    /// Standard deviation of the joints' coordinates, `[joints x 3]` in metres.
    pub std: Vec<f32>,
    /// The denoiser that the ControlNet was copied from; it works for no other one.
    pub fits: Parts,
    /// True if a Linear follows the trajectory encoder. `None` means that it exists if the width of a latent token
    /// differs from the encoder's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub projection: Option<bool>,
    /// Rounds of feedback; 0 means that there is no feedback network.
    #[serde(default, skip_serializing_if = "none")]
    pub feedback: usize,
}

fn none(rounds: &usize) -> bool {
    *rounds == 0
}

impl ControlMeta {
    /// Creates a ControlNet for a denoiser, before the shared weights are copied. In v2, whose latents are projected,
    /// its condition has activations.
    pub fn controlnet(&self, denoiser: &DenoiserMeta, init: &mut Init<'_>) -> Denoiser {
        let config = denoiser.config();
        Denoiser::controlnet(&config, self.embedding, config.projection, init)
    }

    /// Creates a trajectory encoder; its tokens have the shape of the denoiser's latents.
    pub fn trajectory(&self, denoiser: &DenoiserMeta, init: &mut Init<'_>) -> TrajectoryEncoder {
        let config = TrajectoryConfig {
            joints: self.mean.len() / AXES,
            latent: denoiser.latent,
            network: self.network.clone(),
            projection: self.projection.unwrap_or(denoiser.latent.dim != self.network.width),
        };
        TrajectoryEncoder::new(&config, init)
    }

    /// Creates a feedback network for the denoiser's latents, if the part has one.
    pub fn feedback(&self, denoiser: &DenoiserMeta, init: &mut Init<'_>) -> Option<Feedback> {
        let config = FeedbackConfig {
            latent: denoiser.latent,
            inputs: feedback::inputs(self.mean.len() / AXES),
            network: self.network.clone(),
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
    /// Reads an artifact of kind `control` for a denoiser with this meta.
    pub fn read(
        blobs: &dyn Blobs,
        manifest: &Manifest,
        denoiser: &DenoiserMeta,
        device: &Device,
    ) -> Result<Self, StageError> {
        let meta: ControlMeta = artifacts::meta(manifest, "the control part")?;
        let device = device.clone().inner();
        let mut blank = Init::blank(&device);
        let control = meta.controlnet(denoiser, &mut blank);
        let trajectory = meta.trajectory(denoiser, &mut blank);
        let what = "the control part's weights";
        let control = weights::load_under(control, blobs, manifest, CONTROLNET_PREFIX, what)?;
        let trajectory = weights::load_under(trajectory, blobs, manifest, TRAJECTORY_PREFIX, what)?;
        if meta.feedback > limits::FEEDBACK_ROUNDS {
            let found = meta.feedback;
            let most = limits::FEEDBACK_ROUNDS;
            let why = format!("the control part has {found} rounds of feedback; expected at most {most}");
            return Err(StageError::Input(why));
        }
        let feedback = meta.feedback(denoiser, &mut blank);
        let feedback = feedback.map(|blank| weights::load_under(blank, blobs, manifest, FEEDBACK_PREFIX, what));
        Ok(Self { control, trajectory, feedback: feedback.transpose()?, meta, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &ControlMeta {
        &self.meta
    }

    /// Corrects latents `[batch, N, d]` of motions of `lengths` frames by rounds of feedback on the distance of their
    /// motions from `hints`.
    pub(crate) fn correct(
        &self,
        vae: &Autoencoder,
        z: Vec<f32>,
        lengths: &[usize],
        (hints, options): (&[Hint], ControlOptions),
    ) -> Vec<f32> {
        match &self.feedback {
            Some(network) => {
                let rounds = options.feedback.unwrap_or(self.meta.feedback);
                feedback::correct(network, vae, z, (lengths, hints), rounds, options.scale)
            }
            None => z,
        }
    }

    /// The steering of a batch with `hints`, its residuals multiplied by `scale`.
    pub fn steer(&self, hints: &[Hint], scale: f64) -> Steering<'_> {
        let hints = NormalisedHints::of(hints, &self.meta.mean, &self.meta.std).on(&self.device);
        let tokens_bnd = self.trajectory.forward(&hints, &mut Dropout::off());
        Steering { control: &self.control, tokens_bnd, scale }
    }
}
