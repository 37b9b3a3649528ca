//! Attention over up to [`MOST`] tokens, all heads of all sequences in one call.
//!
//! The weights of a head are kept transposed, [K, Q rounded up], so that lanes of a register hold neighbouring queries.
//! The softmax over keys then needs no sum across lanes, and all products are those of [`tile`]. A head's operands stay
//! in the nearest cache. Weights of queries that are only rounding have no influence.

use super::kernel::{Attend, Packed};
use super::{HIDDEN, Sizes};
use crate::kernels::dropout::Factors;
use crate::kernels::simd::{LANES, Lanes, multiversion};
use crate::kernels::tile::{Left, multiply, transpose};

/// The longest sequence, of queries or of keys.
const MOST: usize = 64;

/// Returns true if attention of these sizes is computed here.
pub(super) fn fits(s: Sizes) -> bool {
    s.queries <= MOST && s.keys <= MOST && s.head().is_multiple_of(LANES)
}

/// The output [B, Q, H] and, if they are kept, the softmax weights before dropout: for each sequence and head [valid K,
/// Q rounded up].
pub(super) fn forward(attend: &Attend, packed: &Packed<'_>, keep: bool) -> (Vec<f32>, Vec<f32>) {
    let s = attend.sizes;
    let lanes = s.queries.next_multiple_of(LANES);
    let mut out = Vec::with_capacity(s.batch * s.queries * s.width);
    let kept = (0..s.batch).map(|b| attend.valid(b)).sum::<usize>() * s.heads * lanes;
    let mut weights = Vec::with_capacity(if keep { kept } else { s.keys * lanes });
    let mut scratch = Scratch::new(s);
    for b in 0..s.batch {
        let valid = attend.valid(b);
        let to = grow(&mut out, s.queries * s.width);
        for h in 0..s.heads {
            if !keep {
                weights.clear();
            }
            let weights = grow(&mut weights, valid * lanes);
            head_forward(s, packed, (b, h), valid, weights, &mut scratch);
            let dropped = dropped(attend, (b, h), valid, weights, &mut scratch);
            let values = if dropped { scratch.dropped.as_slice() } else { &*weights };
            head_out(s, packed, (b, h), valid, values, to);
        }
    }
    (out, if keep { weights } else { Vec::new() })
}

/// Appends `count` zeros and returns them.
fn grow(to: &mut Vec<f32>, count: usize) -> &mut [f32] {
    let from = to.len();
    to.resize(from + count, 0.0);
    &mut to[from..]
}

/// The gradients of queries, and of keys and values. The first holds all of them if they lie in one tensor. Keys of
/// padding have the gradient 0.
pub(super) fn backward(attend: &Attend, packed: &Packed<'_>, weights: &[f32], dout: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let s = attend.sizes;
    let lanes = s.queries.next_multiple_of(LANES);
    let mut dq = Vec::with_capacity(packed.q.len());
    let mut dkv = Vec::with_capacity(if packed.is_own() { 0 } else { packed.kv.len() });
    let mut scratch = Scratch::new(s);
    let mut rest = weights;
    for b in 0..s.batch {
        let valid = attend.valid(b);
        let to_q = grow(&mut dq, s.queries * packed.q_row);
        let to_kv = grow(&mut dkv, if packed.is_own() { 0 } else { s.keys * packed.kv_row });
        for h in 0..s.heads {
            let (weights, later) = rest.split_at(valid * lanes);
            rest = later;
            head_scores(s, packed, (b, h), valid, dout, &mut scratch);
            let has_dropout = dropped(attend, (b, h), valid, weights, &mut scratch);
            head_softmax(s, valid, weights, has_dropout, &mut scratch);
            head_queries(s, packed, (b, h), valid, &scratch, to_q);
            let to = if packed.is_own() { &mut *to_q } else { &mut *to_kv };
            let weights = if has_dropout { scratch.dropped.as_slice() } else { weights };
            head_keys_values(s, packed, (b, h), valid, dout, weights, &scratch, to);
        }
    }
    (dq, dkv)
}

/// Memory of one head at a time. Tables are [K, Q rounded up].
struct Scratch {
    /// Queries, or gradients of the output, by column.
    turned: Vec<f32>,
    /// Softmax weights after dropout.
    dropped: Vec<f32>,
    /// Factors of dropout.
    factors: Vec<f32>,
    /// Gradients of the scores.
    scores: Vec<f32>,
}

impl Scratch {
    fn new(s: Sizes) -> Self {
        let lanes = s.queries.next_multiple_of(LANES);
        let table = || vec![0.0; s.keys * lanes];
        Self { turned: vec![0.0; s.head() * lanes], dropped: table(), factors: table(), scores: table() }
    }
}

/// Places of a head in the operands.
struct Places {
    /// The first query of the sequence.
    q: usize,
    k: usize,
    v: usize,
    /// The first output of the sequence.
    out: usize,
}

impl Places {
    fn of(s: Sizes, packed: &Packed<'_>, (b, h): (usize, usize)) -> Self {
        let column = h * s.head();
        Self {
            q: b * s.queries * packed.q_row + column,
            k: b * s.keys * packed.kv_row + packed.k_at + column,
            v: b * s.keys * packed.kv_row + packed.v_at + column,
            out: b * s.queries * s.width + column,
        }
    }
}

/// Fills the factors and the dropped weights of a head if there is dropout.
fn dropped(attend: &Attend, (b, h): (usize, usize), valid: usize, weights: &[f32], scratch: &mut Scratch) -> bool {
    let Some(factors) = attend.dropout else { return false };
    let s = attend.sizes;
    // The place of a weight is that in [B, heads, Q, K].
    drop_weights(s, factors, (b * s.heads + h) * s.queries * s.keys, valid, weights, scratch);
    true
}

multiversion! {
    fn drop_weights(s: Sizes, factors: Factors, base: usize, valid: usize, weights: &[f32], scratch: &mut Scratch) {
        let lanes = s.queries.next_multiple_of(LANES);
        for j in 0..valid {
            let row = j * lanes..j * lanes + s.queries;
            let weights = &weights[row.clone()];
            let dropped = &mut scratch.dropped[row.clone()];
            let kept = &mut scratch.factors[row];
            for i in 0..s.queries {
                let factor = factors.of(base + i * s.keys + j);
                kept[i] = factor;
                dropped[i] = weights[i] * factor;
            }
        }
    }
}

multiversion! {
    /// The softmax weights of a head.
    fn head_forward<const SET>(s: Sizes, packed: &Packed<'_>, place: (usize, usize), valid: usize, weights: &mut [f32], scratch: &mut Scratch) {
        let at = Places::of(s, packed, place);
        let lanes = s.queries.next_multiple_of(LANES);
        transpose(&packed.q[at.q..], packed.q_row, (s.queries, s.head()), s.scale(), &mut scratch.turned);
        let keys = Left { values: &packed.kv[at.k..], row: packed.kv_row, col: 1 };
        multiply::<SET>((valid, lanes, s.head()), keys, (&scratch.turned, lanes), (&mut *weights, lanes));
        if s.causal {
            for (key, row) in weights.chunks_exact_mut(lanes).enumerate() {
                row[..key].fill(HIDDEN);
            }
        }
        // Cells of one register; those of one key are side by side.
        let cells = weights.as_chunks_mut::<LANES>().0;
        let across = lanes / LANES;
        for column in 0..across {
            let cell = |cells: &[[f32; LANES]], row: usize| Lanes::from(cells[row * across + column]);
            let mut most = Lanes::<SET>::splat(f32::NEG_INFINITY);
            for row in 0..valid {
                most = most.max(cell(cells, row));
            }
            let mut sum = Lanes::splat(0.0);
            for row in 0..valid {
                let v = (cell(cells, row) - most).exp();
                sum = sum + v;
                cells[row * across + column] = v.numbers();
            }
            let inverse = Lanes::splat(1.0) / sum;
            for row in 0..valid {
                cells[row * across + column] = (cell(cells, row) * inverse).numbers();
            }
        }
    }
}

multiversion! {
    /// The output of a head, into that of its sequence.
    fn head_out<const SET>(s: Sizes, packed: &Packed<'_>, place: (usize, usize), valid: usize, weights: &[f32], to: &mut [f32]) {
        let at = Places::of(s, packed, place);
        let lanes = s.queries.next_multiple_of(LANES);
        let weights = Left { values: weights, row: 1, col: lanes };
        let to = &mut to[place.1 * s.head()..];
        multiply::<SET>((s.queries, s.head(), valid), weights, (&packed.kv[at.v..], packed.kv_row), (to, s.width));
    }
}

multiversion! {
    /// The gradients of a head's weights.
    fn head_scores<const SET>(s: Sizes, packed: &Packed<'_>, place: (usize, usize), valid: usize, dout: &[f32], scratch: &mut Scratch) {
        let at = Places::of(s, packed, place);
        let lanes = s.queries.next_multiple_of(LANES);
        transpose(&dout[at.out..], s.width, (s.queries, s.head()), 1.0, &mut scratch.turned);
        let values = Left { values: &packed.kv[at.v..], row: packed.kv_row, col: 1 };
        multiply::<SET>((valid, lanes, s.head()), values, (&scratch.turned, lanes), (&mut scratch.scores, lanes));
    }
}

multiversion! {
    /// `ds = scale p (dp - sum(dp p))`, in place of the gradients of the weights.
    fn head_softmax<const SET>(s: Sizes, valid: usize, weights: &[f32], dropped: bool, scratch: &mut Scratch) {
        let lanes = s.queries.next_multiple_of(LANES);
        let scores = &mut scratch.scores[..valid * lanes];
        if dropped {
            for (score, factor) in scores.iter_mut().zip(&scratch.factors) {
                *score *= factor;
            }
        }
        let scale = s.scale();
        let weights = weights.as_chunks::<LANES>().0;
        let scores = scores.as_chunks_mut::<LANES>().0;
        let across = lanes / LANES;
        for column in 0..across {
            let cell = |cells: &[[f32; LANES]], row: usize| Lanes::<SET>::from(cells[row * across + column]);
            let mut dot = Lanes::splat(0.0);
            for row in 0..valid {
                dot = cell(weights, row).mul_add(cell(scores, row), dot);
            }
            for row in 0..valid {
                let ds = cell(weights, row) * Lanes::splat(scale) * (cell(scores, row) - dot);
                scores[row * across + column] = ds.numbers();
            }
        }
    }
}

multiversion! {
    /// The gradients of a head's queries.
    fn head_queries<const SET>(s: Sizes, packed: &Packed<'_>, place: (usize, usize), valid: usize, scratch: &Scratch, to: &mut [f32]) {
        let at = Places::of(s, packed, place);
        let scores = Left { values: &scratch.scores, row: 1, col: s.queries.next_multiple_of(LANES) };
        let to = &mut to[place.1 * s.head()..];
        multiply::<SET>((s.queries, s.head(), valid), scores, (&packed.kv[at.k..], packed.kv_row), (to, packed.q_row));
    }
}

multiversion! {
    /// The gradients of a head's keys and values.
    fn head_keys_values<const SET>(s: Sizes, packed: &Packed<'_>, place: (usize, usize), valid: usize, dout: &[f32], weights: &[f32], scratch: &Scratch, to: &mut [f32]) {
        let at = Places::of(s, packed, place);
        let lanes = s.queries.next_multiple_of(LANES);
        let by_key = |values| Left { values, row: lanes, col: 1 };
        let sizes = (valid, s.head(), s.queries);
        let column = place.1 * s.head();
        let keys = &mut to[packed.k_at + column..];
        multiply::<SET>(sizes, by_key(&scratch.scores), (&packed.q[at.q..], packed.q_row), (keys, packed.kv_row));
        let values = &mut to[packed.v_at + column..];
        multiply::<SET>(sizes, by_key(weights), (&dout[at.out..], s.width), (values, packed.kv_row));
    }
}
