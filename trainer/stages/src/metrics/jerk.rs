//! Symmetric jerk percentage error: measures shaking (noise) and stillness (static) compared with the real motion.
//!
//! Source: DisCoRD (Cho et al., arXiv:2411.19527), sJPE. Jerk is the length of the third difference of a joint's
//! position times fps^3, in m/s^3, of the joints that move freely: feet and wrists. Per frame and joint the error is
//! `(p - g) / (g + p + 1e-6)`: the positive part is noise, the negative static, sJPE their sum. Departs: a mean over
//! joints where the code has a sum (the paper's numbers are such means), and f64 from the positions on, because fps^3
//! magnifies rounding.

use protocol::stage::DataFormat;

const EPS: f64 = 1e-6;
const AXES: usize = 3;

/// Joints that the papers measure: feet and wrists.
pub fn joints_of(format: DataFormat) -> &'static [usize] {
    match format {
        DataFormat::Humanml3d => &[10, 11, 20, 21],
        DataFormat::Kit => &[7, 10],
    }
}

/// Jerks `[frames - 3, joints]` of the joints `of` in a motion `[frames, count, 3]` in metres.
pub fn jerk(motion: &[f64], count: usize, of: &[usize], fps: f64) -> Vec<f64> {
    let frames = motion.len() / (count * AXES);
    let at = |t: usize, j: usize, axis: usize| motion[(t * count + j) * AXES + axis];
    let third = |t: usize, j: usize, axis: usize| {
        at(t + 3, j, axis) - 3.0 * at(t + 2, j, axis) + 3.0 * at(t + 1, j, axis) - at(t, j, axis)
    };
    let length = |t: usize, j: usize| (0..AXES).map(|axis| third(t, j, axis).powi(2)).sum::<f64>().sqrt();
    (0..frames.saturating_sub(3)).flat_map(|t| of.iter().map(move |j| length(t, *j) * fps.powi(3))).collect()
}

/// The parts of sJPE.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JerkError {
    /// Part where the guess is smoother than the truth.
    pub statics: f64,
    /// Part where the guess shakes more than the truth.
    pub noise: f64,
    /// `statics` weighted by jerk: sum of differences over sum of jerks.
    pub weighted_static: f64,
    /// `noise` weighted by jerk: sum of differences over sum of jerks.
    pub weighted_noise: f64,
}

impl JerkError {
    /// Compares jerks of equal shape.
    ///
    /// # Panics
    /// If there are none (a motion needs 4 frames) or their numbers differ.
    pub fn between(truth: &[f64], guess: &[f64]) -> Self {
        assert!(!truth.is_empty() && truth.len() == guess.len(), "jerks of motions of one length, at least 4 frames");
        let mut sums = [0.0; 5];
        for (g, p) in truth.iter().zip(guess) {
            let off = p - g;
            let scale = g + p;
            sums[0] += (-off).max(0.0) / (scale + EPS);
            sums[1] += off.max(0.0) / (scale + EPS);
            sums[2] += (-off).max(0.0);
            sums[3] += off.max(0.0);
            sums[4] += scale;
        }
        let n = truth.len() as f64;
        let weigh = |sum: f64| if sums[4] > 0.0 { sum / sums[4] } else { 0.0 };
        Self {
            statics: sums[0] / n,
            noise: sums[1] / n,
            weighted_static: weigh(sums[2]),
            weighted_noise: weigh(sums[3]),
        }
    }

    /// sJPE, the sum of both parts.
    pub fn total(&self) -> f64 {
        self.statics + self.noise
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worked_example() {
        let truth = |k: usize, half: f64| {
            let t = k as f64 / 20.0;
            [(2.0 * t).sin() * half, (2.0 * t).cos() * half, t / 2.0 * half]
        };
        let real: Vec<f64> = (0..12).flat_map(|k| [truth(k, 1.0), truth(k, 0.5)].concat()).collect();
        let guess: Vec<f64> = (0..12)
            .flat_map(|k| {
                let mut first = truth(k, 1.0);
                first[1] += if k == 5 { 0.01 } else { 0.0 };
                [first, truth(k, 0.25)].concat()
            })
            .collect();
        let real = jerk(&real, 2, &[0, 1], 20.0);
        let guess = jerk(&guess, 2, &[0, 1], 20.0);
        let mean = |j: usize| real.iter().skip(j).step_by(2).sum::<f64>() / 9.0;
        let error = JerkError::between(&real, &guess);
        for (found, expected) in [
            (mean(0), 7.990_005_41),
            (mean(1), 3.995_002_71),
            (error.statics * 2.0, 0.333_333_28),
            (error.noise * 2.0, 0.389_367_12),
            (error.total(), 0.361_350_20),
            (error.weighted_static, 0.022_326_47),
            (error.weighted_noise, 0.754_408_80),
        ] {
            assert!((found - expected).abs() < 1e-7, "{found} against {expected}");
        }
    }
}
