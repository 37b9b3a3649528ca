//! The root mean square norm of channels (Zhang and Sennrich, arXiv:1910.07467, with a learned gain), alone and before a
//! SiLU, `x / (1 + e^-x)`.

use burn::tensor::Tensor;
use burn::tensor::activation::silu;

#[cfg(feature = "flex")]
use super::fused;

/// Lower limit of a norm used as a divisor.
const LEAST: f32 = 1e-12;

/// Scales rows of `x_btc` [B, T, C] to a root mean square of 1, then by `gain` [C].
pub fn rms_norm(x_btc: Tensor<3>, gain: Tensor<1>) -> Tensor<3> {
    let width = x_btc.dims()[2];
    let norm = x_btc.clone().square().sum_dim(2).sqrt().clamp_min(LEAST);
    x_btc / norm * gain.reshape([1, 1, width]) * (width as f32).sqrt()
}

/// SiLU of `n (1 + scale) + shift` with `n` the [`rms_norm`] of `x_btc` [B, T, C]. `change` [B, 2 C] holds scale and shift
/// of each sequence; without it they are 0.
pub fn rms_norm_silu(x_btc: Tensor<3>, gain: Tensor<1>, change: Option<Tensor<2>>) -> Tensor<3> {
    let [batch, _, width] = x_btc.dims();
    assert!(change.as_ref().is_none_or(|change| change.dims() == [batch, 2 * width]), "a scale and a shift a channel");
    #[cfg(feature = "flex")]
    if fused::takes(&x_btc) {
        return match change {
            Some(change) => fused::run(kernel::NormSilu, [x_btc.into(), gain.into(), change.into()]),
            None => fused::run(kernel::NormSilu, [x_btc.into(), gain.into()]),
        };
    }
    let normed = rms_norm(x_btc, gain);
    let Some(change) = change else { return silu(normed) };
    let part = |at: usize| change.clone().slice([0..batch, at..at + width]).reshape([batch, 1, width]);
    silu(normed * (part(0) + 1.0) + part(width))
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use super::LEAST;
    use crate::kernels::fused::{Fused, make, overwrite, shape, slice};
    use crate::kernels::simd::{Lanes, multiversion, sum, update};

    /// SiLU after a norm, with scale and shift if there are three inputs.
    #[derive(Debug, Clone)]
    pub(super) struct NormSilu;

    /// Operands; `change` is empty without scale and shift.
    struct Operands<'a> {
        x: &'a [f32],
        gain: &'a [f32],
        change: &'a [f32],
        /// Rows of one sequence.
        frames: usize,
    }

    /// Gradients of the operands besides `x`, to which the backward pass adds.
    struct Sums<'a> {
        gain: &'a mut [f32],
        change: &'a mut [f32],
    }

    /// The Euclidean norm of a row.
    #[inline(always)]
    fn norm<const SET: u8>(row: &[f32]) -> f32 {
        sum::<SET, 1>([row], |[x]| x * x).sqrt()
    }

    multiversion! {
        fn value<const SET>(of: &Operands<'_>) -> Vec<f32> {
            let width = of.gain.len();
            let root = (width as f32).sqrt();
            let mut y = of.x.to_vec();
            for (row, y) in y.chunks_exact_mut(width).enumerate() {
                let by = root / norm::<SET>(y).max(LEAST);
                let by = Lanes::splat(by);
                update::<SET, 1>(y, [of.gain], |y, [g]| y * by * g);
                if !of.change.is_empty() {
                    let (scale, shift) = of.change[row / of.frames * 2 * width..][..2 * width].split_at(width);
                    update::<SET, 2>(y, [scale, shift], |z, [scale, shift]| z * (Lanes::splat(1.0) + scale) + shift);
                }
                update::<SET, 0>(y, [], |z, []| z * z.logistic());
            }
            y
        }
    }

    multiversion! {
        /// Replaces `dy` by the gradient of x.
        fn slopes<const SET>(of: &Operands<'_>, dy: &mut [f32], sums: &mut Sums<'_>) {
            let width = of.gain.len();
            let root = (width as f32).sqrt();
            let gain = &of.gain[..width];
            let dgain = &mut sums.gain[..width];
            // Without scale and shift these stay 0 and their sums are not used.
            let none = vec![0.0; 2 * width];
            let mut unused = vec![0.0; 2 * width];
            // The slope of SiLU at the elements of a row.
            let mut slope = vec![0.0; width];
            for (row, (x, dy)) in of.x.chunks_exact(width).zip(dy.chunks_exact_mut(width)).enumerate() {
                let norm = norm::<SET>(x);
                let by = 1.0 / norm.max(LEAST);
                let at = row / of.frames * 2 * width;
                let change = if of.change.is_empty() { &none } else { &of.change[at..at + 2 * width] };
                let dchange = if of.change.is_empty() { &mut unused } else { &mut sums.change[at..at + 2 * width] };
                let (scale, shift) = change.split_at(width);
                let (dscale, dshift) = dchange.split_at_mut(width);
                let one = Lanes::splat(1.0);
                let length = Lanes::splat(by * root);
                update::<SET, 4>(&mut slope, [x, gain, scale, shift], |_, [x, g, scale, shift]| {
                    let z = x * length * g * (one + scale) + shift;
                    let s = z.logistic();
                    s + z * s * (one - s)
                });
                for i in 0..width {
                    let unit = x[i] * by * root;
                    let n = unit * gain[i];
                    let dz = dy[i] * slope[i];
                    dscale[i] += dz * n;
                    dshift[i] += dz;
                    let dn = dz * (1.0 + scale[i]);
                    dgain[i] += dn * unit;
                    dy[i] = dn * gain[i] * root;
                }
                // A row of zeros is divided by a constant, which has no gradient.
                let along = if norm > LEAST { sum::<SET, 2>([dy, x], |[dy, x]| dy * x) * by } else { 0.0 };
                for i in 0..width {
                    dy[i] = by * (dy[i] - x[i] * by * along);
                }
            }
        }
    }

    fn gradients(of: &Operands<'_>, dy: FlexTensor) -> (FlexTensor, FlexTensor, Vec<f32>) {
        let mut gain = vec![0.0; of.gain.len()];
        let mut change = vec![0.0; of.change.len()];
        let dx = overwrite(dy, |dy| slopes(of, dy, &mut Sums { gain: &mut gain, change: &mut change }));
        let width = gain.len();
        (dx, make(gain, &[width]), change)
    }

    impl Fused<2> for NormSilu {
        type Kept = [FlexTensor; 2];

        fn forward(&self, kept: [FlexTensor; 2]) -> (FlexTensor, Self::Kept) {
            let [x, gain] = &kept;
            let of = Operands { x: slice(x), gain: slice(gain), change: &[], frames: shape(x)[1] };
            (make(value(&of), &shape(x)), kept)
        }

        fn backward(&self, [x, gain]: Self::Kept, dy: FlexTensor, _: [bool; 2]) -> [Option<FlexTensor>; 2] {
            let of = Operands { x: slice(&x), gain: slice(&gain), change: &[], frames: shape(&x)[1] };
            let (dx, dgain, _) = gradients(&of, dy);
            [Some(dx), Some(dgain)]
        }
    }

    impl Fused<3> for NormSilu {
        type Kept = [FlexTensor; 3];

        fn forward(&self, kept: [FlexTensor; 3]) -> (FlexTensor, Self::Kept) {
            let [x, gain, change] = &kept;
            let of = Operands { x: slice(x), gain: slice(gain), change: slice(change), frames: shape(x)[1] };
            (make(value(&of), &shape(x)), kept)
        }

        fn backward(&self, [x, gain, change]: Self::Kept, dy: FlexTensor, _: [bool; 3]) -> [Option<FlexTensor>; 3] {
            let of = Operands { x: slice(&x), gain: slice(&gain), change: slice(&change), frames: shape(&x)[1] };
            let (dx, dgain, dchange) = gradients(&of, dy);
            [Some(dx), Some(dgain), Some(make(dchange, &shape(&change)))]
        }
    }
}
