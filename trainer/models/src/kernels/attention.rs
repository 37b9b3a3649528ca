//! Scaled dot-product attention with a key mask (Vaswani et al., arXiv:1706.03762). Heads are packed as in published
//! checkpoints: one projection returns q, k and v side by side, head after head.
//!
//! The fused path never splits heads in memory, leaves out keys of padding, and is one node of the tape.

#[cfg(feature = "flex")]
mod large;
#[cfg(feature = "flex")]
mod small;

use burn::tensor::activation::softmax;
use burn::tensor::{Tensor, TensorData};

use super::Dropout;
use super::dropout::Factors;
#[cfg(feature = "flex")]
use super::fused;

/// Number of leading valid keys of each sequence; the rest is padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyMask {
    valid: Vec<usize>,
}

impl KeyMask {
    /// Creates a mask with `lengths[b]` valid items after `prefix` items that are always valid.
    ///
    /// # Panics
    /// If a sequence has no valid key: its attention would be undefined.
    pub fn new(lengths: &[usize], prefix: usize) -> Self {
        let valid: Vec<_> = lengths.iter().map(|l| l + prefix).collect();
        assert!(valid.iter().all(|v| *v > 0), "a sequence without a valid key");
        Self { valid }
    }

    fn of(&self, batch: usize) -> usize {
        self.valid[batch]
    }
}

/// Self-attention. `qkv` [B, T, 3H], queries, keys and values side by side -> [B, T, H].
pub fn self_attention(qkv: Tensor<3>, heads: usize, mask: Option<&KeyMask>, dropout: &mut Dropout) -> Tensor<3> {
    let [batch, len, triple] = qkv.dims();
    own(qkv, Sizes { batch, queries: len, keys: len, heads, width: triple / 3, causal: false }, mask, dropout)
}

fn own(qkv: Tensor<3>, sizes: Sizes, mask: Option<&KeyMask>, dropout: &mut Dropout) -> Tensor<3> {
    let Sizes { batch, keys: len, width, .. } = sizes;
    let dropout = dropout.next_layer();
    #[cfg(feature = "flex")]
    if fused::takes(&qkv) {
        return fused::run(kernel::Attend::new(sizes, mask, dropout), [qkv.into()]);
    }
    let part = |i: usize| qkv.clone().slice([0..batch, 0..len, i * width..(i + 1) * width]);
    composed(part(0), part(1), part(2), sizes, mask, dropout)
}

/// Like [`self_attention`], but no token attends to the tokens after it.
pub fn causal_attention(qkv: Tensor<3>, heads: usize, dropout: &mut Dropout) -> Tensor<3> {
    let [batch, len, triple] = qkv.dims();
    own(qkv, Sizes { batch, queries: len, keys: len, heads, width: triple / 3, causal: true }, None, dropout)
}

/// Cross-attention. `q` [B, Q, H]; `kv` [B, K, 2H], keys and values side by side -> [B, Q, H].
pub fn cross_attention(
    q: Tensor<3>,
    kv: Tensor<3>,
    heads: usize,
    mask: Option<&KeyMask>,
    dropout: &mut Dropout,
) -> Tensor<3> {
    let [batch, queries, width] = q.dims();
    let keys = kv.dims()[1];
    let sizes = Sizes { batch, queries, keys, heads, width, causal: false };
    let dropout = dropout.next_layer();
    #[cfg(feature = "flex")]
    if fused::takes(&q) {
        return fused::run(kernel::Attend::new(sizes, mask, dropout), [q.into(), kv.into()]);
    }
    let part = |i: usize| kv.clone().slice([0..batch, 0..keys, i * width..(i + 1) * width]);
    composed(q, part(0), part(1), sizes, mask, dropout)
}

#[derive(Debug, Clone, Copy)]
struct Sizes {
    batch: usize,
    queries: usize,
    keys: usize,
    heads: usize,
    width: usize,
    /// Hides the keys after a query's own place.
    causal: bool,
}

/// Score of a hidden key: far below any other, but finite, so that a gradient through it is 0 and not undefined.
pub(crate) const HIDDEN: f32 = -1e9;

impl Sizes {
    fn head(self) -> usize {
        self.width / self.heads
    }

    #[expect(clippy::cast_precision_loss, reason = "a head is narrow")]
    fn scale(self) -> f32 {
        1.0 / (self.head() as f32).sqrt()
    }
}

fn composed(
    q: Tensor<3>,
    k: Tensor<3>,
    v: Tensor<3>,
    sizes: Sizes,
    mask: Option<&KeyMask>,
    dropout: Option<Factors>,
) -> Tensor<3> {
    let Sizes { batch, queries, keys, heads, width, causal } = sizes;
    let device = q.device();
    let split = |x: Tensor<3>, len: usize| x.reshape([batch, len, heads, width / heads]).swap_dims(1, 2);
    let mut scores = split(q, queries).matmul(split(k, keys).swap_dims(2, 3)) * sizes.scale();
    if let Some(mask) = mask {
        let bias = (0..batch).flat_map(|b| (0..keys).map(move |j| if j < mask.of(b) { 0.0 } else { HIDDEN })).collect();
        scores = scores + Tensor::from_data(TensorData::new(bias, [batch, 1, 1, keys]), &device);
    }
    if causal {
        let bias = (0..queries).flat_map(|i| (0..keys).map(move |j| if j <= i { 0.0 } else { HIDDEN })).collect();
        scores = scores + Tensor::from_data(TensorData::new(bias, [1, 1, queries, keys]), &device);
    }
    let mut weights = softmax(scores, 3);
    if let Some(factors) = dropout {
        let kept = (0..batch * heads * queries * keys).map(|i| factors.of(i)).collect::<Vec<_>>();
        weights = weights * Tensor::from_data(TensorData::new(kept, [batch, heads, queries, keys]), &device);
    }
    weights.matmul(split(v, keys)).swap_dims(1, 2).reshape([batch, queries, width])
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use super::{Factors, KeyMask, Sizes, large, small};
    use crate::kernels::fused::{Fused, make, slice};

    /// Attention of one call: among the tokens of one tensor, or from a tensor to another.
    #[derive(Debug, Clone)]
    pub(super) struct Attend {
        pub(super) sizes: Sizes,
        mask: Option<KeyMask>,
        /// Factors of the weights.
        pub(super) dropout: Option<Factors>,
    }

    /// Queries, keys and values inside one or two slices.
    pub(super) struct Packed<'a> {
        pub(super) q: &'a [f32],
        /// Length of a row of `q`.
        pub(super) q_row: usize,
        pub(super) kv: &'a [f32],
        pub(super) kv_row: usize,
        /// Offset of the keys in a row of `kv`.
        pub(super) k_at: usize,
        pub(super) v_at: usize,
    }

    impl<'a> Packed<'a> {
        fn own(qkv: &'a [f32], width: usize) -> Self {
            Self { q: qkv, q_row: 3 * width, kv: qkv, kv_row: 3 * width, k_at: width, v_at: 2 * width }
        }

        fn cross(q: &'a [f32], kv: &'a [f32], width: usize) -> Self {
            Self { q, q_row: width, kv, kv_row: 2 * width, k_at: 0, v_at: width }
        }

        /// Returns true if queries, keys and values lie in one tensor.
        pub(super) fn is_own(&self) -> bool {
            self.k_at > 0
        }
    }

    impl Attend {
        pub(super) fn new(sizes: Sizes, mask: Option<&KeyMask>, dropout: Option<Factors>) -> Self {
            Self { sizes, mask: mask.cloned(), dropout }
        }

        /// Number of keys that sequence `b` attends to.
        pub(super) fn valid(&self, b: usize) -> usize {
            self.mask.as_ref().map_or(self.sizes.keys, |mask| mask.of(b).min(self.sizes.keys))
        }

        /// The output, and the softmax weights before dropout if they are to be kept.
        fn values(&self, packed: &Packed<'_>, keep: bool) -> (FlexTensor, Vec<f32>) {
            let Sizes { batch, queries, width, .. } = self.sizes;
            let (out, weights) =
                if small::fits(self.sizes) { small::forward(self, packed, keep) } else { large::forward(self, packed) };
            (make(out, &[batch, queries, width]), if keep { weights } else { Vec::new() })
        }

        /// The gradients of queries, and of keys and values. The first holds all of them if they lie in one tensor.
        fn gradients(&self, packed: &Packed<'_>, weights: &[f32], dout: &[f32]) -> (Vec<f32>, Vec<f32>) {
            if small::fits(self.sizes) {
                small::backward(self, packed, weights, dout)
            } else {
                large::backward(self, packed, weights, dout)
            }
        }
    }

    impl Fused<1> for Attend {
        type Kept = (FlexTensor, Vec<f32>);

        fn forward(&self, [qkv]: [FlexTensor; 1]) -> (FlexTensor, Self::Kept) {
            let (out, weights) = self.values(&Packed::own(slice(&qkv), self.sizes.width), true);
            (out, (qkv, weights))
        }

        fn value(&self, [qkv]: [FlexTensor; 1]) -> FlexTensor {
            self.values(&Packed::own(slice(&qkv), self.sizes.width), false).0
        }

        fn backward(&self, (qkv, weights): Self::Kept, dy: FlexTensor, _: [bool; 1]) -> [Option<FlexTensor>; 1] {
            let Sizes { batch, queries, width, .. } = self.sizes;
            let (dx, _) = self.gradients(&Packed::own(slice(&qkv), width), &weights, slice(&dy));
            [Some(make(dx, &[batch, queries, 3 * width]))]
        }
    }

    impl Fused<2> for Attend {
        type Kept = (FlexTensor, FlexTensor, Vec<f32>);

        fn forward(&self, [q, kv]: [FlexTensor; 2]) -> (FlexTensor, Self::Kept) {
            let (out, weights) = self.values(&Packed::cross(slice(&q), slice(&kv), self.sizes.width), true);
            (out, (q, kv, weights))
        }

        fn value(&self, [q, kv]: [FlexTensor; 2]) -> FlexTensor {
            self.values(&Packed::cross(slice(&q), slice(&kv), self.sizes.width), false).0
        }

        fn backward(&self, (q, kv, weights): Self::Kept, dy: FlexTensor, _: [bool; 2]) -> [Option<FlexTensor>; 2] {
            let Sizes { batch, queries, keys, width, .. } = self.sizes;
            let packed = Packed::cross(slice(&q), slice(&kv), width);
            let (dq, dkv) = self.gradients(&packed, &weights, slice(&dy));
            [Some(make(dq, &[batch, queries, width])), Some(make(dkv, &[batch, keys, 2 * width]))]
        }
    }
}
