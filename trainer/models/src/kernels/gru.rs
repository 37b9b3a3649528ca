//! One direction of a layer of gated recurrent units over ragged sequences (Cho et al., arXiv:1406.1078, in PyTorch's
//! form).
//!
//! `r = s(a_r + u_r)`, `z = s(a_z + u_z)`, `n = tanh(a_n + r u_n)`, `h' = (1 - z) n + z h`. `a` is the input's part of
//! the gates and `u = h U^T + c` the state's part. A token past a sequence's end leaves the state unchanged. So the
//! forward direction stops at a sequence's own last token and the backward direction starts there.
//!
//! Fused: a whole direction is one node of the tape. The gates are kept, and the gradient of U is one product over all
//! tokens.

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

    use crate::kernels::fused::{Fused, make, slice};
    use crate::kernels::raw::{View, matmul, product};
    use crate::kernels::simd::{add_rows, exp, multiversion};

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

        /// Reorders states from [turn, B, g] to [B, T, g].
        fn by_sequence(&self, states: &[f32]) -> Vec<f32> {
            let size = self.batch * self.width;
            let width = self.width;
            let mut out = vec![0.0; states.len()];
            for i in 0..self.tokens {
                for b in 0..self.batch {
                    let to = (b * self.tokens + self.token(i)) * width;
                    out[to..to + width].copy_from_slice(&states[i * size + b * width..][..width]);
                }
            }
            out
        }
    }

    /// The results of a forward pass by turn: states after it [turn, B, g], and r, z, n, u_n [turn, B, 4g].
    #[derive(Debug, Clone)]
    pub(super) struct Run {
        states: Vec<f32>,
        gates: Vec<f32>,
    }

    fn forward(shape: &Gru, input: &[f32], start: &[f32], weight: &[f32], bias: &[f32]) -> Run {
        let &Gru { batch, tokens, width, .. } = shape;
        let size = batch * width;
        let mut run = Run { states: vec![0.0; tokens * size], gates: vec![0.0; tokens * size * 4] };
        let mut u = Vec::with_capacity(3 * size);
        for i in 0..tokens {
            let t = shape.token(i);
            let (before, after) = run.states.split_at_mut(i * size);
            let old = if i == 0 { start } else { &before[(i - 1) * size..] };
            u.clear();
            (0..batch).for_each(|_| u.extend_from_slice(bias));
            let by_row = View::rows(width);
            let by_gate = View::rows(3 * width);
            matmul((batch, 3 * width, width), old, by_row, weight, by_row.t(), &mut u, by_gate, 1.0, 1.0);
            for b in 0..batch {
                let old = &old[b * width..][..width];
                let new = &mut after[b * width..][..width];
                if t < shape.lengths[b] {
                    let a = &input[(b * tokens + t) * 3 * width..][..3 * width];
                    let gates = &mut run.gates[(i * batch + b) * 4 * width..][..4 * width];
                    unit(a, &u[b * 3 * width..][..3 * width], old, gates, new);
                } else {
                    new.copy_from_slice(old);
                }
            }
        }
        run
    }

    #[inline(always)]
    fn logistic(x: f32) -> f32 {
        let e = exp(-x.abs());
        let s = 1.0 / (1.0 + e);
        if x >= 0.0 { s } else { e * s }
    }

    #[inline(always)]
    fn tanh(x: f32) -> f32 {
        let e = exp(-2.0 * x.abs());
        ((1.0 - e) / (1.0 + e)).copysign(x)
    }

    multiversion! {
        /// Computes one token of one sequence.
        fn unit(a: &[f32], u: &[f32], old: &[f32], gates: &mut [f32], new: &mut [f32]) {
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
            for k in 0..g {
                let r = logistic(a_r[k] + u_r[k]);
                let z = logistic(a_z[k] + u_z[k]);
                let n = tanh(a_n[k] + r * u_n[k]);
                new[k] = (1.0 - z) * n + z * old[k];
                gate_r[k] = r;
                gate_z[k] = z;
                gate_n[k] = n;
                kept[k] = u_n[k];
            }
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
        type Kept = (Run, FlexTensor, FlexTensor);

        fn forward(&self, [input, start, weight, bias]: [FlexTensor; 4]) -> (FlexTensor, Self::Kept) {
            let run = forward(self, slice(&input), slice(&start), slice(&weight), slice(&bias));
            let states = make(self.by_sequence(&run.states), &[self.batch, self.tokens, self.width]);
            (states, (run, start, weight))
        }

        fn backward(
            &self,
            (run, start, weight): Self::Kept,
            dy: FlexTensor,
            wanted: [bool; 4],
        ) -> [Option<FlexTensor>; 4] {
            let shape = self;
            let &Gru { batch, tokens, width, .. } = shape;
            let dy = slice(&dy);
            let start = slice(&start);
            let weight = slice(&weight);
            let size = batch * width;
            let mut dh = vec![0.0; size];
            let mut da = vec![0.0; 3 * size * tokens];
            let mut du = vec![0.0; 3 * size * tokens];
            // The states before each turn.
            let mut olds = Vec::with_capacity(size * tokens);
            olds.extend_from_slice(start);
            olds.extend_from_slice(&run.states[..size * tokens.saturating_sub(1)]);
            for i in (0..tokens).rev() {
                let t = shape.token(i);
                let du = &mut du[i * 3 * size..][..3 * size];
                for b in 0..batch {
                    let dh = &mut dh[b * width..][..width];
                    for (d, y) in dh.iter_mut().zip(&dy[(b * tokens + t) * width..][..width]) {
                        *d += y;
                    }
                    if t < shape.lengths[b] {
                        let da = &mut da[(b * tokens + t) * 3 * width..][..3 * width];
                        let gates = &run.gates[(i * batch + b) * 4 * width..][..4 * width];
                        let old = &olds[i * size + b * width..][..width];
                        unit_back(gates, old, dh, da, &mut du[b * 3 * width..][..3 * width]);
                    }
                }
                let by_row = View::rows(width);
                let by_gate = View::rows(3 * width);
                matmul((batch, width, 3 * width), du, by_gate, weight, by_row, &mut dh, by_row, 1.0, 1.0);
            }
            let by_weight = || {
                let by_row = View::rows(width);
                let by_gate = View::rows(3 * width);
                make(product((3 * width, width, tokens * batch), &du, by_gate.t(), &olds, by_row), &[3 * width, width])
            };
            let by_bias = || {
                let mut db = vec![0.0; 3 * width];
                add_rows(&mut db, &du);
                make(db, &[3 * width])
            };
            let weight = wanted[2].then(by_weight);
            let bias = wanted[3].then(by_bias);
            [Some(make(da, &[batch, tokens, 3 * width])), Some(make(dh, &[batch, width])), weight, bias]
        }
    }
}
