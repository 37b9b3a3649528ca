//! Reconstruction loss of a VAE: errors of one clip, and their summary over clips.
//!
//! Source: the VAE protocol of MotionLCM and MLD, sJPE of DisCoRD. MPJPE is a mean over all frames of all clips, pelvis
//! at the origin. PA-MPJPE is the same after each frame's best similarity. The error of accelerations, in world
//! coordinates, is a mean over all frames but two of each clip. The feature error is the sum over clips of the
//! Frobenius norm of the normalised difference, divided by the number of frames; it is not a mean per frame. Smooth L1
//! is a mean over all values of all clips; the VAE's loss instead weighs clips equally. sJPE with its parts and
//! the physics are means over clips. A clip of fewer than 4 frames has no jerk and is left out.

use std::collections::BTreeMap;

use motion::Skeleton;
use motion::features::{recover_joints, recover_joints_wide};
use protocol::stage::PHYSICS;
use serde::{Deserialize, Serialize};

use super::jerk::{JerkError, jerk, joints_of};
use super::physics::{mean_physics, physics};
use super::{joints, procrustes};

/// Jerk of a joint at rest in m/s^3, that of waves of some hundredths of a millimetre at 20 frames a second.
const STILL: f64 = 1.0;

/// Errors of one clip, summed over its frames, in the unit of the data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ClipErrors {
    /// Number of frames.
    pub frames: usize,
    /// Sum of MPJPE over the frames, pelvis at the origin.
    pub aligned: f64,
    /// The same after each frame's best scale, rotation and shift.
    pub similar: f64,
    /// The same with the body also facing its heading in each frame: the posture alone.
    pub local: f64,
    /// The same in world coordinates, drift included.
    pub global: f64,
    /// Error of accelerations, summed over all frames but two.
    pub acceleration: f64,
    /// Frobenius norm of the difference of the normalised features.
    pub feature_distance: f64,
    /// Smooth-L1 of the normalised features, mean over the clip.
    pub smooth_l1: f64,
    /// Parts of sJPE; `None` for fewer than 4 frames.
    pub jerk: Option<ClipJerk>,
    /// [`physics`] of the guess.
    pub physics: [f64; PHYSICS.len()],
}

/// Parts of sJPE of one clip.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ClipJerk {
    /// Part where the guess shakes more than the truth.
    pub noise: f64,
    /// Part where the guess is smoother than the truth.
    pub statics: f64,
}

impl ClipErrors {
    /// Compares a clip with its reconstruction; both are rows `[L, D]` of normalised features.
    pub fn between(truth: &[f32], guess: &[f32], mean: &[f32], std: &[f32], skeleton: &Skeleton) -> Self {
        let truth_natural = natural(truth, mean, std);
        let guess_natural = natural(guess, mean, std);
        let a = recover_joints(&truth_natural, skeleton);
        let b = recover_joints(&guess_natural, skeleton);
        let (a_wide, b_wide) =
            (recover_joints_wide(&truth_natural, skeleton), recover_joints_wide(&guess_natural, skeleton));
        let posture = |rows: &[f32]| joints::posture(rows, skeleton.features, skeleton.joints);
        let sum = |frames: Vec<f64>| frames.iter().sum::<f64>();
        Self {
            frames: truth.len() / mean.len(),
            aligned: sum(joints::root_aligned(&a, &b, skeleton.joints)),
            similar: sum(procrustes::aligned(&a_wide, &b_wide, skeleton.joints)),
            local: sum(joints::global(&posture(&truth_natural), &posture(&guess_natural), skeleton.joints)),
            global: sum(joints::global(&a, &b, skeleton.joints)),
            acceleration: sum(procrustes::acceleration(&a_wide, &b_wide, skeleton.joints)),
            feature_distance: joints::feature_distance(truth, guess),
            smooth_l1: joints::smooth_l1(truth, guess),
            jerk: clip_jerk(&a_wide, &b_wide, skeleton),
            physics: physics(&in_metres(b_wide, skeleton), skeleton),
        }
    }
}

/// Converts features to the data's own scale.
fn natural(rows: &[f32], mean: &[f32], std: &[f32]) -> Vec<f32> {
    let scaled = rows.chunks_exact(mean.len()).flat_map(|row| row.iter().zip(std).zip(mean));
    scaled.map(|((x, s), m)| x * s + m).collect()
}

fn in_metres(mut joints: Vec<f64>, skeleton: &Skeleton) -> Vec<f64> {
    joints.iter_mut().for_each(|v| *v *= skeleton.metres_per_unit);
    joints
}

/// Jerks of the joints that move freely.
fn jerks(joints: &[f64], skeleton: &Skeleton) -> Vec<f64> {
    jerk(&in_metres(joints.to_vec(), skeleton), skeleton.joints, joints_of(skeleton.format), skeleton.fps)
}

fn clip_jerk(truth: &[f64], guess: &[f64], skeleton: &Skeleton) -> Option<ClipJerk> {
    let truth = jerks(truth, skeleton);
    let guess = jerks(guess, skeleton);
    if truth.is_empty() {
        return None;
    }
    let error = JerkError::between(&truth, &guess);
    Some(ClipJerk { noise: error.noise, statics: error.statics })
}

/// [`physics`] of the original clip, rows `[L, D]` of normalised features.
pub fn real_physics(truth: &[f32], mean: &[f32], std: &[f32], skeleton: &Skeleton) -> [f64; PHYSICS.len()] {
    physics(&in_metres(recover_joints_wide(&natural(truth, mean, std), skeleton), skeleton), skeleton)
}

/// Share of the jerks of the original clip, rows `[L, D]` of normalised features, that are below one m/s^3. There sJPE
/// counts any shaking almost whole, however small it is.
pub fn real_still(truth: &[f32], mean: &[f32], std: &[f32], skeleton: &Skeleton) -> Option<f64> {
    let jerks = jerks(&recover_joints_wide(&natural(truth, mean, std), skeleton), skeleton);
    let still = jerks.iter().filter(|jerk| **jerk < STILL).count();
    (!jerks.is_empty()).then(|| still as f64 / jerks.len() as f64)
}

/// Summarises a set of clips as metrics; their names start with `prefix`, distances are in millimetres.
pub fn summary(clips: &[ClipErrors], skeleton: &Skeleton, prefix: &str) -> BTreeMap<String, f64> {
    let frames: usize = clips.iter().map(|c| c.frames).sum();
    let inner: usize = clips.iter().map(|c| c.frames.saturating_sub(2)).sum();
    let sum = |of: fn(&ClipErrors) -> f64| clips.iter().map(of).sum::<f64>();
    let per_frame = |of: fn(&ClipErrors) -> f64| sum(of) / frames as f64;
    let millimetres = 1000.0 * skeleton.metres_per_unit;
    let mut metrics = vec![
        ("mpjpe_mm", per_frame(|c| c.aligned) * millimetres),
        ("pa_mpjpe_mm", per_frame(|c| c.similar) * millimetres),
        ("mpjpe_local_mm", per_frame(|c| c.local) * millimetres),
        ("mpjpe_global_mm", per_frame(|c| c.global) * millimetres),
        ("feature_error", per_frame(|c| c.feature_distance)),
        ("feature_smooth_l1", per_frame(|c| c.smooth_l1 * c.frames as f64)),
    ];
    if inner > 0 {
        metrics.push(("acceleration_mm", sum(|c| c.acceleration) / inner as f64 * millimetres));
    }
    let jerks: Vec<ClipJerk> = clips.iter().filter_map(|c| c.jerk).collect();
    if !jerks.is_empty() {
        let mean = |of: fn(&ClipJerk) -> f64| jerks.iter().map(of).sum::<f64>() / jerks.len() as f64;
        let (noise, statics) = (mean(|j| j.noise), mean(|j| j.statics));
        metrics.extend([("sjpe", noise + statics), ("sjpe_noise", noise), ("sjpe_static", statics)]);
    }
    let physics: Vec<f64> = clips.iter().flat_map(|c| c.physics).collect();
    let all = metrics.into_iter().map(|(name, value)| (name.to_owned(), value)).chain(mean_physics(&physics));
    all.map(|(name, value)| (format!("{prefix}{name}"), value)).collect()
}

#[cfg(test)]
mod tests {
    use motion::Skeleton;
    use protocol::stage::DataFormat;

    use super::*;

    /// Features of a figure at rest whose right wrist (joint 21 of 22, 10 of 21) moves by `wrist(frame)` units upwards.
    fn still(skeleton: &Skeleton, frames: usize, wrist: impl Fn(usize) -> f32) -> Vec<f32> {
        let joint = joints_of(skeleton.format)[joints_of(skeleton.format).len() - 1];
        let mut rows = vec![0.0_f32; frames * skeleton.features];
        for (t, row) in rows.chunks_exact_mut(skeleton.features).enumerate() {
            row[3] = 1.0;
            for (k, value) in row[skeleton.layout().positions].iter_mut().enumerate() {
                *value = (k as f32 * 0.37).sin();
            }
            row[skeleton.layout().positions][3 * (joint - 1) + 1] += wrist(t);
        }
        rows
    }

    #[test]
    fn one_joint_that_jumps_is_counted_as_the_papers_count_it() {
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            let skeleton = Skeleton::of(format);
            let mean = vec![0.0; skeleton.features];
            let std = vec![1.0; skeleton.features];
            let (rest, jump) = (|_: usize| 0.0, |t: usize| if t == 5 { 0.5 } else { 0.0 });
            let errors = |frames: usize, truth: &dyn Fn(usize) -> f32, guess: &dyn Fn(usize) -> f32| {
                let truth = still(skeleton, frames, truth);
                let guess = still(skeleton, frames, guess);
                ClipErrors::between(&truth, &guess, &mean, &std, skeleton)
            };
            let clips = [errors(12, &rest, &jump), errors(20, &rest, &rest), errors(3, &rest, &rest)];
            let found = summary(&clips, skeleton, "mu_");
            let millimetres = 1000.0 * skeleton.metres_per_unit;
            let expect = |name: &str, value: f64| {
                let found = found[&format!("mu_{name}")];
                assert!((found - value).abs() <= 1e-6 * value.abs(), "{format:?} {name}: {found}, expected {value}");
            };
            // 35 frames; second differences are 1, -2 and 1 times the jump, in the 10 + 18 + 1 inner frames.
            expect("mpjpe_mm", 0.5 / skeleton.joints as f64 / 35.0 * millimetres);
            expect("acceleration_mm", 4.0 * 0.5 / skeleton.joints as f64 / 29.0 * millimetres);
            assert!(found["mu_pa_mpjpe_mm"] > 0.0, "a jump of one joint is no similarity");
            let mut larger = still(skeleton, 12, rest);
            for row in larger.chunks_exact_mut(skeleton.features) {
                row[3] *= 1.5;
                row[skeleton.layout().positions].iter_mut().for_each(|v| *v *= 1.5);
            }
            let scaled = ClipErrors::between(&still(skeleton, 12, rest), &larger, &mean, &std, skeleton);
            assert!(scaled.similar < 1e-5 && scaled.aligned > 1.0, "the scale is aligned: {scaled:?}");
            // One joint has jerk in 4 of 9 frames, the truth has none; the clip of 3 frames does not count.
            let share = 4.0 / 9.0 / joints_of(format).len() as f64;
            expect("sjpe_noise", share / 2.0);
            expect("sjpe_static", 0.0);
            expect("sjpe", share / 2.0);
            expect("skating_ratio", 0.0);
            let smooth = summary(&[errors(12, &jump, &rest)], skeleton, "");
            let moved = still(skeleton, 12, jump);
            let at_rest = real_still(&moved, &mean, &std, skeleton).expect("twelve frames have jerks");
            assert!((at_rest - (1.0 - share)).abs() < 1e-9, "{at_rest}");
            assert!((smooth["sjpe_static"] - share).abs() < 1e-6 && smooth["sjpe_noise"] == 0.0, "{smooth:?}");
            let short = summary(&clips[2..], skeleton, "");
            assert!(!short.contains_key("sjpe") && short["acceleration_mm"] == 0.0, "{short:?}");
        }
    }

    #[test]
    fn a_body_dragged_along_the_ground_skates() {
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            let skeleton = Skeleton::of(format);
            let mean = vec![0.0; skeleton.features];
            let std = vec![1.0; skeleton.features];
            let rest = still(skeleton, 21, |_| 0.0);
            let mut dragged = rest.clone();
            for row in dragged.chunks_exact_mut(skeleton.features) {
                // One metre per second, with all joints on the ground.
                row[1] = (1.0 / skeleton.fps / skeleton.metres_per_unit) as f32;
                row[skeleton.layout().positions].fill(0.0);
            }
            let errors = ClipErrors::between(&rest, &dragged, &mean, &std, skeleton);
            assert_eq!(errors.physics[0], 1.0, "{format:?}");
            assert_eq!(real_physics(&dragged, &mean, &std, skeleton)[0], 1.0, "{format:?}");
            assert_eq!(real_physics(&rest, &mean, &std, skeleton)[0], 0.0, "{format:?}");
        }
    }
}
