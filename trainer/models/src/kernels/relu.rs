//! ReLU and leaky ReLU, in one pass each way.

use burn::tensor::Tensor;
use burn::tensor::activation;

#[cfg(feature = "flex")]
use super::fused;

/// Multiplies negative elements by `slope`, which is at least 0. A slope of 0 is a ReLU.
pub fn leaky_relu<const D: usize>(x: Tensor<D>, slope: f64) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        #[expect(clippy::cast_possible_truncation, reason = "a constant of a network")]
        return fused::run(kernel::Leaky(slope as f32), [x.into()]);
    }
    activation::leaky_relu(x, slope)
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use crate::kernels::fused::{Fused, overwrite, slice};
    use crate::kernels::simd::multiversion;

    /// The slope below 0.
    #[derive(Debug, Clone)]
    pub(super) struct Leaky(pub(super) f32);

    multiversion! {
        /// Multiplies elements of `x` by `slope` where those of `signs` are not positive.
        fn backward(slope: f32, signs: &[f32], x: &mut [f32]) {
            for (x, sign) in x.iter_mut().zip(signs) {
                *x = if *sign > 0.0 { *x } else { *x * slope };
            }
        }
    }

    multiversion! {
        fn forward(slope: f32, x: &mut [f32]) {
            for x in x {
                *x = if *x > 0.0 { *x } else { *x * slope };
            }
        }
    }

    impl Fused<1> for Leaky {
        /// The result, which is positive where the input is.
        type Kept = FlexTensor;

        fn forward(&self, [x]: [FlexTensor; 1]) -> (FlexTensor, FlexTensor) {
            let y = overwrite(x, |x| forward(self.0, x));
            (y.clone(), y)
        }

        fn backward(&self, y: FlexTensor, dy: FlexTensor, _: [bool; 1]) -> [Option<FlexTensor>; 1] {
            [Some(overwrite(dy, |dy| backward(self.0, slice(&y), dy)))]
        }
    }
}
