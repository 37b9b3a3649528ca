//! Stateless dropout: an element is kept or dropped by a hash of (seed, step, slice, layer, element). A recomputed
//! step, on another worker or after a crash, drops the same elements. There is no generator, lock or state to save.

use burn::tensor::{Tensor, TensorData};

#[cfg(feature = "flex")]
use super::fused;

/// Position in the run, and the dropout probability there.
#[derive(Debug, Clone)]
pub struct Dropout {
    key: u64,
    layer: u64,
    probability: f64,
}

/// The factors of a layer's elements: 0 or `1 / (1 - p)`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Factors {
    key: u64,
    /// Hashes below this drop an element.
    limit: u64,
    kept: f32,
}

/// Bits of a hash that decide.
const BITS: u32 = 53;

impl Dropout {
    /// Disables dropout, for evaluation or a frozen network.
    pub fn off() -> Self {
        Self { key: 0, layer: 0, probability: 0.0 }
    }

    /// Dropout of one slice of one step. Each use inside the network advances the layer by one.
    pub fn new(probability: f64, seed: u64, step: u64, slice: u64) -> Self {
        Self { key: mix(mix(mix(seed) ^ step) ^ slice), layer: 0, probability }
    }

    /// Probability that an element is dropped.
    pub fn probability(&self) -> f64 {
        self.probability
    }

    /// The factors of the next layer, or `None` when nothing is dropped.
    pub(super) fn next_layer(&mut self) -> Option<Factors> {
        if self.probability <= 0.0 {
            return None;
        }
        self.layer += 1;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share of 2^53, and a factor")]
        Some(Factors {
            key: mix(self.key ^ self.layer),
            limit: (self.probability * (1_u64 << BITS) as f64).ceil() as u64,
            kept: (1.0 / (1.0 - self.probability)) as f32,
        })
    }
}

impl Factors {
    /// Factor of an element: `1 / (1 - p)` if it is kept, 0 if it is dropped.
    #[inline(always)]
    pub(super) fn of(self, index: usize) -> f32 {
        if mix(self.key ^ index as u64) >> (u64::BITS - BITS) < self.limit { 0.0 } else { self.kept }
    }
}

/// The 64-bit finaliser of SplitMix64 (Steele et al., 2014).
#[inline(always)]
fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Drops elements of `x` and scales the others by `1 / (1 - p)`.
pub fn dropout<const D: usize>(x: Tensor<D>, dropout: &mut Dropout) -> Tensor<D> {
    let Some(factors) = dropout.next_layer() else { return x };
    #[cfg(feature = "flex")]
    if fused::takes(&x) {
        return fused::run(kernel::Drop(factors), [x.into()]);
    }
    let shape = x.dims();
    let count = shape.iter().product::<usize>();
    let mask: Vec<f32> = (0..count).map(|i| factors.of(i)).collect();
    let mask = Tensor::from_data(TensorData::new(mask, shape), &x.device());
    x * mask
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use super::Factors;
    use crate::kernels::fused::{Fused, overwrite};
    use crate::kernels::simd::multiversion;

    /// Multiplication by factors that both passes compute.
    #[derive(Debug, Clone)]
    pub(super) struct Drop(pub(super) Factors);

    multiversion! {
        fn multiply(factors: Factors, x: &mut [f32]) {
            for (i, x) in x.iter_mut().enumerate() {
                *x *= factors.of(i);
            }
        }
    }

    impl Fused<1> for Drop {
        type Kept = ();

        fn forward(&self, [x]: [FlexTensor; 1]) -> (FlexTensor, ()) {
            (overwrite(x, |x| multiply(self.0, x)), ())
        }

        fn backward(&self, (): (), dy: FlexTensor, _: [bool; 1]) -> [Option<FlexTensor>; 1] {
            [Some(overwrite(dy, |dy| multiply(self.0, dy)))]
        }
    }
}
