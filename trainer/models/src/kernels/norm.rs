//! Layer normalisation over the last axis (Ba et al., arXiv:1607.06450): alone, after a residual addition, or before a
//! leaky ReLU and a residual addition.

use burn::tensor::Tensor;
use burn::tensor::activation::leaky_relu;

#[cfg(feature = "flex")]
use super::fused;

/// `gamma (x - mean) / sqrt(var + eps) + beta` over the last axis, with the population variance.
pub fn layer_norm<const D: usize>(x: Tensor<D>, gamma: Tensor<1>, beta: Tensor<1>, eps: f64) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        return fused::run(kernel::Norm { eps, slope: 1.0 }, [x.into(), gamma.into(), beta.into()]);
    }
    composed(x, gamma, beta, eps)
}

/// `layer_norm(x + y)`: the residual addition and the norm in one pass.
pub fn add_layer_norm<const D: usize>(
    x: Tensor<D>,
    y: Tensor<D>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    eps: f64,
) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        let norm = kernel::Norm { eps, slope: 1.0 };
        return fused::run(kernel::After(norm), [x.into(), y.into(), gamma.into(), beta.into()]);
    }
    composed(x + y, gamma, beta, eps)
}

/// A leaky ReLU of `layer_norm(x)`, added to `y` if there is one. The ReLU multiplies negative values by `slope`.
pub fn leaky_layer_norm<const D: usize>(
    x: Tensor<D>,
    y: Option<Tensor<D>>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    eps: f64,
    slope: f64,
) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        #[expect(clippy::cast_possible_truncation, reason = "a constant of a network")]
        let norm = kernel::Norm { eps, slope: slope as f32 };
        return match y {
            Some(y) => fused::run(kernel::Before(norm), [x.into(), y.into(), gamma.into(), beta.into()]),
            None => fused::run(norm, [x.into(), gamma.into(), beta.into()]),
        };
    }
    let out = leaky_relu(composed(x, gamma, beta, eps), slope);
    match y {
        Some(y) => y + out,
        None => out,
    }
}

fn composed<const D: usize>(x: Tensor<D>, gamma: Tensor<1>, beta: Tensor<1>, eps: f64) -> Tensor<D> {
    let centred = x.clone() - x.mean_dim(D - 1);
    let variance = centred.clone().powi_scalar(2).mean_dim(D - 1);
    centred / (variance + eps).sqrt() * gamma.unsqueeze() + beta.unsqueeze()
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use crate::kernels::fused::{Fused, make, overwrite, shape, slice};
    use crate::kernels::simd::{Lanes, append, multiversion, sum, update};

    /// The norm of a tensor, and the slope of what follows below 0; 1 is no ReLU.
    #[derive(Debug, Clone)]
    pub(super) struct Norm {
        pub(super) eps: f64,
        pub(super) slope: f32,
    }

    /// The norm of the sum of two tensors.
    #[derive(Debug, Clone)]
    pub(super) struct After(pub(super) Norm);

    /// The norm of the first tensor, added to the second.
    #[derive(Debug, Clone)]
    pub(super) struct Before(pub(super) Norm);

    /// Results of a forward pass that the backward pass reads.
    #[derive(Debug, Clone)]
    pub(super) struct Kept {
        /// Rows with mean 0 and variance 1.
        hat: FlexTensor,
        /// `1 / sqrt(var + eps)` of each row.
        scales: Vec<f32>,
        gamma: FlexTensor,
        beta: FlexTensor,
    }

    /// Operands of a forward pass; those that a norm does not have are empty.
    struct Rows<'a> {
        x: &'a [f32],
        /// Added to `x` before the norm.
        before: &'a [f32],
        /// Added to the result.
        after: &'a [f32],
        gamma: &'a [f32],
        beta: &'a [f32],
    }

    multiversion! {
        /// Appends to `hat` the normed rows, to `scales` what they were multiplied by, and to `out` the results. Without
        /// `keep` the first two hold only the last row.
        fn forward<const SET>(rows: &Rows<'_>, eps: f32, slope: f32, keep: bool, hat: &mut Vec<f32>, scales: &mut Vec<f32>, out: &mut Vec<f32>) {
            let width = rows.gamma.len();
            #[expect(clippy::cast_precision_loss, reason = "a width is small")]
            let share = 1.0 / width as f32;
            for start in (0..rows.x.len()).step_by(width) {
                if !keep {
                    hat.clear();
                    scales.clear();
                }
                let from = hat.len();
                let x = &rows.x[start..start + width];
                if rows.before.is_empty() {
                    hat.extend_from_slice(x);
                } else {
                    append::<SET, 2>(hat, [x, &rows.before[start..start + width]], |[x, y]| x + y);
                }
                let row = &mut hat[from..];
                let mean = Lanes::splat(sum::<SET, 1>([row], |[x]| x) * share);
                let variance = sum::<SET, 1>([row], |[x]| (x - mean) * (x - mean)) * share;
                let scale = 1.0 / (variance + eps).sqrt();
                scales.push(scale);
                let scale = Lanes::splat(scale);
                update::<SET, 0>(row, [], |x, []| (x - mean) * scale);
                append::<SET, 3>(out, [row, rows.gamma, rows.beta], |[z, g, b]| z.mul_add(g, b));
                let to = &mut out[start..];
                if slope != 1.0 {
                    let slope = Lanes::splat(slope);
                    update::<SET, 0>(to, [], |z, []| z.by_sign(z * slope, z));
                }
                if !rows.after.is_empty() {
                    update::<SET, 1>(to, [&rows.after[start..start + width]], |z, [y]| z + y);
                }
            }
        }
    }

    multiversion! {
        /// `dx = scale (g - mean(g) - hat mean(g hat))` in place of `dy`, with `g = dy gamma` and `dy` behind the ReLU;
        /// adds to `dgamma` and `dbeta`.
        fn backward<const SET>(hat: &[f32], scales: &[f32], gamma: &[f32], beta: &[f32], slope: f32, dy: &mut [f32], dgamma: &mut [f32], dbeta: &mut [f32]) {
            let width = gamma.len();
            #[expect(clippy::cast_precision_loss, reason = "a width is small")]
            let share = 1.0 / width as f32;
            for ((hat, dy), scale) in hat.chunks_exact(width).zip(dy.chunks_exact_mut(width)).zip(scales) {
                if slope != 1.0 {
                    let slope = Lanes::splat(slope);
                    update::<SET, 3>(dy, [hat, gamma, beta], |dy, [hat, g, b]| {
                        hat.mul_add(g, b).by_sign(dy * slope, dy)
                    });
                }
                update::<SET, 2>(dgamma, [dy, hat], |sum, [dy, hat]| dy.mul_add(hat, sum));
                update::<SET, 1>(dbeta, [dy], |sum, [dy]| sum + dy);
                let first = Lanes::splat(sum::<SET, 2>([dy, gamma], |[dy, g]| dy * g) * share);
                let second = Lanes::splat(sum::<SET, 3>([dy, gamma, hat], |[dy, g, hat]| dy * g * hat) * share);
                let scale = Lanes::splat(*scale);
                update::<SET, 2>(dy, [gamma, hat], |dy, [g, hat]| scale * (dy * g - first - hat * second));
            }
        }
    }

    impl Norm {
        /// The result, the normed rows and their scales.
        fn rows(&self, rows: &Rows<'_>, keep: bool) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
            let count = rows.x.len();
            let width = rows.gamma.len();
            let kept = if keep { count } else { width };
            let mut out = Vec::with_capacity(count);
            let mut hat = Vec::with_capacity(kept);
            let mut scales = Vec::with_capacity(kept / width);
            #[expect(clippy::cast_possible_truncation, reason = "a setting")]
            forward(rows, self.eps as f32, self.slope, keep, &mut hat, &mut scales, &mut out);
            (out, hat, scales)
        }

        /// The result, and what the backward pass reads of it.
        fn kept(&self, rows: &Rows<'_>, to: &[usize], gamma: &FlexTensor, beta: &FlexTensor) -> (FlexTensor, Kept) {
            let (out, hat, scales) = self.rows(rows, true);
            (make(out, to), Kept { hat: make(hat, to), scales, gamma: gamma.clone(), beta: beta.clone() })
        }

        /// The gradients of the normed tensor, of gamma and of beta.
        fn gradients(&self, kept: Kept, dy: FlexTensor) -> [Option<FlexTensor>; 3] {
            let Kept { hat, scales, gamma, beta } = kept;
            let width = slice(&gamma).len();
            let mut dgamma = vec![0.0; width];
            let mut dbeta = vec![0.0; width];
            let dx = overwrite(dy, |dy| {
                let hat = slice(&hat);
                let gamma = slice(&gamma);
                let beta = slice(&beta);
                backward(hat, &scales, gamma, beta, self.slope, dy, &mut dgamma, &mut dbeta);
            });
            [Some(dx), Some(make(dgamma, &[width])), Some(make(dbeta, &[width]))]
        }
    }

    impl<'a> Rows<'a> {
        fn of(x: &'a FlexTensor, gamma: &'a FlexTensor, beta: &'a FlexTensor) -> Self {
            Self { x: slice(x), before: &[], after: &[], gamma: slice(gamma), beta: slice(beta) }
        }
    }

    impl Fused<3> for Norm {
        type Kept = Kept;

        fn forward(&self, [x, gamma, beta]: [FlexTensor; 3]) -> (FlexTensor, Kept) {
            self.kept(&Rows::of(&x, &gamma, &beta), &shape(&x), &gamma, &beta)
        }

        fn value(&self, [x, gamma, beta]: [FlexTensor; 3]) -> FlexTensor {
            make(self.rows(&Rows::of(&x, &gamma, &beta), false).0, &shape(&x))
        }

        fn backward(&self, kept: Kept, dy: FlexTensor, _: [bool; 3]) -> [Option<FlexTensor>; 3] {
            self.gradients(kept, dy)
        }
    }

    impl Fused<4> for After {
        type Kept = Kept;

        fn forward(&self, [x, y, gamma, beta]: [FlexTensor; 4]) -> (FlexTensor, Kept) {
            let rows = Rows { before: slice(&y), ..Rows::of(&x, &gamma, &beta) };
            self.0.kept(&rows, &shape(&x), &gamma, &beta)
        }

        fn value(&self, [x, y, gamma, beta]: [FlexTensor; 4]) -> FlexTensor {
            make(self.0.rows(&Rows { before: slice(&y), ..Rows::of(&x, &gamma, &beta) }, false).0, &shape(&x))
        }

        fn backward(&self, kept: Kept, dy: FlexTensor, _: [bool; 4]) -> [Option<FlexTensor>; 4] {
            let [dx, dgamma, dbeta] = self.0.gradients(kept, dy);
            [dx.clone(), dx, dgamma, dbeta]
        }
    }

    impl Fused<4> for Before {
        type Kept = Kept;

        fn forward(&self, [x, y, gamma, beta]: [FlexTensor; 4]) -> (FlexTensor, Kept) {
            let rows = Rows { after: slice(&y), ..Rows::of(&x, &gamma, &beta) };
            self.0.kept(&rows, &shape(&x), &gamma, &beta)
        }

        fn value(&self, [x, y, gamma, beta]: [FlexTensor; 4]) -> FlexTensor {
            make(self.0.rows(&Rows { after: slice(&y), ..Rows::of(&x, &gamma, &beta) }, false).0, &shape(&x))
        }

        fn backward(&self, kept: Kept, dy: FlexTensor, wanted: [bool; 4]) -> [Option<FlexTensor>; 4] {
            let own = wanted[1].then(|| dy.clone());
            let [dx, dgamma, dbeta] = self.0.gradients(kept, dy);
            [dx, own, dgamma, dbeta]
        }
    }
}
