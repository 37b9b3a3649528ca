//! Scaled dot-product attention with a key mask (Vaswani et al., arXiv:1706.03762). Heads are packed as in published
//! checkpoints: one projection returns q, k and v side by side, head after head.
//!
//! The fused path never splits heads in memory: matrix products run on strided views of the packed projections, over
//! the valid keys only. The whole computation is one node of the tape.

use burn::tensor::activation::softmax;
use burn::tensor::{Tensor, TensorData};

use super::Dropout;
#[cfg(feature = "flex")]
use super::raw::{self, Place, Tracked, View, contiguous, make, matmul, slice};
#[cfg(feature = "flex")]
use super::simd::{exp, multiversion};
#[cfg(feature = "flex")]
use burn::backend::Flex;
#[cfg(feature = "flex")]
use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::NoCheckpointing},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
#[cfg(feature = "flex")]
use burn::backend::flex::FlexTensor;

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
    let width = triple / 3;
    let sizes = Sizes { batch, queries: len, keys: len, heads, width };
    let key = dropout.next_key();
    #[cfg(feature = "flex")]
    match raw::place(&qkv, false) {
        Place::Tracked => return fused::tracked_self(qkv, sizes, mask, key.map(|k| (k, dropout.clone()))),
        Place::Plain => {
            let x = contiguous(raw::plain(qkv));
            let packed = fused::Packed::own(slice(&x), width);
            let (out, _) = fused::forward(&packed, sizes, mask, key.map(|k| (k, &*dropout)));
            return Tensor::from_primitive::<Flex>(make(out, &[batch, len, width]));
        }
        Place::Other => {}
    }
    let part = |i: usize| qkv.clone().slice([0..batch, 0..len, i * width..(i + 1) * width]);
    stock(part(0), part(1), part(2), sizes, mask, key.map(|k| (k, &*dropout)))
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
    let sizes = Sizes { batch, queries, keys, heads, width };
    let key = dropout.next_key();
    #[cfg(feature = "flex")]
    match raw::place(&q, raw::on_tape(&kv)) {
        Place::Tracked => return fused::tracked_cross(q, kv, sizes, mask, key.map(|k| (k, dropout.clone()))),
        Place::Plain => {
            let (q, kv) = (contiguous(raw::plain(q)), contiguous(raw::plain(kv)));
            let packed = fused::Packed::cross(slice(&q), slice(&kv), width);
            let (out, _) = fused::forward(&packed, sizes, mask, key.map(|k| (k, &*dropout)));
            return Tensor::from_primitive::<Flex>(make(out, &[batch, queries, width]));
        }
        Place::Other => {}
    }
    let part = |i: usize| kv.clone().slice([0..batch, 0..keys, i * width..(i + 1) * width]);
    stock(q, part(0), part(1), sizes, mask, key.map(|k| (k, &*dropout)))
}

#[derive(Debug, Clone, Copy)]
struct Sizes {
    batch: usize,
    queries: usize,
    keys: usize,
    heads: usize,
    width: usize,
}

impl Sizes {
    fn head(self) -> usize {
        self.width / self.heads
    }

    #[expect(clippy::cast_precision_loss, reason = "a head is narrow")]
    fn scale(self) -> f32 {
        1.0 / (self.head() as f32).sqrt()
    }
}

fn stock(
    q: Tensor<3>,
    k: Tensor<3>,
    v: Tensor<3>,
    sizes: Sizes,
    mask: Option<&KeyMask>,
    dropout: Option<(u64, &Dropout)>,
) -> Tensor<3> {
    let Sizes { batch, queries, keys, heads, width } = sizes;
    let device = q.device();
    let split = |x: Tensor<3>, len: usize| x.reshape([batch, len, heads, width / heads]).swap_dims(1, 2);
    let mut scores = split(q, queries).matmul(split(k, keys).swap_dims(2, 3)) * sizes.scale();
    if let Some(mask) = mask {
        // Far below any score, but finite, so that a gradient through it is 0 and not undefined.
        let bias =
            (0..batch).flat_map(|b| (0..keys).map(move |j| if j < mask.of(b) { 0.0 } else { -1e9_f32 })).collect();
        scores = scores + Tensor::from_data(TensorData::new(bias, [batch, 1, 1, keys]), &device);
    }
    let mut weights = softmax(scores, 3);
    if let Some((key, dropout)) = dropout {
        let kept = (0..batch * heads * queries * keys).map(|i| dropout.mask(key, i)).collect::<Vec<_>>();
        weights = weights * Tensor::from_data(TensorData::new(kept, [batch, heads, queries, keys]), &device);
    }
    weights.matmul(split(v, keys)).swap_dims(1, 2).reshape([batch, queries, width])
}

#[cfg(feature = "flex")]
mod fused {
    use super::{
        Backward, Checkpointer, Dropout, Flex, FlexTensor, Gradients, KeyMask, NoCheckpointing, Ops, OpsKind, Sizes,
        Tensor, Tracked, View, contiguous, exp, make, matmul, multiversion, raw, slice,
    };

    /// Queries, keys and values inside one or two slices.
    pub(super) struct Packed<'a> {
        q: &'a [f32],
        q_row: usize,
        kv: &'a [f32],
        kv_row: usize,
        k_at: usize,
        v_at: usize,
    }

    impl<'a> Packed<'a> {
        pub(super) fn own(qkv: &'a [f32], width: usize) -> Self {
            Self { q: qkv, q_row: 3 * width, kv: qkv, kv_row: 3 * width, k_at: width, v_at: 2 * width }
        }

        pub(super) fn cross(q: &'a [f32], kv: &'a [f32], width: usize) -> Self {
            Self { q, q_row: width, kv, kv_row: 2 * width, k_at: 0, v_at: width }
        }

        fn q_view(&self, s: Sizes, b: usize, h: usize) -> View {
            View { offset: b * s.queries * self.q_row + h * s.head(), row: self.q_row, col: 1 }
        }

        fn k_view(&self, s: Sizes, b: usize, h: usize) -> View {
            View { offset: b * s.keys * self.kv_row + self.k_at + h * s.head(), row: self.kv_row, col: 1 }
        }

        fn v_view(&self, s: Sizes, b: usize, h: usize) -> View {
            View { offset: b * s.keys * self.kv_row + self.v_at + h * s.head(), row: self.kv_row, col: 1 }
        }
    }

    fn out_view(s: Sizes, b: usize, h: usize) -> View {
        View { offset: b * s.queries * s.width + h * s.head(), row: s.width, col: 1 }
    }

    fn weight_view(s: Sizes, b: usize, h: usize) -> View {
        View { offset: (b * s.heads + h) * s.queries * s.keys, row: s.keys, col: 1 }
    }

    fn valid(s: Sizes, mask: Option<&KeyMask>, b: usize) -> usize {
        mask.map_or(s.keys, |m| m.of(b).min(s.keys))
    }

    multiversion! {
        /// Softmax of the first `valid` columns of each row; the rest becomes 0.
        fn softmax_rows(scores: &mut [f32], keys: usize, valid: usize) {
            for row in scores.chunks_exact_mut(keys) {
                let (live, dead) = row.split_at_mut(valid);
                dead.fill(0.0);
                let mut top = [f32::NEG_INFINITY; 16];
                let mut chunks = live.chunks_exact(16);
                for chunk in &mut chunks {
                    for (t, v) in top.iter_mut().zip(chunk) {
                        *t = if *v > *t { *v } else { *t };
                    }
                }
                let mut most = f32::NEG_INFINITY;
                for v in chunks.remainder().iter().chain(&top) {
                    most = if *v > most { *v } else { most };
                }
                for v in live.iter_mut() {
                    *v = exp(*v - most);
                }
                let mut lane = [0.0_f32; 16];
                let mut chunks = live.chunks_exact(16);
                for chunk in &mut chunks {
                    for (l, v) in lane.iter_mut().zip(chunk) {
                        *l += *v;
                    }
                }
                let total = lane.iter().sum::<f32>() + chunks.remainder().iter().sum::<f32>();
                let inverse = 1.0 / total;
                for v in live.iter_mut() {
                    *v *= inverse;
                }
            }
        }
    }

    multiversion! {
        /// `ds = p (dp - sum(dp p))` by row, in place of `dp`.
        fn softmax_backward_rows(p: &[f32], dp: &mut [f32], keys: usize) {
            for (p, dp) in p.chunks_exact(keys).zip(dp.chunks_exact_mut(keys)) {
                let mut lane = [0.0_f32; 16];
                let whole = keys / 16 * 16;
                let mut i = 0;
                while i < whole {
                    for (l, slot) in lane.iter_mut().enumerate() {
                        *slot += p[i + l] * dp[i + l];
                    }
                    i += 16;
                }
                let mut dot = 0.0;
                while i < keys {
                    dot += p[i] * dp[i];
                    i += 1;
                }
                dot += lane.iter().sum::<f32>();
                for (p, dp) in p.iter().zip(dp.iter_mut()) {
                    *dp = p * (*dp - dot);
                }
            }
        }
    }

    /// The output [B, Q, H] and the softmax weights [B, heads, Q, K] before dropout.
    pub(super) fn forward(
        packed: &Packed<'_>,
        s: Sizes,
        mask: Option<&KeyMask>,
        dropout: Option<(u64, &Dropout)>,
    ) -> (Vec<f32>, Vec<f32>) {
        let mut weights = vec![0.0; s.batch * s.heads * s.queries * s.keys];
        let mut out = vec![0.0; s.batch * s.queries * s.width];
        let mut dropped = Vec::new();
        for b in 0..s.batch {
            let valid = valid(s, mask, b);
            for h in 0..s.heads {
                let at = weight_view(s, b, h);
                matmul(
                    (s.queries, valid, s.head()),
                    packed.q,
                    packed.q_view(s, b, h),
                    packed.kv,
                    packed.k_view(s, b, h).t(),
                    &mut weights,
                    at,
                    0.0,
                    s.scale(),
                );
                let range = at.offset..at.offset + s.queries * s.keys;
                softmax_rows(&mut weights[range.clone()], s.keys, valid);
                let (p, pv) = match dropout {
                    None => (&weights[..], at),
                    Some((key, dropout)) => {
                        dropped.clear();
                        dropped.extend(range.map(|i| weights[i] * dropout.mask(key, i)));
                        (&dropped[..], View::rows(s.keys))
                    }
                };
                matmul(
                    (s.queries, s.head(), valid),
                    p,
                    pv,
                    packed.kv,
                    packed.v_view(s, b, h),
                    &mut out,
                    out_view(s, b, h),
                    0.0,
                    1.0,
                );
            }
        }
        (out, weights)
    }

    /// The inputs of the backward pass: the packed projections, the softmax weights, the gradient of the output, and
    /// the mask and dropout of the forward pass.
    struct Backprop<'a> {
        packed: Packed<'a>,
        weights: &'a [f32],
        dout: &'a [f32],
        s: Sizes,
        mask: Option<&'a KeyMask>,
        dropout: Option<(u64, &'a Dropout)>,
    }

    impl Backprop<'_> {
        /// Calls `write` for each head with the gradient of its scores (already scaled) and its weights after dropout.
        fn each_head(&self, mut write: impl FnMut(usize, usize, usize, &[f32], &[f32])) {
            let s = self.s;
            let mut scores = vec![0.0; s.queries * s.keys];
            let mut dropped = vec![0.0; s.queries * s.keys];
            for b in 0..s.batch {
                let valid = valid(s, self.mask, b);
                for h in 0..s.heads {
                    let at = weight_view(s, b, h);
                    let p = &self.weights[at.offset..at.offset + s.queries * s.keys];
                    scores.fill(0.0);
                    matmul(
                        (s.queries, valid, s.head()),
                        self.dout,
                        out_view(s, b, h),
                        self.packed.kv,
                        self.packed.v_view(s, b, h).t(),
                        &mut scores,
                        View::rows(s.keys),
                        0.0,
                        1.0,
                    );
                    match self.dropout {
                        None => dropped.copy_from_slice(p),
                        Some((key, dropout)) => {
                            for (i, (d, score)) in dropped.iter_mut().zip(&mut scores).enumerate() {
                                let kept = dropout.mask(key, at.offset + i);
                                *d = p[i] * kept;
                                *score *= kept;
                            }
                        }
                    }
                    softmax_backward_rows(p, &mut scores, s.keys);
                    write(b, h, valid, &scores, &dropped);
                }
            }
        }

        fn queries(&self, b: usize, h: usize, valid: usize, ds: &[f32], dq: &mut [f32]) {
            let s = self.s;
            let (k, to) = (self.packed.k_view(s, b, h), self.packed.q_view(s, b, h));
            matmul((s.queries, s.head(), valid), ds, View::rows(s.keys), self.packed.kv, k, dq, to, 0.0, s.scale());
        }

        fn keys_values(&self, b: usize, h: usize, valid: usize, ds: &[f32], p: &[f32], dkv: &mut [f32]) {
            let s = self.s;
            let (q, to) = (self.packed.q_view(s, b, h), self.packed.k_view(s, b, h));
            matmul((valid, s.head(), s.queries), ds, View::rows(s.keys).t(), self.packed.q, q, dkv, to, 0.0, s.scale());
            let (o, to) = (out_view(s, b, h), self.packed.v_view(s, b, h));
            matmul((valid, s.head(), s.queries), p, View::rows(s.keys).t(), self.dout, o, dkv, to, 0.0, 1.0);
        }
    }

    #[derive(Debug, Clone)]
    struct State {
        q: FlexTensor,
        kv: Option<FlexTensor>,
        weights: FlexTensor,
        sizes: Sizes,
        mask: Option<KeyMask>,
        dropout: Option<(u64, Dropout)>,
    }

    #[derive(Debug)]
    struct SelfOp;

    impl Backward<Flex, 1> for SelfOp {
        type State = State;

        fn backward(self, ops: Ops<State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
            let dout = contiguous(grads.consume::<Flex>(&ops.node));
            let [parent] = ops.parents;
            let Some(node) = parent else { return };
            let state = ops.state;
            let s = state.sizes;
            let back = Backprop {
                packed: Packed::own(slice(&state.q), s.width),
                weights: slice(&state.weights),
                dout: slice(&dout),
                s,
                mask: state.mask.as_ref(),
                dropout: state.dropout.as_ref().map(|(k, d)| (*k, d)),
            };
            let mut dx = vec![0.0; slice(&state.q).len()];
            back.each_head(|b, h, valid, ds, p| {
                back.queries(b, h, valid, ds, &mut dx);
                back.keys_values(b, h, valid, ds, p, &mut dx);
            });
            raw::register(grads, node.id, dx, &[s.batch, s.queries, 3 * s.width]);
        }
    }

    #[derive(Debug)]
    struct CrossOp;

    impl Backward<Flex, 2> for CrossOp {
        type State = State;

        fn backward(self, ops: Ops<State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
            let dout = contiguous(grads.consume::<Flex>(&ops.node));
            let [pq, pkv] = ops.parents;
            let state = ops.state;
            let s = state.sizes;
            let kv = state.kv.as_ref().expect("cross-attention keeps keys and values");
            let back = Backprop {
                packed: Packed::cross(slice(&state.q), slice(kv), s.width),
                weights: slice(&state.weights),
                dout: slice(&dout),
                s,
                mask: state.mask.as_ref(),
                dropout: state.dropout.as_ref().map(|(k, d)| (*k, d)),
            };
            let (mut dq, mut dkv) = (vec![0.0; slice(&state.q).len()], vec![0.0; slice(kv).len()]);
            back.each_head(|b, h, valid, ds, p| {
                back.queries(b, h, valid, ds, &mut dq);
                back.keys_values(b, h, valid, ds, p, &mut dkv);
            });
            if let Some(node) = pq {
                raw::register(grads, node.id, dq, &[s.batch, s.queries, s.width]);
            }
            if let Some(node) = pkv {
                raw::register(grads, node.id, dkv, &[s.batch, s.keys, 2 * s.width]);
            }
        }
    }

    fn weights_of(weights: Vec<f32>, s: Sizes) -> FlexTensor {
        make(weights, &[s.batch, s.heads, s.queries, s.keys])
    }

    pub(super) fn tracked_self(
        qkv: Tensor<3>,
        s: Sizes,
        mask: Option<&KeyMask>,
        dropout: Option<(u64, Dropout)>,
    ) -> Tensor<3> {
        let x = raw::track(qkv);
        let node = x.node();
        let q = contiguous(x.into_primitive());
        let (out, weights) = forward(&Packed::own(slice(&q), s.width), s, mask, dropout.as_ref().map(|(k, d)| (*k, d)));
        let out = make(out, &[s.batch, s.queries, s.width]);
        let out = match SelfOp.prepare::<NoCheckpointing>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let weights = weights_of(weights, s);
                prep.finish(State { q, kv: None, weights, sizes: s, mask: mask.cloned(), dropout }, out)
            }
            OpsKind::UnTracked(prep) => prep.finish(out),
        };
        Tensor::from_primitive::<Tracked>(out)
    }

    pub(super) fn tracked_cross(
        q: Tensor<3>,
        kv: Tensor<3>,
        s: Sizes,
        mask: Option<&KeyMask>,
        dropout: Option<(u64, Dropout)>,
    ) -> Tensor<3> {
        let (q, kv) = (raw::track(q), raw::track(kv));
        let nodes = [q.node(), kv.node()];
        let (q, kv) = (contiguous(q.into_primitive()), contiguous(kv.into_primitive()));
        let packed = Packed::cross(slice(&q), slice(&kv), s.width);
        let (out, weights) = forward(&packed, s, mask, dropout.as_ref().map(|(k, d)| (*k, d)));
        let out = make(out, &[s.batch, s.queries, s.width]);
        let out = match CrossOp.prepare::<NoCheckpointing>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let weights = weights_of(weights, s);
                prep.finish(State { q, kv: Some(kv), weights, sizes: s, mask: mask.cloned(), dropout }, out)
            }
            OpsKind::UnTracked(prep) => prep.finish(out),
        };
        Tensor::from_primitive::<Tracked>(out)
    }
}
