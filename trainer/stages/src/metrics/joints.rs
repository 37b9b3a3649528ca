//! Errors between a motion and its reconstruction.
//!
//! Source: the protocol of MotionLCM and MLD for VAE reconstruction. All errors are in the unit of their input,
//! averaged over the joints of a frame; the caller averages over frames. Sums are in f64 and in order.

/// Number of coordinates of a joint.
const AXES: usize = 3;

/// Mean distance per joint of each frame, with the pelvis (joint 0) of both motions at the origin: the usual MPJPE.
///
/// `truth` and `guess` are `[frames, joints, 3]`.
pub fn root_aligned(truth: &[f32], guess: &[f32], joints: usize) -> Vec<f64> {
    per_frame(truth, guess, joints, |frame, joint, axis| f64::from(frame[joint * AXES + axis]) - f64::from(frame[axis]))
}

/// Mean distance per joint of each frame in world coordinates, drift included.
pub fn global(truth: &[f32], guess: &[f32], joints: usize) -> Vec<f64> {
    per_frame(truth, guess, joints, |frame, joint, axis| f64::from(frame[joint * AXES + axis]))
}

fn per_frame(truth: &[f32], guess: &[f32], joints: usize, at: impl Fn(&[f32], usize, usize) -> f64) -> Vec<f64> {
    assert_eq!(truth.len(), guess.len(), "motions of one length are compared");
    let width = joints * AXES;
    let distance = |a: &[f32], b: &[f32], joint| {
        (0..AXES).map(|axis| at(a, joint, axis) - at(b, joint, axis)).map(|d| d * d).sum::<f64>().sqrt()
    };
    truth
        .chunks_exact(width)
        .zip(guess.chunks_exact(width))
        .map(|(a, b)| (0..joints).map(|joint| distance(a, b, joint)).sum::<f64>() / joints as f64)
        .collect()
}

/// The posture part of feature vectors: joints in the heading frame with the pelvis at the origin,
/// `[frames, joints, 3]`.
///
/// Channel 3 of a feature vector is the root's height. Channels from 4 on are the other joints' positions, which
/// include that height.
pub fn posture(features: &[f32], width: usize, joints: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(features.len() / width * joints * AXES);
    for frame in features.chunks_exact(width) {
        out.extend([0.0; AXES]);
        for joint in frame[4..4 + (joints - 1) * AXES].chunks_exact(AXES) {
            out.extend([joint[0], joint[1] - frame[3], joint[2]]);
        }
    }
    out
}

/// Frobenius norm of the difference of two feature sequences.
pub fn feature_distance(truth: &[f32], guess: &[f32]) -> f64 {
    truth.iter().zip(guess).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum::<f64>().sqrt()
}

/// Smooth L1 with beta 1, averaged over all values.
pub fn smooth_l1(truth: &[f32], guess: &[f32]) -> f64 {
    let one = |(&a, &b): (&f32, &f32)| {
        let d = (f64::from(a) - f64::from(b)).abs();
        if d < 1.0 { 0.5 * d * d } else { d - 0.5 }
    };
    truth.iter().zip(guess).map(one).sum::<f64>() / truth.len() as f64
}

/// A sequence that repeats the mean over time of `features`, rows of `width`.
pub fn time_mean(features: &[f32], width: usize) -> Vec<f32> {
    let frames = features.len() / width;
    let mut sums = vec![0.0f64; width];
    for frame in features.chunks_exact(width) {
        for (sum, &value) in sums.iter_mut().zip(frame) {
            *sum += f64::from(value);
        }
    }
    let mean: Vec<f32> = sums.iter().map(|sum| (sum / frames as f64) as f32).collect();
    mean.repeat(frames)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shift_of_the_whole_body_is_a_global_error_only() {
        let truth: Vec<f32> = (0..2 * 3 * 3).map(|v| v as f32).collect();
        let guess: Vec<f32> = truth.chunks(3).flat_map(|p| [p[0] + 3.0, p[1], p[2] - 4.0]).collect();
        assert_eq!(root_aligned(&truth, &guess, 3), [0.0, 0.0]);
        assert_eq!(global(&truth, &guess, 3), [5.0, 5.0]);
    }

    #[test]
    fn smooth_l1_is_quadratic_below_one() {
        assert_eq!(smooth_l1(&[0.0, 0.0], &[0.5, -3.0]), (0.125 + 2.5) / 2.0);
    }

    #[test]
    fn the_time_mean_repeats() {
        assert_eq!(time_mean(&[1.0, 2.0, 3.0, 6.0], 2), [2.0, 4.0, 2.0, 4.0]);
    }
}
