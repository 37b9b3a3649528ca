//! Mish: `x tanh(ln(1 + e^x))` (Misra, arXiv:1908.08681).
//!
//! `tanh(ln(1 + u)) = u (u + 2) / (u (u + 2) + 2)` with `u = e^x`, so one exponential is enough. The fused path
//! computes `e^(-|x|)` and divides both sides by `e^(2x)` for positive x. The composed path caps x at 20, above which
//! the quotient rounds to 1.

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::fused::{self, Elementwise};
#[cfg(feature = "flex")]
use super::simd::{exp, multiversion};

/// Upper limit of the exponent in the composed path.
const CAP: f32 = 20.0;

/// Mish of every element.
pub fn mish<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        return fused::run(Elementwise { forward, backward }, [x.into()]);
    }
    let e = x.clone().clamp_max(CAP).exp();
    let n = e.clone() * (e + 2.0);
    x * n.clone() / (n + 2.0)
}

#[cfg(feature = "flex")]
multiversion! {
    fn forward(x: &[f32]) -> Vec<f32> {
        let one = |x: &f32| {
            let e = exp(-x.abs());
            let (top, rest) = if *x < 0.0 { (e * (e + 2.0), 2.0) } else { (1.0 + 2.0 * e, 2.0 * e * e) };
            x * (top / (top + rest))
        };
        x.iter().map(one).collect()
    }
}

#[cfg(feature = "flex")]
multiversion! {
    fn backward(x: &[f32], dy: &mut [f32]) {
        for (dy, x) in dy.iter_mut().zip(x) {
            let e = exp(-x.abs());
            let (top, rest, slope) =
                if *x < 0.0 { (e * (e + 2.0), 2.0, e) } else { (1.0 + 2.0 * e, 2.0 * e * e, e * e) };
            let q = 1.0 / (top + rest);
            *dy *= top * q + x * 4.0 * (1.0 + e) * slope * q * q;
        }
    }
}
