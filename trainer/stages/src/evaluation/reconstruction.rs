//! What a VAE loses: errors of one clip, and their summary over clips.
//!
//! Source: the VAE protocol of MotionLCM and MLD. MPJPE is a mean over all frames of all clips, pelvis at the origin. The feature error
//! is the sum over clips of the Frobenius norm of the normalised difference, divided by the number of frames; it is not a mean per
//! frame. Smooth-L1 is a mean over all values of all clips (the VAE's loss instead weighs clips
//! equally).

use std::collections::BTreeMap;

use motion::Skeleton;
use motion::features::recover_joints;
use serde::{Deserialize, Serialize};

use super::joints;

/// Errors of one clip, summed over its frames, in the unit of the data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ClipErrors {
    /// Frames.
    pub frames: usize,
    /// Pelvis at the origin, in each frame.
    pub aligned: f64,
    /// Pelvis at the origin and the body facing its heading, in each frame: the posture alone.
    pub local: f64,
    /// As they lie in the world, drift included.
    pub global: f64,
    /// Frobenius norm of the difference of the normalised features.
    pub feature_distance: f64,
    /// Smooth-L1 of the normalised features, mean over the clip.
    pub smooth_l1: f64,
}

impl ClipErrors {
    /// Compares a clip with a guess at it; both are rows `[L, D]` of normalised features.
    pub fn between(truth: &[f32], guess: &[f32], mean: &[f32], std: &[f32], skeleton: &Skeleton) -> Self {
        let natural = |rows: &[f32]| -> Vec<f32> {
            let scaled = rows.chunks_exact(mean.len()).flat_map(|row| row.iter().zip(std).zip(mean));
            scaled.map(|((x, s), m)| x * s + m).collect()
        };
        let (truth_natural, guess_natural) = (natural(truth), natural(guess));
        let (a, b) = (recover_joints(&truth_natural, skeleton), recover_joints(&guess_natural, skeleton));
        let posture = |rows: &[f32]| joints::posture(rows, skeleton.features, skeleton.joints);
        let sum = |frames: Vec<f64>| frames.iter().sum::<f64>();
        Self {
            frames: truth.len() / mean.len(),
            aligned: sum(joints::root_aligned(&a, &b, skeleton.joints)),
            local: sum(joints::global(&posture(&truth_natural), &posture(&guess_natural), skeleton.joints)),
            global: sum(joints::global(&a, &b, skeleton.joints)),
            feature_distance: joints::feature_distance(truth, guess),
            smooth_l1: joints::smooth_l1(truth, guess),
        }
    }
}

/// The metrics of a set of clips; names begin with `prefix`, distances are in millimetres.
pub fn summary(clips: &[ClipErrors], skeleton: &Skeleton, prefix: &str) -> BTreeMap<String, f64> {
    let frames: usize = clips.iter().map(|c| c.frames).sum();
    let per_frame = |of: fn(&ClipErrors) -> f64| clips.iter().map(of).sum::<f64>() / frames as f64;
    let millimetres = 1000.0 * skeleton.metres_per_unit;
    [
        ("mpjpe_mm", per_frame(|c| c.aligned) * millimetres),
        ("mpjpe_local_mm", per_frame(|c| c.local) * millimetres),
        ("mpjpe_global_mm", per_frame(|c| c.global) * millimetres),
        ("feature_error", per_frame(|c| c.feature_distance)),
        ("feature_smooth_l1", per_frame(|c| c.smooth_l1 * c.frames as f64)),
    ]
    .into_iter()
    .map(|(name, value)| (format!("{prefix}{name}"), value))
    .collect()
}
