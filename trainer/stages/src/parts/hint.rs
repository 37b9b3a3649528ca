//! Target positions for a motion, and the number of them in training. Source: MotionLCM (Dai et al., ECCV 2024; v2 of
//! late 2024).
//!
//! Positions are global joints in metres of a motion that starts at the origin and faces z, as in HumanML3D. The
//! networks read them as `(position - mean) / std` per joint and axis. A mask marks the given ones, since 0 is a valid
//! position. Mean and deviation are those of the training entries. Upstream reads a file of OmniControl's that covers
//! only HumanML3D and whose origin is not documented.
//!
//! Not its job: the networks that steer towards positions (`control`).

use burn::tensor::Device;
use models::networks::Hints;
use motion::dataset::Dataset;
use motion::features::recover_joints;
use motion::{Skeleton, Stream};
use protocol::stage::{ControlHints, ControlSetting, Split};

use crate::metrics::control::ControlErrors;

/// Number of coordinates of a joint.
pub(crate) const AXES: usize = 3;
/// Lower limit of a coordinate's deviation, metres.
const LEAST_STD: f64 = 1e-3;

/// Target positions of one motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Hint {
    joints: usize,
    /// Positions [frames, joints, 3] in metres, 0 without a target.
    positions: Vec<f32>,
    /// Mask [frames, joints] of targets.
    given: Vec<bool>,
    /// Mask [frames, joints] of targets that only refinement uses.
    wanted: Vec<bool>,
}

impl Hint {
    /// A hint without targets.
    pub fn none(frames: usize, joints: usize) -> Self {
        let none = vec![false; frames * joints];
        Self { joints, positions: vec![0.0; frames * joints * AXES], given: none.clone(), wanted: none }
    }

    /// Targets from `joints` of a motion of `count` joints, `[frames, count, 3]` in metres, at `frames`.
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

    /// Sets the target of a joint at a frame.
    ///
    /// # Panics
    /// If the motion has no such frame or joint.
    pub fn tell(&mut self, frame: usize, joint: usize, position: [f32; 3]) {
        let at = frame * self.joints + joint;
        (self.given[at], self.wanted[at]) = (true, false);
        self.positions[at * AXES..(at + 1) * AXES].copy_from_slice(&position);
    }

    /// Sets a target that only refinement uses, for a joint outside the control part's training. An existing target
    /// stays.
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

    /// Number of joints of the skeleton.
    pub fn joints(&self) -> usize {
        self.joints
    }

    /// Number of frames of the motion.
    pub fn frames(&self) -> usize {
        self.given.len() / self.joints.max(1)
    }

    /// Number of targets.
    pub fn told(&self) -> usize {
        self.given.iter().filter(|given| **given).count()
    }

    /// Frame, joint and position of all targets, frame by frame.
    pub fn iter(&self) -> impl Iterator<Item = (usize, usize, [f32; 3])> {
        let told = self.given.iter().enumerate().filter(|(_, given)| **given);
        told.map(|(i, _)| {
            let at = i * AXES;
            (i / self.joints, i % self.joints, [self.positions[at], self.positions[at + 1], self.positions[at + 2]])
        })
    }

    /// The targets of refinement, as ordinary targets.
    pub(crate) fn wants(&self) -> Self {
        Self { given: self.wanted.clone(), ..self.clone() }
    }

    /// Errors of a motion `[frames, joints, 3]` in metres against the targets; `None` without targets.
    pub fn errors(&self, motion: &[f32], threshold: f64) -> Option<ControlErrors> {
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
        ControlErrors::of(&wide(motion), &wide(&self.positions), &self.given, threshold)
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

/// Draws the `count` frames of `length` that get targets: the first ones, or any, by `setting`.
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

/// Draws the number of frames of `length` that get targets in training.
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
    let mut sums = vec![0.0_f64; width];
    let mut squares = vec![0.0_f64; width];
    let mut frames = 0_usize;
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

/// Hints of a batch, normalised for the networks.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalisedHints {
    /// Positions [B, T, joints, 3], 0 without a target.
    pub values: Vec<f32>,
    /// Mask of the same shape.
    pub given: Vec<bool>,
    /// Sizes B, T and joints.
    pub shape: (usize, usize, usize),
}

impl NormalisedHints {
    /// Normalises `hints` and pads them to the longest. `mean` and `std` are `[joints x 3]`, in metres.
    pub fn of(hints: &[Hint], mean: &[f32], std: &[f32]) -> Self {
        let joints = mean.len() / AXES;
        let frames = hints.iter().map(Hint::frames).max().unwrap_or_default();
        let width = frames * joints * AXES;
        let mut values = vec![0.0; hints.len() * width];
        let mut given = vec![false; hints.len() * width];
        for (b, hint) in hints.iter().enumerate() {
            for (t, j, position) in hint.iter() {
                for (axis, value) in position.iter().enumerate() {
                    let at = b * width + (t * joints + j) * AXES + axis;
                    let of = j * AXES + axis;
                    values[at] = (value - mean[of]) / std[of];
                    given[at] = true;
                }
            }
        }
        Self { values, given, shape: (hints.len(), frames, joints) }
    }

    /// Converts to the input of the trajectory encoder.
    pub fn on(&self, device: &Device) -> Hints {
        Hints::new(&self.values, &self.given, self.shape, device)
    }
}

#[cfg(test)]
mod tests {
    use protocol::Seed;

    use super::*;

    #[test]
    fn a_hint_is_masked_and_normalised_by_joint_and_axis() {
        // Two frames, two joints.
        let motion: Vec<f32> = (0..12).map(|v| v as f32).collect();
        let hint = Hint::of(&motion, 2, &[1], &[1]);
        assert_eq!(hint.iter().collect::<Vec<_>>(), [(1, 1, [9.0, 10.0, 11.0])]);
        let longer = Hint::of(&[1.0; 18], 2, &[0], &[0, 2]);
        let mean = [0.0, 0.0, 0.0, 1.0, 2.0, 3.0];
        let std = [1.0, 1.0, 1.0, 2.0, 2.0, 4.0];
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
