//! A weighted sum of the distances of two tensors, in one pass.

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::fused;

/// Distance of two numbers with difference `d`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pointwise {
    /// `d^2 / 2` up to 1, `|d| - 1/2` beyond.
    SmoothL1,
    /// Absolute error, `|d|`.
    L1,
    /// Squared error, `d^2`.
    L2,
}

impl Pointwise {
    pub(crate) fn of(self, difference: Tensor<3>) -> Tensor<3> {
        match self {
            Self::SmoothL1 => {
                let d = difference.abs();
                let m = d.clone().clamp_max(1.0);
                m.clone() * (d - m * 0.5)
            }
            Self::L1 => difference.abs(),
            Self::L2 => difference.square(),
        }
    }
}

/// The sum over all elements of `found` and `expected` [B, T, width] of their distance times `weights` [B, T, 1].
pub fn weighted_distance(distance: Pointwise, found: Tensor<3>, expected: Tensor<3>, weights: Tensor<3>) -> Tensor<1> {
    #[cfg(feature = "flex")]
    if fused::takes(&found) {
        return fused::run(kernel::Distance(distance), [found.into(), expected.into(), weights.into()]);
    }
    (distance.of(found - expected) * weights).sum()
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use super::Pointwise;
    use crate::kernels::fused::{Fused, make, shape, slice};
    use crate::kernels::simd::{Lanes, multiversion, sum};

    #[derive(Debug, Clone)]
    pub(super) struct Distance(pub(super) Pointwise);

    multiversion! {
        /// Rows are summed in f32 lanes, and their weighted sums in f64.
        fn total<const SET>(distance: Pointwise, found: &[f32], expected: &[f32], weights: &[f32]) -> f64 {
            let width = found.len() / weights.len().max(1);
            let mut total = 0.0;
            for (i, weight) in weights.iter().enumerate() {
                let a = &found[i * width..][..width];
                let b = &expected[i * width..][..width];
                let row = match distance {
                    Pointwise::SmoothL1 => sum::<SET, 2>([a, b], |[a, b]| {
                        let d = (a - b).abs();
                        let m = d.min(Lanes::splat(1.0));
                        m * (d - m * Lanes::splat(0.5))
                    }),
                    Pointwise::L1 => sum::<SET, 2>([a, b], |[a, b]| (a - b).abs()),
                    Pointwise::L2 => sum::<SET, 2>([a, b], |[a, b]| (a - b) * (a - b)),
                };
                total += f64::from(*weight) * f64::from(row);
            }
            total
        }
    }

    multiversion! {
        /// The slope at every difference times its row's weight and `scale`.
        fn slopes(distance: Pointwise, found: &[f32], expected: &[f32], weights: &[f32], scale: f32, out: &mut [f32]) {
            let width = found.len() / weights.len().max(1);
            for (row, weight) in weights.iter().enumerate() {
                let a = &found[row * width..][..width];
                let b = &expected[row * width..][..width];
                let out = &mut out[row * width..][..width];
                let factor = weight * scale;
                match distance {
                    Pointwise::SmoothL1 => {
                        for i in 0..width {
                            out[i] = factor * (a[i] - b[i]).clamp(-1.0, 1.0);
                        }
                    }
                    Pointwise::L1 => {
                        for i in 0..width {
                            let d = a[i] - b[i];
                            out[i] = if d > 0.0 { factor } else if d < 0.0 { -factor } else { 0.0 };
                        }
                    }
                    Pointwise::L2 => {
                        for i in 0..width {
                            out[i] = factor * 2.0 * (a[i] - b[i]);
                        }
                    }
                }
            }
        }
    }

    impl Fused<3> for Distance {
        type Kept = [FlexTensor; 3];

        fn forward(&self, inputs: [FlexTensor; 3]) -> (FlexTensor, Self::Kept) {
            let [found, expected, weights] = inputs.each_ref().map(slice);
            #[expect(clippy::cast_possible_truncation, reason = "losses are f32")]
            let total = total(self.0, found, expected, weights) as f32;
            (make(vec![total], &[1]), inputs)
        }

        /// # Panics
        /// If a gradient of the weights is wanted.
        fn backward(&self, kept: Self::Kept, dy: FlexTensor, wanted: [bool; 3]) -> [Option<FlexTensor>; 3] {
            assert!(!wanted[2], "the weights of a distance are constants");
            let [found, expected, weights] = kept.each_ref().map(slice);
            let gradient = |scale: f32| {
                let mut out = vec![0.0; found.len()];
                slopes(self.0, found, expected, weights, scale, &mut out);
                make(out, &shape(&kept[0]))
            };
            let dy = slice(&dy)[0];
            [wanted[0].then(|| gradient(dy)), wanted[1].then(|| gradient(-dy)), None]
        }
    }
}
