//! GELU, exact: `x Phi(x)` with Phi the normal distribution function (Hendrycks and Gimpel, arXiv:1606.08415, not its
//! tanh approximation).

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::fused::{self, Elementwise};
#[cfg(feature = "flex")]
use super::simd::{erf_by, exp_by, mul_add, multiversion};

/// GELU of every element.
pub fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        return fused::run(Elementwise { forward, backward }, [x.into()]);
    }
    // Composed, because on some backends Burn's GELU has the gradient of the tanh approximation. Measured on ndarray:
    // gradients of a denoiser differ by 2e-4 of the largest.
    let cdf = (x.clone() * std::f32::consts::FRAC_1_SQRT_2).erf() + 1.0;
    x * cdf * 0.5
}

/// Elements that are computed before they are appended. A closure for `collect` may be compiled for the baseline.
#[cfg(feature = "flex")]
const BLOCK: usize = 256;

#[cfg(feature = "flex")]
multiversion! {
    fn forward<const SET>(x: &[f32]) -> Vec<f32> {
        let mut y = Vec::with_capacity(x.len());
        for x in x.chunks(BLOCK) {
            let mut block = [0.0; BLOCK];
            for (y, x) in block.iter_mut().zip(x) {
                *y = 0.5 * x * (1.0 + erf_by::<SET>(x * std::f32::consts::FRAC_1_SQRT_2));
            }
            y.extend_from_slice(&block[..x.len()]);
        }
        y
    }
}

#[cfg(feature = "flex")]
multiversion! {
    fn backward<const SET>(x: &[f32], dy: &mut [f32]) {
        const DENSITY: f32 = 0.398_942_3;
        for (dy, x) in dy.iter_mut().zip(x) {
            let cdf = 0.5 * (1.0 + erf_by::<SET>(x * std::f32::consts::FRAC_1_SQRT_2));
            *dy *= mul_add::<SET>(x * DENSITY, exp_by::<SET>(-0.5 * x * x), cdf);
        }
    }
}
