//! Stateless dropout: an element is kept or dropped by a hash of (seed, step, slice, layer, element). A recomputed
//! step, on another worker or after a crash, drops the same elements. There is no generator, lock or state to save.

use burn::tensor::{Tensor, TensorData};

/// Position in the run, and the dropout probability there.
#[derive(Debug, Clone)]
pub struct Dropout {
    key: u64,
    layer: u64,
    probability: f64,
}

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

    /// The key of the next layer, or `None` when nothing is dropped.
    pub(super) fn next_key(&mut self) -> Option<u64> {
        if self.probability <= 0.0 {
            return None;
        }
        self.layer += 1;
        Some(mix(self.key ^ self.layer))
    }

    /// Factor of an element: `1 / (1 - p)` if it is kept, 0 if it is dropped.
    pub(super) fn mask(&self, key: u64, index: usize) -> f32 {
        #[expect(clippy::cast_precision_loss, reason = "53 bits are drawn")]
        let uniform = (mix(key ^ index as u64) >> 11) as f64 / (1_u64 << 53) as f64;
        #[expect(clippy::cast_possible_truncation, reason = "a probability")]
        let kept = (1.0 / (1.0 - self.probability)) as f32;
        if uniform < self.probability { 0.0 } else { kept }
    }
}

/// The 64-bit finaliser of SplitMix64 (Steele et al., 2014).
fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Drops elements of `x` and scales the others by `1 / (1 - p)`.
pub fn dropout<const D: usize>(x: Tensor<D>, dropout: &mut Dropout) -> Tensor<D> {
    let Some(key) = dropout.next_key() else { return x };
    let shape = x.dims();
    let count = shape.iter().product::<usize>();
    let mask: Vec<f32> = (0..count).map(|i| dropout.mask(key, i)).collect();
    let mask = Tensor::from_data(TensorData::new(mask, shape), &x.device());
    x * mask
}
