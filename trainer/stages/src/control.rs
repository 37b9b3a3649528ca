//! Positions that a motion is told to pass, and the part of a model that makes its denoiser heed them. Source: MotionLCM (Dai et al., ECCV
//! 2024; v2 of late 2024). Its training is `train.control`.
//!
//! Positions are global joints in metres, of a motion that starts at the origin and faces z, as HumanML3D's do. The networks see them as
//! `(position - mean) / std` a joint and axis; a mask says which are told, since 0 is a position like any other. Mean and deviation are those of the
//! training entries; upstream reads a file of OmniControl's, which is of HumanML3D alone, and whose making is not documented.

use burn::tensor::{Device, Tensor};
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::kernels::Dropout;
use models::networks::{Denoiser, Hints, Init, TrajectoryConfig, TrajectoryEncoder};
use motion::dataset::Dataset;
use motion::features::recover_joints;
use motion::{Skeleton, Stream};
use protocol::stage::{ControlHints, ControlSetting, DataFormat, Network, Positions, Split};
use protocol::{Manifest, Seed};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, DenoiserMeta};
use crate::context::StageError;
use crate::evaluation::control::ControlErrors;
use crate::weights;

/// Coordinates of a joint.
const AXES: usize = 3;
/// Added to variances in layer norms.
const NORM_EPS: f64 = 1e-5;
/// Least deviation that a coordinate is divided by, metres.
const LEAST_STD: f64 = 1e-3;
/// What names of the ControlNet's weights begin with, as in MotionLCM's checkpoints.
pub(crate) const CONTROLNET_PREFIX: &str = "controlnet.";
/// What names of the trajectory encoder's weights begin with.
pub(crate) const TRAJECTORY_PREFIX: &str = "traj_encoder.";

/// Positions of one motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Hint {
    joints: usize,
    /// [frames, joints, 3] in metres, 0 where nothing is told.
    positions: Vec<f32>,
    /// [frames, joints].
    given: Vec<bool>,
    /// [frames, joints]: what nobody but refinement looks at.
    wanted: Vec<bool>,
}

impl Hint {
    /// Nothing told of a motion.
    pub fn none(frames: usize, joints: usize) -> Self {
        let none = vec![false; frames * joints];
        Self { joints, positions: vec![0.0; frames * joints * AXES], given: none.clone(), wanted: none }
    }

    /// `joints` of a motion of `count` joints, `[frames, count, 3]` in metres, at `frames`.
    pub fn of(motion: &[f32], count: usize, joints: &[usize], frames: &[usize]) -> Self {
        let mut hint = Self::none(motion.len() / (count * AXES), count);
        for t in frames {
            for j in joints {
                let at = (t * count + j) * AXES;
                hint.tell(*t, *j, [motion[at], motion[at + 1], motion[at + 2]]);
            }
        }
        hint
    }

    /// Tells where a joint should be at a frame.
    ///
    /// # Panics
    /// If the motion has no such frame or joint.
    pub fn tell(&mut self, frame: usize, joint: usize, position: [f32; 3]) {
        let at = frame * self.joints + joint;
        (self.given[at], self.wanted[at]) = (true, false);
        self.positions[at * AXES..(at + 1) * AXES].copy_from_slice(&position);
    }

    /// Tells refinement alone where a joint should be at a frame: one that the control part was not trained to be told. What is told stays.
    ///
    /// # Panics
    /// If the motion has no such frame or joint.
    pub fn want(&mut self, frame: usize, joint: usize, position: [f32; 3]) {
        let at = frame * self.joints + joint;
        if !self.given[at] {
            self.wanted[at] = true;
            self.positions[at * AXES..(at + 1) * AXES].copy_from_slice(&position);
        }
    }

    /// Joints of the skeleton.
    pub fn joints(&self) -> usize {
        self.joints
    }

    /// Frames of the motion.
    pub fn frames(&self) -> usize {
        self.given.len() / self.joints.max(1)
    }

    /// How many positions are told.
    pub fn told(&self) -> usize {
        self.given.iter().filter(|given| **given).count()
    }

    /// Frame, joint and position of all that is told, frame by frame.
    pub fn iter(&self) -> impl Iterator<Item = (usize, usize, [f32; 3])> {
        let told = self.given.iter().enumerate().filter(|(_, given)| **given);
        told.map(|(i, _)| {
            let at = i * AXES;
            (i / self.joints, i % self.joints, [self.positions[at], self.positions[at + 1], self.positions[at + 2]])
        })
    }

    /// What refinement alone is told, as if all were told it.
    pub(crate) fn wants(&self) -> Self {
        Self { given: self.wanted.clone(), ..self.clone() }
    }

    /// How far a motion `[frames, joints, 3]` in metres is from it; `None` if nothing is told.
    pub fn errors(&self, motion: &[f32], threshold: f64) -> Option<ControlErrors> {
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
        ControlErrors::of(&wide(motion), &wide(&self.positions), &self.given, threshold)
    }
}

/// How told positions are heeded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heed {
    /// What the ControlNet's residuals are multiplied by; 1 as trained, 0 not at all.
    pub scale: f64,
    /// Steps of descent that the drawn latents are refined by.
    pub refine: usize,
}

impl Default for Heed {
    fn default() -> Self {
        Self { scale: 1.0, refine: 0 }
    }
}

/// Joints of feature rows in metres, `[frames, joints, 3]`.
pub fn metres(features: &[f32], skeleton: &Skeleton) -> Vec<f32> {
    let mut joints = recover_joints(features, skeleton);
    if skeleton.metres_per_unit != 1.0 {
        joints.iter_mut().for_each(|v| *v = (f64::from(*v) * skeleton.metres_per_unit) as f32);
    }
    joints
}

/// Which frames of `length` are told, given how many: the first ones, or any.
pub fn told_frames(setting: ControlSetting, count: usize, length: usize, draw: &mut Stream) -> Vec<usize> {
    let count = count.min(length);
    match setting {
        ControlSetting::Temporal => (0..count).collect(),
        ControlSetting::Spatial => {
            let mut all: Vec<usize> = (0..length).collect();
            for i in 0..count {
                all.swap(i, i + draw.below(length - i));
            }
            all.truncate(count);
            all.sort_unstable();
            all
        }
    }
}

/// How many frames of `length` training tells.
pub fn told_count(hints: &ControlHints, length: usize, draw: &mut Stream) -> usize {
    if hints.any_number() {
        return 1 + draw.below(length.saturating_sub(1).max(1));
    }
    let percent = draw.range(hints.density.0, hints.density.1);
    share(percent, length)
}

/// `percent` of `length` frames, rounded down.
pub fn share(percent: f64, length: usize) -> usize {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most the length")]
    let count = (length as f64 * percent / 100.0) as usize;
    count
}

/// Mean and deviation of each joint's coordinates over all frames of the training entries, `[joints x 3]` in metres.
pub fn joint_statistics(dataset: &Dataset) -> (Vec<f32>, Vec<f32>) {
    let skeleton = dataset.skeleton();
    let width = skeleton.joints * AXES;
    let (mut sums, mut squares, mut frames) = (vec![0.0_f64; width], vec![0.0_f64; width], 0_usize);
    for entry in dataset.entries_of(Split::Train) {
        for row in metres(dataset.features(&dataset.entries[entry]), skeleton).chunks_exact(width) {
            for ((sum, square), value) in sums.iter_mut().zip(&mut squares).zip(row) {
                *sum += f64::from(*value);
                *square += f64::from(*value).powi(2);
            }
            frames += 1;
        }
    }
    let n = frames.max(1) as f64;
    let mean: Vec<f64> = sums.iter().map(|sum| sum / n).collect();
    let std = squares.iter().zip(&mean).map(|(square, mean)| (square / n - mean * mean).max(0.0).sqrt().max(LEAST_STD));
    (mean.iter().map(|v| *v as f32).collect(), std.map(|v| v as f32).collect())
}

/// Hints of a batch in the networks' scale.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalisedHints {
    /// [B, T, joints, 3], 0 where nothing is told.
    pub values: Vec<f32>,
    /// Of the same shape.
    pub given: Vec<bool>,
    /// B, T, joints.
    pub shape: (usize, usize, usize),
}

impl NormalisedHints {
    /// Of `hints`, padded to the longest. `mean` and `std` are `[joints x 3]`, in metres.
    pub fn of(hints: &[Hint], mean: &[f32], std: &[f32]) -> Self {
        let joints = mean.len() / AXES;
        let frames = hints.iter().map(Hint::frames).max().unwrap_or_default();
        let width = frames * joints * AXES;
        let (mut values, mut given) = (vec![0.0; hints.len() * width], vec![false; hints.len() * width]);
        for (b, hint) in hints.iter().enumerate() {
            for (t, j, position) in hint.iter() {
                for (axis, value) in position.iter().enumerate() {
                    let (at, of) = (b * width + (t * joints + j) * AXES + axis, j * AXES + axis);
                    values[at] = (value - mean[of]) / std[of];
                    given[at] = true;
                }
            }
        }
        Self { values, given, shape: (hints.len(), frames, joints) }
    }

    /// As the trajectory encoder takes them.
    pub fn on(&self, device: &Device) -> Hints {
        Hints::new(&self.values, &self.given, self.shape, device)
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
}

/// A trained control part.
#[derive(Debug)]
pub struct TrainedControl {
    control: Denoiser,
    trajectory: TrajectoryEncoder,
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
        Ok(Self { control, trajectory, meta, device })
    }

    /// What it is.
    pub fn meta(&self) -> &ControlMeta {
        &self.meta
    }

    /// What steers a batch that is told `hints`, with residuals multiplied by `scale`.
    pub fn steer(&self, hints: &[Hint], scale: f64) -> Steering<'_> {
        let hints = NormalisedHints::of(hints, &self.meta.mean, &self.meta.std).on(&self.device);
        let tokens_bnd = self.trajectory.forward(&hints, &mut Dropout::off());
        Steering { control: &self.control, tokens_bnd, scale }
    }
}

/// A ControlNet and what it is told of a batch.
#[derive(Debug, Clone)]
pub struct Steering<'a> {
    control: &'a Denoiser,
    tokens_bnd: Tensor<3>,
    scale: f64,
}

impl Steering<'_> {
    /// What is added to the denoiser's blocks, and times how much, for the arguments that it is given. A batch that stands there several times, as
    /// for guidance, is told the same each time.
    pub(crate) fn residuals(
        &self,
        latent_bnd: &Tensor<3>,
        timesteps: &[usize],
        text_blc: &Tensor<3>,
        guidance_bg: Option<&Tensor<2>>,
    ) -> (Vec<Tensor<3>>, f64) {
        let times = latent_bnd.dims()[0] / self.tokens_bnd.dims()[0].max(1);
        let tokens = Tensor::cat(vec![self.tokens_bnd.clone(); times.max(1)], 0);
        let (latent, text, guidance) = (latent_bnd.clone(), text_blc.clone(), guidance_bg.cloned());
        (self.control.residuals(latent, timesteps, text, guidance, tokens, &mut Dropout::off()), self.scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hint_is_masked_and_normalised_by_joint_and_axis() {
        // Two frames, two joints.
        let motion: Vec<f32> = (0..12).map(|v| v as f32).collect();
        let hint = Hint::of(&motion, 2, &[1], &[1]);
        assert_eq!(hint.iter().collect::<Vec<_>>(), [(1, 1, [9.0, 10.0, 11.0])]);
        let longer = Hint::of(&[1.0; 18], 2, &[0], &[0, 2]);
        let (mean, std) = ([0.0, 0.0, 0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 1.0, 2.0, 2.0, 4.0]);
        let both = NormalisedHints::of(&[hint.clone(), longer], &mean, &std);
        assert_eq!(both.shape, (2, 3, 2));
        assert_eq!(both.values[9..12], [4.0, 4.0, 2.0]);
        assert_eq!(both.given.iter().filter(|given| **given).count(), 3 + 6);
        assert!(both.given[9..12].iter().all(|given| *given) && both.given[18..21].iter().all(|given| *given));
        let errors = hint.errors(&[0.0; 12], 0.5).unwrap();
        assert!((errors.average - (81.0_f64 + 100.0 + 121.0).sqrt()).abs() < 1e-6);
        assert_eq!(Hint::none(2, 2).errors(&motion, 0.5), None);
    }

    #[test]
    fn frames_are_told_as_published() {
        let mut draw = Stream::new(Seed(3), "x", 0, 0);
        let hints = |setting, density| ControlHints { setting, joints: vec!["six".into()], density };
        let quarter = hints(ControlSetting::Temporal, (25.0, 25.0));
        // MotionLCM's loader: 6 of 26 frames, 5 of 23, none of 3.
        let counts: Vec<usize> = [26, 23, 3].map(|length| told_count(&quarter, length, &mut draw)).to_vec();
        assert_eq!(counts, [6, 5, 0]);
        assert_eq!(told_frames(ControlSetting::Temporal, 6, 26, &mut draw), [0, 1, 2, 3, 4, 5]);
        let any = hints(ControlSetting::Spatial, (0.0, 100.0));
        let mut seen = std::collections::BTreeSet::new();
        for _ in 0..200 {
            let count = told_count(&any, 5, &mut draw);
            seen.insert(count);
            let frames = told_frames(ControlSetting::Spatial, count, 5, &mut draw);
            assert!(frames.len() == count && frames.windows(2).all(|pair| pair[0] < pair[1]) && frames[count - 1] < 5);
        }
        assert_eq!(seen.into_iter().collect::<Vec<_>>(), [1, 2, 3, 4]);
        assert_eq!(told_count(&any, 1, &mut draw), 1);
    }
}
