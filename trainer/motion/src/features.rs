//! Conversion of joints to feature rows: the HumanML3D feature definition.
//!
//! Source: Guo et al., "Generating Diverse and Natural 3D Human Motions from Text" (CVPR 2022) and its published
//! feature code. Steps: uniform skeleton, floor, origin, facing +z ([`place`]), then heading, rotations, positions,
//! velocities and contacts ([`rows`]). The inverse is in `recover`.
//!
//! Two oddities of the published data are part of the definition. The heading is computed from (right - left shoulder)
//! *minus* (right - left hip), smoothed over time and forced to the identity in frame 0. Every kinematic chain starts
//! from the heading, also the arms, and not from the rotation of the joint that they are attached to.
//!
//! Departs: f64 throughout, where the published code mixes f32 and f64 (largest difference over 301 clips: 2.2e-4, in
//! rotations of nearly opposite bones).
//!
//! Arrays: joints `[T, J, 3]`, rotations `[T, J]`, rows `[T - 1, D]`.

mod recover;

pub use recover::{follow_path, mirror_joints, recover_from_rotations, recover_joints, recover_joints_wide, root_path};

use crate::quaternion::{self as quat, Quat, Vec3};
use crate::skeleton::Skeleton;

/// Standard deviation, in frames, of the filter over the facing direction.
const HEADING_SIGMA: f64 = 20.0;

/// The joints cannot be converted to features.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FeatureError {
    /// The array is not a whole number of frames.
    #[error("has {values} joint coordinates; expected a multiple of {joints} joints x 3")]
    Shape {
        /// Number of values in the array.
        values: usize,
        /// Number of joints J.
        joints: usize,
    },
    /// Velocities need a second frame.
    #[error("has too few frames: {frames}; expected at least 2, because the last frame only supplies velocities")]
    TooFewFrames {
        /// Number of frames T.
        frames: usize,
    },
    /// NaN or infinity among the joints.
    #[error("joint {joint} of frame {frame} is not finite")]
    NotFinite { frame: usize, joint: usize },
    /// A direction that the definition needs does not exist.
    #[error(
        "frame {frame}: a rotation is undefined; two joints of a bone coincide, or the body faces exactly away from +z \
         after frame 0 or has a bone exactly opposite to its rest direction"
    )]
    Undefined { frame: usize },
    /// No target skeleton is known for the format.
    #[error("the uniform skeleton of this format is not public; set the bone lengths of the target skeleton")]
    NoTarget,
    /// The table of bone lengths has another size.
    #[error("has {found} bone lengths; expected {expected}")]
    Target {
        /// Number of lengths given.
        found: usize,
        /// Number of joints J.
        expected: usize,
    },
}

/// Computes feature rows `[T - 1, D]` of joints `[T, J, 3]` in the format's units, y up.
///
/// `target` is the bone lengths `[J]` of the uniform skeleton, `None` for the format's own
/// ([`Skeleton::bone_lengths`]). Those of KIT-ML are not public and must be given.
pub fn extract(joints: &[f32], skeleton: &Skeleton, target: Option<&[f64]>) -> Result<Vec<f32>, FeatureError> {
    extract_with(joints, skeleton, target, Turns::Published)
}

/// Treatment of a body that turns past the direction opposite to that of frame 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Turns {
    /// As in the published data: the quaternion changes sign there, and so does the turn of that one frame. The
    /// recovered motion bends by twice that turn.
    #[default]
    Published,
    /// The turn keeps its sign. Differs from the published definition in that frame only.
    Continuous,
}

/// Like [`extract`], with a choice for turns past the opposite direction.
pub fn extract_with(
    joints: &[f32],
    skeleton: &Skeleton,
    target: Option<&[f64]>,
    turns: Turns,
) -> Result<Vec<f32>, FeatureError> {
    let width = 3 * skeleton.joints;
    if joints.is_empty() || !joints.len().is_multiple_of(width) {
        return Err(FeatureError::Shape { values: joints.len(), joints: skeleton.joints });
    }
    let frames = joints.len() / width;
    if frames < 2 {
        return Err(FeatureError::TooFewFrames { frames });
    }
    if let Some(at) = joints.iter().position(|v| !v.is_finite()) {
        return Err(FeatureError::NotFinite { frame: at / width, joint: at % width / 3 });
    }
    let target = target.or(skeleton.bone_lengths).ok_or(FeatureError::NoTarget)?;
    if target.len() != skeleton.joints {
        return Err(FeatureError::Target { found: target.len(), expected: skeleton.joints });
    }
    let joints: Vec<f64> = joints.iter().map(|v| f64::from(*v)).collect();
    let (uniform, _) = uniform_skeleton(&joints, skeleton, target);
    let rows = rows(&place(&uniform, skeleton), skeleton, turns);
    match rows.iter().position(|v| !v.is_finite()) {
        None => Ok(rows),
        Some(at) => Err(FeatureError::Undefined { frame: at / skeleton.features }),
    }
}

/// Position of joint `j` in a frame.
pub(crate) fn joint(frame: &[f64], j: usize) -> Vec3 {
    [frame[3 * j], frame[3 * j + 1], frame[3 * j + 2]]
}

/// The same motion with the bone lengths `target`, and the factor on its root path, the ratio of the leg lengths.
pub fn uniform_skeleton(joints: &[f64], skeleton: &Skeleton, target: &[f64]) -> (Vec<f64>, f64) {
    let width = 3 * skeleton.joints;
    let source = skeleton.lengths_of_pose(&joints[..width]);
    let legs = |lengths: &[f64]| skeleton.legs.iter().map(|j| lengths[*j]).sum::<f64>();
    let factor = legs(target) / legs(&source);
    let rotations = inverse_kinematics(joints, skeleton, false);
    let roots: Vec<Vec3> = joints.chunks_exact(width).map(|f| quat::scale(joint(f, 0), factor)).collect();
    (forward_kinematics(&rotations, &roots, skeleton, target), factor)
}

/// Puts the motion on the floor (its lowest point at y = 0), with the root of frame 0 above the origin, facing +z
/// there.
pub fn place(joints: &[f64], skeleton: &Skeleton) -> Vec<f64> {
    let floor = joints.iter().skip(1).step_by(3).copied().fold(f64::INFINITY, f64::min);
    let origin = [joints[0], floor, joints[2]];
    let [r_hip, l_hip, r_shoulder, l_shoulder] = skeleton.face.map(|j| joint(joints, j));
    let across = quat::add(quat::sub(r_hip, l_hip), quat::sub(r_shoulder, l_shoulder));
    let forward = quat::unit(quat::cross([0.0, 1.0, 0.0], across));
    let turn = quat::between(forward, [0.0, 0.0, 1.0]);
    joints.chunks_exact(3).flat_map(|p| quat::rotate(turn, quat::sub([p[0], p[1], p[2]], origin))).collect()
}

/// Rotation of the heading (joint 0) and of each bone relative to the one before it in its chain, `[T, J]`.
///
/// Undefined rotations are NaN.
pub fn inverse_kinematics(joints: &[f64], skeleton: &Skeleton, smooth: bool) -> Vec<Quat> {
    let headings = headings(joints, skeleton, smooth);
    let mut rotations = vec![quat::IDENTITY; headings.len() * skeleton.joints];
    let frames = joints.chunks_exact(3 * skeleton.joints).zip(rotations.chunks_exact_mut(skeleton.joints));
    for ((frame, out), heading) in frames.zip(headings) {
        out[0] = heading;
        for chain in skeleton.chains {
            let mut parent = heading;
            for bone in chain.windows(2) {
                let direction = quat::unit(quat::sub(joint(frame, bone[1]), joint(frame, bone[0])));
                let global = quat::between(skeleton.directions[bone[1]], direction);
                let local = quat::mul(quat::inverse(parent), global);
                out[bone[1]] = local;
                parent = quat::mul(parent, local);
            }
        }
    }
    rotations
}

/// Computes joints `[T, J, 3]` from rotations as of [`inverse_kinematics`], root positions and bone lengths.
pub fn forward_kinematics(rotations: &[Quat], roots: &[Vec3], skeleton: &Skeleton, lengths: &[f64]) -> Vec<f64> {
    let mut joints = vec![0.0; roots.len() * skeleton.joints * 3];
    let frames = joints.chunks_exact_mut(3 * skeleton.joints).zip(rotations.chunks_exact(skeleton.joints));
    for ((frame, rotations), root) in frames.zip(roots) {
        frame[..3].copy_from_slice(root);
        for chain in skeleton.chains {
            let mut global = rotations[0];
            for bone in chain.windows(2) {
                global = quat::mul(global, rotations[bone[1]]);
                let offset = quat::scale(skeleton.directions[bone[1]], lengths[bone[1]]);
                let at = quat::add(joint(frame, bone[0]), quat::rotate(global, offset));
                frame[3 * bone[1]..3 * bone[1] + 3].copy_from_slice(&at);
            }
        }
    }
    joints
}

/// Rotation from the facing direction to +z in each frame; the identity in frame 0.
pub fn headings(joints: &[f64], skeleton: &Skeleton, smooth: bool) -> Vec<Quat> {
    let mut forward: Vec<Vec3> = joints
        .chunks_exact(3 * skeleton.joints)
        .map(|frame| {
            let [r_hip, l_hip, r_shoulder, l_shoulder] = skeleton.face.map(|j| joint(frame, j));
            // The hips have the opposite sign of the shoulders, as in the published data.
            let across = quat::add(quat::sub(l_hip, r_hip), quat::sub(r_shoulder, l_shoulder));
            quat::cross([0.0, 1.0, 0.0], quat::unit(across))
        })
        .collect();
    if smooth {
        forward = gaussian_filter(&forward, HEADING_SIGMA);
    }
    let mut headings: Vec<Quat> = forward.into_iter().map(|f| quat::between(quat::unit(f), [0.0, 0.0, 1.0])).collect();
    if let Some(first) = headings.first_mut() {
        *first = quat::IDENTITY;
    }
    headings
}

/// A Gaussian filter over time that repeats the values at both ends; the kernel covers four standard deviations.
pub fn gaussian_filter<const N: usize>(track: &[[f64; N]], sigma: f64) -> Vec<[f64; N]> {
    let radius = (4.0 * sigma + 0.5) as i64;
    let weights: Vec<f64> = (-radius..=radius).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
    let total: f64 = weights.iter().sum();
    let last = track.len() as i64 - 1;
    (0..=last)
        .map(|t| {
            let mut sum = [0.0; N];
            for (k, weight) in (-radius..=radius).zip(&weights) {
                let value = &track[(t + k).clamp(0, last) as usize];
                for (s, v) in sum.iter_mut().zip(value) {
                    *s += weight / total * v;
                }
            }
            sum
        })
        .collect()
}

/// Positions relative to the root's ground point, in the heading frame, `[T, J, 3]`; the root keeps its height.
pub fn local_positions(placed: &[f64], headings: &[Quat], skeleton: &Skeleton) -> Vec<f64> {
    let frames = placed.chunks_exact(3 * skeleton.joints).zip(headings);
    frames
        .flat_map(|(frame, heading)| {
            let ground = [frame[0], 0.0, frame[2]];
            (0..skeleton.joints).flat_map(move |j| quat::rotate(*heading, quat::sub(joint(frame, j), ground)))
        })
        .collect()
}

/// Feature rows `[T - 1, D]` of a motion from [`place`]. Undefined values are NaN.
pub fn rows(placed: &[f64], skeleton: &Skeleton, turns: Turns) -> Vec<f32> {
    let width = 3 * skeleton.joints;
    let frames: Vec<&[f64]> = placed.chunks_exact(width).collect();
    let rotations = inverse_kinematics(placed, skeleton, true);
    let rotations: Vec<&[Quat]> = rotations.chunks_exact(skeleton.joints).collect();
    let headings: Vec<Quat> = rotations.iter().map(|r| r[0]).collect();
    let local = local_positions(placed, &headings, skeleton);
    let mut rows = Vec::with_capacity(frames.len() * skeleton.features);
    for t in 0..frames.len().saturating_sub(1) {
        let moved = |j: usize| quat::sub(joint(frames[t + 1], j), joint(frames[t], j));
        let mut turn = quat::mul(headings[t + 1], quat::inverse(headings[t]));
        if turns == Turns::Continuous && turn[0] < 0.0 {
            turn = turn.map(|v| -v);
        }
        let velocity = quat::rotate(headings[t + 1], moved(0));
        let here = &local[t * width..(t + 1) * width];
        rows.extend([turn[2].clamp(-1.0, 1.0).asin(), velocity[0], velocity[2], here[1]].map(|v| v as f32));
        rows.extend(here[3..].iter().map(|v| *v as f32));
        rows.extend(rotations[t][1..].iter().flat_map(|q| quat::to_6d(*q)).map(|v| v as f32));
        rows.extend((0..skeleton.joints).flat_map(|j| quat::rotate(headings[t], moved(j))).map(|v| v as f32));
        for j in skeleton.left_foot.into_iter().chain(skeleton.right_foot) {
            let step = moved(j);
            rows.push(f32::from(u8::from(quat::dot(step, step) < skeleton.contact_threshold)));
        }
    }
    rows
}
