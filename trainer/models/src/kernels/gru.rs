//! One direction of a layer of gated recurrent units over ragged sequences (Cho et al., arXiv:1406.1078, in PyTorch's
//! form).
//!
//! `r = s(a_r + u_r)`, `z = s(a_z + u_z)`, `n = tanh(a_n + r u_n)`, `h' = (1 - z) n + z h`. `a` is the input's part of
//! the gates and `u = h U^T + c` the state's part. A token past a sequence's end leaves the state unchanged. So the
//! forward direction stops at a sequence's own last token and the backward direction starts there.
//!
//! Fused: a whole direction is one node of the tape. A turn computes only the sequences that have its token. The gates
//! are kept, and the gradient of U is one product over all tokens.

use burn::tensor::{Tensor, TensorData, activation::sigmoid};

#[cfg(feature = "flex")]
use super::fused;

/// Returns the states [B, T, g] after each token. `input` [B, T, 3g] holds the input's part of the gates and `start`
/// [B, g] the first states. `weight` [3g, g] and `bias` [3g] compute the state's part. The first `lengths[b]` tokens of
/// sequence b are valid. `reverse` runs from the last token to the first.
pub fn gru(
    input: Tensor<3>,
    start: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
    lengths: &[usize],
    reverse: bool,
) -> Tensor<3> {
    let [batch, tokens, gates] = input.dims();
    let [rows, width] = weight.dims();
    assert!(gates == 3 * width && rows == gates && bias.dims() == [gates], "gru: gates are thrice the width");
    assert!(start.dims() == [batch, width] && lengths.len() == batch, "gru: a state and a length for each sequence");
    assert!(lengths.iter().all(|l| *l <= tokens), "gru: a length beyond the tokens");
    #[cfg(feature = "flex")]
    if fused::takes(&input) {
        let unit = kernel::Gru { batch, tokens, width, reverse, lengths: lengths.to_vec() };
        return fused::run(unit, [input.into(), start.into(), weight.into(), bias.into()]);
    }
    composed(input, start, weight, bias, lengths, reverse)
}

fn composed(
    input: Tensor<3>,
    start: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
    lengths: &[usize],
    reverse: bool,
) -> Tensor<3> {
    let [batch, tokens, gates] = input.dims();
    let width = gates / 3;
    let device = input.device();
    let part = |x: &Tensor<2>, k: usize| x.clone().slice([0..batch, k * width..(k + 1) * width]);
    let mut states = vec![start.clone(); tokens];
    let mut state = start;
    for i in 0..tokens {
        let t = if reverse { tokens - 1 - i } else { i };
        let a = input.clone().slice([0..batch, t..t + 1, 0..gates]).reshape([batch, gates]);
        let u = state.clone().matmul(weight.clone().transpose()) + bias.clone().unsqueeze();
        let r = sigmoid(part(&a, 0) + part(&u, 0));
        let z = sigmoid(part(&a, 1) + part(&u, 1));
        let n = (part(&a, 2) + r * part(&u, 2)).tanh();
        let next = n.clone() - z.clone() * n + z * state.clone();
        let live: Vec<f32> = lengths.iter().map(|l| if t < *l { 1.0 } else { 0.0 }).collect();
        let live = Tensor::<2>::from_data(TensorData::new(live, [batch, 1]), &device);
        // A mask of 0 and 1 makes this a selection, not a mixture.
        state = next * live.clone() + state * (-live + 1.0);
        states[t] = state.clone();
    }
    Tensor::stack(states, 1)
}

#[cfg(feature = "flex")]
mod kernel {
    use burn::backend::flex::FlexTensor;

    use crate::kernels::fused::{Fused, Places, column_sums, make, slice};
    use crate::kernels::raw::{Start, View, affine, matmul, product_to};
    use crate::kernels::simd::{Lanes, multiversion, update};

    /// One direction over a batch.
    #[derive(Debug, Clone)]
    pub(super) struct Gru {
        pub(super) batch: usize,
        pub(super) tokens: usize,
        pub(super) width: usize,
        pub(super) reverse: bool,
        pub(super) lengths: Vec<usize>,
    }

    impl Gru {
        /// The token that turn `i` processes.
        fn token(&self, i: usize) -> usize {
            if self.reverse { self.tokens - 1 - i } else { i }
        }

        /// The sequences, the longest first. The first of them are those that a turn works on.
        fn order(&self) -> Vec<usize> {
            let mut order: Vec<usize> = (0..self.batch).collect();
            order.sort_by_key(|b| std::cmp::Reverse(self.lengths[*b]));
            order
        }

        /// Number of sequences that have a token `t`.
        fn live(&self, t: usize) -> usize {
            self.lengths.iter().filter(|length| **length > t).count()
        }

        /// The place of the state after token `t` of sequence `b` in [B, T, g].
        fn place(&self, b: usize, t: usize) -> std::ops::Range<usize> {
            let at = (b * self.tokens + t) * self.width;
            at..at + self.width
        }
    }

    /// What the backward pass reads of a forward pass: one row for each token of each sequence, by turn.
    #[derive(Debug, Clone)]
    pub(super) struct Run {
        /// The state before, [g].
        olds: Vec<f32>,
        /// r, z, n, u_n, [4g].
        gates: Vec<f32>,
    }

    /// The states [B, T, g], and the run.
    fn forward(shape: &Gru, input: &[f32], start: &[f32], weight: &[f32], bias: &[f32]) -> (Vec<f32>, Run) {
        let &Gru { batch, tokens, width, .. } = shape;
        let order = shape.order();
        let rows = shape.lengths.iter().sum::<usize>();
        let mut run = Run { olds: Vec::with_capacity(rows * width), gates: vec![0.0; rows * 4 * width] };
        let mut states = vec![0.0; batch * tokens * width];
        let mut now: Vec<f32> = order.iter().flat_map(|b| &start[b * width..(b + 1) * width]).copied().collect();
        // In this order the product reads the weights where they lie, instead of copying them in every turn.
        let mut by_input = vec![0.0; weight.len()];
        for (gate, row) in weight.chunks_exact(width).enumerate() {
            row.iter().enumerate().for_each(|(k, w)| by_input[k * 3 * width + gate] = *w);
        }
        let by_row = View::rows(width);
        let by_gate = View::rows(3 * width);
        for t in (0..tokens).map(|i| shape.token(i)) {
            let live = shape.live(t);
            let first = run.olds.len() / width;
            run.olds.extend_from_slice(&now[..live * width]);
            let olds = &run.olds[first * width..];
            let u = affine((live, 3 * width, width), olds, by_row, &by_input, by_gate, bias);
            for (j, (b, new)) in order.iter().zip(now.chunks_exact_mut(width)).enumerate() {
                if j < live {
                    let a = &input[(b * tokens + t) * 3 * width..][..3 * width];
                    let gates = &mut run.gates[(first + j) * 4 * width..][..4 * width];
                    unit(a, &u[j * 3 * width..][..3 * width], &olds[j * width..][..width], gates, new);
                }
                states[shape.place(*b, t)].copy_from_slice(new);
            }
        }
        (states, run)
    }

    #[inline(always)]
    fn tanh<const SET: u8>(x: Lanes<SET>) -> Lanes<SET> {
        let one = Lanes::splat(1.0);
        let e = (Lanes::splat(-2.0) * x.abs()).exp();
        let size = (one - e) / (one + e);
        x.by_sign(Lanes::splat(0.0) - size, size)
    }

    multiversion! {
        /// Computes one token of one sequence.
        fn unit<const SET>(a: &[f32], u: &[f32], old: &[f32], gates: &mut [f32], new: &mut [f32]) {
            let g = old.len();
            let a_r = &a[..g];
            let a_z = &a[g..2 * g];
            let a_n = &a[2 * g..3 * g];
            let u_r = &u[..g];
            let u_z = &u[g..2 * g];
            let u_n = &u[2 * g..3 * g];
            let (gate_r, rest) = gates.split_at_mut(g);
            let (gate_z, rest) = rest.split_at_mut(g);
            let (gate_n, kept) = rest.split_at_mut(g);
            let new = &mut new[..g];
            let kept = &mut kept[..g];
            update::<SET, 2>(gate_r, [a_r, u_r], |_, [a, u]| (a + u).logistic());
            update::<SET, 2>(gate_z, [a_z, u_z], |_, [a, u]| (a + u).logistic());
            update::<SET, 3>(gate_n, [a_n, gate_r, u_n], |_, [a, r, u]| tanh(a + r * u));
            update::<SET, 3>(new, [gate_z, gate_n, old], |_, [z, n, old]| (Lanes::splat(1.0) - z) * n + z * old);
            kept.copy_from_slice(u_n);
        }
    }

    multiversion! {
        /// The backward pass of [`unit`]. `dh` enters as the gradient of the state after the token. It leaves as the direct
        /// part of the gradient of the state before it, without the part through the gates.
        fn unit_back(gates: &[f32], old: &[f32], dh: &mut [f32], da: &mut [f32], du: &mut [f32]) {
            let g = old.len();
            let gate_r = &gates[..g];
            let gate_z = &gates[g..2 * g];
            let gate_n = &gates[2 * g..3 * g];
            let kept = &gates[3 * g..4 * g];
            let (da_r, rest) = da.split_at_mut(g);
            let (da_z, da_n) = rest.split_at_mut(g);
            let (du_r, rest) = du.split_at_mut(g);
            let (du_z, du_n) = rest.split_at_mut(g);
            let dh = &mut dh[..g];
            let da_n = &mut da_n[..g];
            let du_n = &mut du_n[..g];
            for k in 0..g {
                let r = gate_r[k];
                let z = gate_z[k];
                let n = gate_n[k];
                let pre_n = dh[k] * (1.0 - z) * (1.0 - n * n);
                let pre_z = dh[k] * (old[k] - n) * z * (1.0 - z);
                let pre_r = pre_n * kept[k] * r * (1.0 - r);
                da_r[k] = pre_r;
                da_z[k] = pre_z;
                da_n[k] = pre_n;
                du_r[k] = pre_r;
                du_z[k] = pre_z;
                du_n[k] = pre_n * r;
                dh[k] *= z;
            }
        }
    }

    impl Fused<4> for Gru {
        type Kept = (Run, FlexTensor);

        fn forward(&self, [input, start, weight, bias]: [FlexTensor; 4]) -> (FlexTensor, Self::Kept) {
            let (states, run) = forward(self, slice(&input), slice(&start), slice(&weight), slice(&bias));
            (make(states, &[self.batch, self.tokens, self.width]), (run, weight))
        }

        fn backward_to(
            &self,
            (run, weight): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 4],
            [_, _, of_weight, of_bias]: Places<'_, 4>,
        ) -> [Option<FlexTensor>; 4] {
            let shape = self;
            let &Gru { batch, tokens, width, .. } = shape;
            let order = shape.order();
            let Run { olds, gates } = &run;
            let dy = slice(&dy);
            let mut dh = vec![0.0; batch * width];
            let mut da = vec![0.0; 3 * batch * width * tokens];
            let mut du = vec![0.0; 3 * olds.len()];
            let by_row = View::rows(width);
            let by_gate = View::rows(3 * width);
            let mut end = olds.len() / width;
            for t in (0..tokens).rev().map(|i| shape.token(i)) {
                let live = shape.live(t);
                let first = end - live;
                for (j, (b, dh)) in order.iter().zip(dh.chunks_exact_mut(width)).enumerate() {
                    dh.iter_mut().zip(&dy[shape.place(*b, t)]).for_each(|(d, y)| *d += y);
                    if j < live {
                        let row = first + j;
                        let da = &mut da[(b * tokens + t) * 3 * width..][..3 * width];
                        let gates = &gates[row * 4 * width..][..4 * width];
                        unit_back(
                            gates,
                            &olds[row * width..][..width],
                            dh,
                            da,
                            &mut du[row * 3 * width..][..3 * width],
                        );
                    }
                }
                let du = &du[first * 3 * width..end * 3 * width];
                matmul(
                    (live, width, 3 * width),
                    du,
                    by_gate,
                    slice(&weight),
                    by_row,
                    &mut dh,
                    by_row,
                    Start::Kept,
                    1.0,
                );
                end = first;
            }
            let by_weight = || {
                let rows = olds.len() / width;
                let dw = match rows {
                    0 => Some(vec![0.0; 3 * width * width]),
                    _ => product_to((3 * width, width, rows), &du, by_gate.t(), olds, by_row, of_weight),
                };
                dw.map(|dw| make(dw, &[3 * width, width]))
            };
            let by_bias = || column_sums(&du, 3 * width, of_bias);
            let mut dstart = vec![0.0; batch * width];
            for (b, dh) in order.iter().zip(dh.chunks_exact(width)) {
                dstart[b * width..(b + 1) * width].copy_from_slice(dh);
            }
            let weight = wanted[2].then(by_weight).flatten();
            let bias = wanted[3].then(by_bias).flatten();
            [Some(make(da, &[batch, tokens, 3 * width])), Some(make(dstart, &[batch, width])), weight, bias]
        }
    }
}
