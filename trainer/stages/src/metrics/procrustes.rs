//! MPJPE after each frame's best similarity (scale, rotation, shift), and the error of accelerations.
//!
//! Source: the reconstruction protocol of MLD (PA-MPJPE, ACCEL). The alignment is that of Kabsch and Umeyama, computed
//! from the singular values of the cross-covariance, without reflections. Errors are in the unit of the input; the
//! caller averages over frames.

use nalgebra::{Matrix3, Vector3};

const AXES: usize = 3;

/// Mean distance per joint of each frame after aligning `guess` to `truth`, `[frames, joints, 3]` both.
pub fn aligned(truth: &[f64], guess: &[f64], joints: usize) -> Vec<f64> {
    assert_eq!(truth.len(), guess.len(), "motions of one length are compared");
    let width = joints * AXES;
    truth.chunks_exact(width).zip(guess.chunks_exact(width)).map(|(a, b)| frame(a, b)).collect()
}

fn points(frame: &[f64]) -> (Vector3<f64>, Vec<Vector3<f64>>) {
    let points: Vec<Vector3<f64>> = frame.chunks_exact(AXES).map(Vector3::from_column_slice).collect();
    let mean = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    (mean, points.into_iter().map(|p| p - mean).collect())
}

fn frame(truth: &[f64], guess: &[f64]) -> f64 {
    let ((_, truth), (_, guess)) = (points(truth), points(guess));
    let cross: Matrix3<f64> = truth.iter().zip(&guess).map(|(t, g)| t * g.transpose()).sum();
    let spread: f64 = guess.iter().map(Vector3::norm_squared).sum();
    let svd = cross.svd(true, true);
    let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { unreachable!("both factors were asked for") };
    let mut signs = Vector3::repeat(1.0);
    if (u * vt).determinant() < 0.0 {
        // The direction of the smallest singular value is flipped, so that a mirror image does not match.
        signs[svd.singular_values.imin()] = -1.0;
    }
    let rotation = u * Matrix3::from_diagonal(&signs) * vt;
    let scale = if spread > 0.0 { svd.singular_values.dot(&signs) / spread } else { 1.0 };
    let distance = |(t, g): (&Vector3<f64>, &Vector3<f64>)| (t - rotation * g * scale).norm();
    truth.iter().zip(&guess).map(distance).sum::<f64>() / truth.len() as f64
}

/// Mean over joints of the distance of accelerations `x[t] - 2 x[t+1] + x[t+2]`, per inner frame.
pub fn acceleration(truth: &[f64], guess: &[f64], joints: usize) -> Vec<f64> {
    assert_eq!(truth.len(), guess.len(), "motions of one length are compared");
    let width = joints * AXES;
    let frames = truth.len() / width;
    let second =
        |x: &[f64], t: usize, k: usize| x[t * width + k] - 2.0 * x[(t + 1) * width + k] + x[(t + 2) * width + k];
    let off = |t: usize, k: usize| second(truth, t, k) - second(guess, t, k);
    let joint = |t: usize, j: usize| (0..AXES).map(|axis| off(t, j * AXES + axis).powi(2)).sum::<f64>().sqrt();
    (0..frames.saturating_sub(2)).map(|t| (0..joints).map(|j| joint(t, j)).sum::<f64>() / joints as f64).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;

    fn body() -> Vec<f64> {
        (0..3 * 7 * 3).map(|i| ((i * 37 % 23) as f64 * 0.41).sin()).collect()
    }

    fn moved(body: &[f64], by: impl Fn(Vector3<f64>) -> Vector3<f64>) -> Vec<f64> {
        body.chunks_exact(3).flat_map(|p| by(Vector3::from_column_slice(p)).as_slice().to_vec()).collect()
    }

    #[test]
    fn a_similarity_is_no_error_and_a_mirror_image_is_one() {
        let truth = body();
        let turn = Rotation3::from_euler_angles(0.3, -1.2, 2.0);
        let similar = moved(&truth, |p| turn * p * 1.7 + Vector3::new(3.0, -1.0, 0.5));
        assert!(aligned(&truth, &similar, 7).iter().all(|e| *e < 1e-12));
        let mirrored = moved(&truth, |p| Vector3::new(-p.x, p.y, p.z));
        assert!(aligned(&truth, &mirrored, 7).iter().all(|e| *e > 0.1));
        // Moving one of seven joints by d costs more than nothing and less than d / 7 after alignment.
        let mut one = truth.clone();
        one[4] += 0.07;
        let error = aligned(&truth, &one, 7);
        assert!(error[0] > 1e-3 && error[0] < 0.02 && error[1] < 1e-12, "{error:?}");
    }

    #[test]
    fn drift_at_a_constant_speed_is_no_error_of_acceleration() {
        let truth = body();
        let drift: Vec<f64> = truth.iter().enumerate().map(|(i, v)| v + (i / 21) as f64 * 0.2).collect();
        assert!(acceleration(&truth, &drift, 7)[0] < 1e-12);
        let mut jump = truth.clone();
        jump[21] += 1.0;
        assert!((acceleration(&truth, &jump, 7)[0] - 2.0 / 7.0).abs() < 1e-12);
    }
}
