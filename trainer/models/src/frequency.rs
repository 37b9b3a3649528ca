//! Frequencies of a motion along time, and the frequency losses of Free-T2M (Chen et al., 2025).
//!
//! The orthonormal cosine transform of n frames has coefficient k at `k fps / (2 n)` Hz; the lowest K coefficients are
//! the slow part of a motion. The transform is linear, so the slow part of a difference is the difference of the slow
//! parts, and one pass is enough. It covers the valid frames of each clip. A [`Stage`] selects the noise levels at
//! which a term acts.
//!
//! Departs: the released code transforms 196 frames for every clip; lengths of 196 for all clips reproduce that. The
//! paper prints no K. The released semantic term has no gradient, because its embeddings are computed without a graph;
//! here the embedding of the prediction has one.
//!
//! As in [`crate::losses`], a term is the sum over examples of per-example values, so that slices add up.

use std::ops::RangeInclusive;

use burn::tensor::{Device, Tensor, TensorData};

use crate::losses::Pointwise;

/// The timesteps at which a term acts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stage(RangeInclusive<usize>);

impl Stage {
    /// Selects these timesteps, both ends included.
    pub fn new(timesteps: RangeInclusive<usize>) -> Self {
        Self(timesteps)
    }

    /// Selects timesteps t of `steps` with `t / steps` in `from..=to`; it scales "30 to 50 of 50" to other numbers of
    /// steps.
    pub fn of_shares(from: f64, to: f64, steps: usize) -> Self {
        let at = |share: f64| share * steps as f64;
        // Rounding may put a product such as .6 times 50 slightly above 30.
        Self((at(from) - 1e-6).ceil().max(0.0) as usize..=(at(to) + 1e-6).floor() as usize)
    }

    /// Returns true if the term acts at `t`.
    pub fn has(&self, t: usize) -> bool {
        self.0.contains(&t)
    }

    /// Returns 1 for each timestep at which the term acts and 0 for the others.
    pub fn mask(&self, timesteps: &[usize]) -> Vec<f32> {
        timesteps.iter().map(|t| if self.has(*t) { 1.0 } else { 0.0 }).collect()
    }
}

/// The first `keep` rows of the orthonormal cosine transform of `length` frames, [keep, frames]. Columns past the
/// length are zero, and so are rows past `length`.
fn basis(length: usize, frames: usize, keep: usize) -> Vec<f32> {
    let n = length as f64;
    let value = |k: usize, i: usize| {
        if k >= length || i >= length {
            return 0.0;
        }
        let scale = if k == 0 { (1.0 / n).sqrt() } else { (2.0 / n).sqrt() };
        let angle = std::f64::consts::PI * (2 * i + 1) as f64 * k as f64 / (2.0 * n);
        (scale * angle.cos()) as f32
    };
    (0..keep).flat_map(|k| (0..frames).map(move |i| value(k, i))).collect()
}

/// Transforms [B, keep, T] of clips with these lengths.
fn bases(lengths: &[usize], frames: usize, keep: usize, device: &Device) -> Tensor<3> {
    let values = lengths.iter().flat_map(|length| basis(*length, frames, keep)).collect();
    Tensor::from_data(TensorData::new(values, [lengths.len(), keep, frames]), device)
}

/// The lowest `keep` coefficients of the cosine transform of `x_btd` [B, T, D] along time, [B, keep, D]. The transform
/// of clip b covers its first `lengths[b]` frames.
pub fn coefficients(x_btd: Tensor<3>, lengths: &[usize], keep: usize) -> Tensor<3> {
    let frames = x_btd.dims()[1];
    bases(lengths, frames, keep, &x_btd.device()).matmul(x_btd)
}

/// The part of `x_btd` [B, T, D] in its lowest `keep` coefficients; zero past a clip's length.
pub fn low_pass(x_btd: Tensor<3>, lengths: &[usize], keep: usize) -> Tensor<3> {
    let frames = x_btd.dims()[1];
    let basis = bases(lengths, frames, keep, &x_btd.device());
    basis.clone().swap_dims(1, 2).matmul(basis.matmul(x_btd))
}

/// Distance between the slow parts of `found` and `expected` [B, T, D]: the mean over a clip's frames and features,
/// times `weights[b]`, summed over clips.
pub fn low_frequency(
    found: Tensor<3>,
    expected: Tensor<3>,
    lengths: &[usize],
    keep: usize,
    distance: Pointwise,
    weights: &[f32],
) -> Tensor<1> {
    weighted(low_pass(found - expected, lengths, keep), lengths, distance, weights)
}

/// The same distance between the fast parts: all coefficients but the lowest `keep`.
pub fn high_frequency(
    found: Tensor<3>,
    expected: Tensor<3>,
    lengths: &[usize],
    keep: usize,
    distance: Pointwise,
    weights: &[f32],
) -> Tensor<1> {
    let difference = found - expected;
    let frames = difference.dims()[1];
    let fast = low_pass(difference.clone(), lengths, frames) - low_pass(difference, lengths, keep);
    weighted(fast, lengths, distance, weights)
}

/// Distance of `difference_btd` from zero: the mean over a clip's frames and features, times `weights[b]`, summed.
fn weighted(difference_btd: Tensor<3>, lengths: &[usize], distance: Pointwise, weights: &[f32]) -> Tensor<1> {
    let [batch, _, width] = difference_btd.dims();
    let device = difference_btd.device();
    let each = weights.iter().zip(lengths).map(|(weight, length)| weight / (length * width) as f32).collect();
    let each = Tensor::<3>::from_data(TensorData::new(each, [batch, 1, 1]), &device);
    (distance.of(difference_btd) * each).sum()
}

/// The loss of the cosine S of two embeddings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Agreement {
    /// `1 - S`: a gradient everywhere, as in the released code.
    Cosine,
    /// `max(0, threshold - S)`: a gradient only below the threshold.
    Below(f64),
}

/// Cosines [B] of rows [B, E]. As in PyTorch, a norm below 1e-8 counts as 1e-8.
pub fn cosines(a_be: Tensor<2>, b_be: Tensor<2>) -> Tensor<1> {
    let batch = a_be.dims()[0];
    let norm = |x: &Tensor<2>| x.clone().square().sum_dim(1).clamp_min(1e-16).sqrt();
    let norms = norm(&a_be) * norm(&b_be);
    ((a_be * b_be).sum_dim(1) / norms).reshape([batch])
}

/// Disagreement of the embeddings of predictions with those of their targets [B, E], times `weights[b]`, summed.
pub fn semantic(found_be: Tensor<2>, expected_be: Tensor<2>, agreement: Agreement, weights: &[f32]) -> Tensor<1> {
    let device = found_be.device();
    let s = cosines(found_be, expected_be);
    let each = match agreement {
        Agreement::Cosine => s.neg() + 1.0,
        Agreement::Below(threshold) => (s.neg() + threshold as f32).clamp_min(0.0),
    };
    let weights = Tensor::<1>::from_data(TensorData::new(weights.to_vec(), [weights.len()]), &device);
    (each * weights).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn column(values: &[f32], device: &Device) -> Tensor<3> {
        Tensor::from_data(TensorData::new(values.to_vec(), [1, values.len(), 1]), device)
    }

    fn close(found: Tensor<3>, expected: &[f32]) {
        let found = found.into_data().try_into_vec::<f32>().unwrap();
        assert_eq!(found.len(), expected.len());
        for (f, e) in found.iter().zip(expected) {
            assert!((f - e).abs() < 2e-5, "{found:?} instead of {expected:?}");
        }
    }

    const X: [f32; 8] = [1.0, 2.0, 4.0, 7.0, 3.0, 0.0, -1.0, 2.0];

    #[test]
    fn the_transform_is_the_orthonormal_cosine_transform() {
        let x = column(&X, &Device::flex());
        let all = [6.363_961, 2.258_133, -3.807_604, -3.781_081, 2.828_427, 0.304_157, 0.046_427, -1.229_532];
        close(coefficients(x.clone(), &[8], 8), &all);
        close(low_pass(x.clone(), &[8], 1), &[2.25; 8]);
        let three = [1.598_488, 2.460_231, 3.605_829, 4.229_153, 3.788_614, 2.351_278, 0.582_662, -0.616_255];
        close(low_pass(x.clone(), &[8], 3), &three);
        close(low_pass(x.clone(), &[8], 8), &X);
        // Three frames have three coefficients; the frames after them have no effect.
        close(low_pass(x, &[3], 5), &[1.0, 2.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn slow_and_fast_parts_share_the_whole_difference() {
        let device = Device::flex();
        let (x, zero) = (column(&X, &device), column(&[0.0; 8], &device));
        let slow = |length, keep| {
            low_frequency(x.clone(), zero.clone(), &[length], keep, Pointwise::L2, &[1.0]).into_scalar::<f32>()
        };
        let fast = |length, keep| {
            high_frequency(x.clone(), zero.clone(), &[length], keep, Pointwise::L2, &[1.0]).into_scalar::<f32>()
        };
        for length in [8, 5] {
            // The transform keeps lengths, so squares of the coefficients add up to those of the frames.
            let whole: f32 = X[..length].iter().map(|x| x * x).sum::<f32>() / length as f32;
            let sum = slow(length, 3) + fast(length, 3);
            assert!((sum - whole).abs() < 1e-4, "{sum} instead of {whole}");
            assert!(fast(length, length) < 1e-6);
        }
        // Coefficients 1 to 7 of the test above.
        let squares: f32 = [2.258_133_f32, -3.807_604, -3.781_081, 2.828_427, 0.304_157, 0.046_427, -1.229_532]
            .iter()
            .map(|c| c * c)
            .sum();
        assert!((fast(8, 1) - squares / 8.0).abs() < 1e-4);
    }

    #[test]
    fn stages_are_those_of_the_released_code_at_its_step_counts() {
        let low = Stage::of_shares(0.6, 1.0, 50);
        let semantic = Stage::of_shares(0.0, 0.4, 50);
        assert_eq!([29, 30, 49].map(|t| low.has(t)), [false, true, true]);
        assert_eq!([0, 20, 21].map(|t| semantic.has(t)), [true, true, false]);
        let low = Stage::of_shares(0.0, 0.3, 1000);
        assert_eq!(low.mask(&[0, 300, 301]), [1.0, 1.0, 0.0]);
    }

    #[test]
    fn a_threshold_lets_go_above_it() {
        let device = Device::flex();
        let row = |x: [f32; 2]| Tensor::<2>::from_floats([x], &device);
        let loss = |found, agreement| semantic(row(found), row([1.0, 0.0]), agreement, &[2.0]).into_scalar::<f32>();
        assert!((loss([3.0, 0.0], Agreement::Cosine)).abs() < 1e-6);
        assert!((loss([0.0, 3.0], Agreement::Cosine) - 2.0).abs() < 1e-6);
        assert_eq!(loss([3.0, 4.0], Agreement::Below(0.5)), 0.0);
        assert!((loss([3.0, 4.0], Agreement::Below(0.7)) - 0.2).abs() < 1e-6);
    }
}
