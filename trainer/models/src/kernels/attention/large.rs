//! Attention over sequences of any length: matrix products on strided views of the packed projections.

use super::kernel::{Attend, Packed};
use super::{HIDDEN, Sizes};
use crate::kernels::raw::{Start, View, matmul};
use crate::kernels::simd::{Lanes, multiversion, update};

impl Packed<'_> {
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

multiversion! {
    /// Softmax of the first `valid` columns of each row; the rest becomes 0.
    fn softmax_rows<const SET>(scores: &mut [f32], keys: usize, valid: usize) {
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
            let most = Lanes::splat(most);
            update::<SET, 0>(live, [], |v, []| (v - most).exp());
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
pub(super) fn forward(attend: &Attend, packed: &Packed<'_>) -> (Vec<f32>, Vec<f32>) {
    let s = attend.sizes;
    let mut weights = vec![0.0; s.batch * s.heads * s.queries * s.keys];
    let mut out = vec![0.0; s.batch * s.queries * s.width];
    let mut dropped = Vec::new();
    for b in 0..s.batch {
        let valid = attend.valid(b);
        for h in 0..s.heads {
            let (at, q, k, v) =
                (weight_view(s, b, h), packed.q_view(s, b, h), packed.k_view(s, b, h), packed.v_view(s, b, h));
            matmul(
                (s.queries, valid, s.head()),
                packed.q,
                q,
                packed.kv,
                k.t(),
                &mut weights,
                at,
                Start::Zero,
                s.scale(),
            );
            let range = at.offset..at.offset + s.queries * s.keys;
            if s.causal {
                for (query, row) in weights[range.clone()].chunks_exact_mut(s.keys).enumerate() {
                    row[(query + 1).min(s.keys)..].fill(HIDDEN);
                }
            }
            softmax_rows(&mut weights[range.clone()], s.keys, valid);
            let (p, pv) = match &attend.dropout {
                None => (&weights[..], at),
                Some(factors) => {
                    dropped.clear();
                    dropped.extend(range.map(|i| weights[i] * factors.of(i)));
                    (&dropped[..], View::rows(s.keys))
                }
            };
            let to = out_view(s, b, h);
            matmul((s.queries, s.head(), valid), p, pv, packed.kv, v, &mut out, to, Start::Zero, 1.0);
        }
    }
    (out, weights)
}

/// The gradients of queries, and of keys and values. The first holds all of them if they lie in one tensor.
pub(super) fn backward(attend: &Attend, packed: &Packed<'_>, weights: &[f32], dout: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let s = attend.sizes;
    let mut dq = vec![0.0; packed.q.len()];
    let mut dkv = vec![0.0; if packed.is_own() { 0 } else { packed.kv.len() }];
    let mut scores = vec![0.0; s.queries * s.keys];
    let mut dropped = vec![0.0; s.queries * s.keys];
    let by_keys = View::rows(s.keys);
    for b in 0..s.batch {
        let valid = attend.valid(b);
        for h in 0..s.heads {
            let at = weight_view(s, b, h);
            let out = out_view(s, b, h);
            let q = packed.q_view(s, b, h);
            let k = packed.k_view(s, b, h);
            let v = packed.v_view(s, b, h);
            let p = &weights[at.offset..at.offset + s.queries * s.keys];
            scores.fill(0.0);
            matmul((s.queries, valid, s.head()), dout, out, packed.kv, v.t(), &mut scores, by_keys, Start::Zero, 1.0);
            match &attend.dropout {
                None => dropped.copy_from_slice(p),
                Some(factors) => {
                    for (i, (d, score)) in dropped.iter_mut().zip(&mut scores).enumerate() {
                        let kept = factors.of(at.offset + i);
                        *d = p[i] * kept;
                        *score *= kept;
                    }
                }
            }
            softmax_backward_rows(p, &mut scores, s.keys);
            matmul((s.queries, s.head(), valid), &scores, by_keys, packed.kv, k, &mut dq, q, Start::Zero, s.scale());
            let to = if packed.is_own() { &mut dq } else { &mut dkv };
            matmul((valid, s.head(), s.queries), &scores, by_keys.t(), packed.q, q, to, k, Start::Zero, s.scale());
            matmul((valid, s.head(), s.queries), &dropped, by_keys.t(), dout, out, to, v, Start::Zero, 1.0);
        }
    }
    (dq, dkv)
}
