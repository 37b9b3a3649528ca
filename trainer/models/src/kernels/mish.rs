//! Mish: `x tanh(ln(1 + e^x))` (Misra, arXiv:1908.08681).
//!
//! `tanh(ln(1 + u)) = u (u + 2) / (u (u + 2) + 2)` with `u = e^x`, so one exponential is enough. The fused path
//! computes `e^(-|x|)` and divides both sides by `e^(2x)` for positive x. The composed path caps x at 20, above which
//! the quotient rounds to 1.

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::fused::{self, Elementwise};
#[cfg(feature = "flex")]
use super::simd::{Lanes, append, multiversion, update};

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
    fn forward<const SET>(x: &[f32]) -> Vec<f32> {
        let mut y = Vec::new();
        append::<SET, 1>(&mut y, [x], |[x]| {
            let parts = Parts::of(x);
            x * (parts.top / (parts.top + parts.rest))
        });
        y
    }
}

#[cfg(feature = "flex")]
multiversion! {
    fn backward<const SET>(x: &[f32], dy: &mut [f32]) {
        let one = Lanes::splat(1.0);
        update::<SET, 1>(dy, [x], |dy, [x]| {
            let Parts { e, top, rest } = Parts::of(x);
            let slope = x.by_sign(e, e * e);
            let q = one / (top + rest);
            dy * (top * q + x * Lanes::splat(4.0) * (one + e) * slope * q * q)
        });
    }
}

/// tanh(softplus(x)) is `top / (top + rest)`, without overflow.
#[cfg(feature = "flex")]
struct Parts<const SET: u8> {
    /// The exponential of `-|x|`.
    e: Lanes<SET>,
    top: Lanes<SET>,
    rest: Lanes<SET>,
}

#[cfg(feature = "flex")]
impl<const SET: u8> Parts<SET> {
    #[inline(always)]
    fn of(x: Lanes<SET>) -> Self {
        let (one, two) = (Lanes::splat(1.0), Lanes::splat(2.0));
        let e = (Lanes::splat(0.0) - x.abs()).exp();
        Self { e, top: x.by_sign(e * (e + two), one + two * e), rest: x.by_sign(two, two * e * e) }
    }
}
