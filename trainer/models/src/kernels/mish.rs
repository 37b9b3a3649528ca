//! Mish: `x tanh(ln(1 + e^x))` (Misra, arXiv:1908.08681).
//!
//! `tanh(ln(1 + u)) = u (u + 2) / (u (u + 2) + 2)` with `u = e^x`, so one exponential is enough. The fused path
//! computes `e^(-|x|)` and divides both sides by `e^(2x)` for positive x. The composed path caps x at 20, above which
//! the quotient rounds to 1.

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::raw::{self, Place, Tracked, contiguous, make, slice};
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

/// Upper limit of the exponent in the composed path.
const CAP: f32 = 20.0;

/// Mish of every element.
pub fn mish<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "flex")]
    match raw::place(&x, false) {
        Place::Tracked => return tracked(x),
        Place::Plain => {
            let shape = x.dims();
            let x = contiguous(raw::plain(x));
            let mut y = vec![0.0; shape.iter().product()];
            forward(slice(&x), &mut y);
            return Tensor::from_primitive::<Flex>(make(y, &shape));
        }
        Place::Other => {}
    }
    let e = x.clone().clamp_max(CAP).exp();
    let n = e.clone() * (e + 2.0);
    x * n.clone() / (n + 2.0)
}

#[cfg(feature = "flex")]
multiversion! {
    fn forward(x: &[f32], y: &mut [f32]) {
        for (y, x) in y.iter_mut().zip(x) {
            let e = exp(-x.abs());
            let (top, rest) = if *x < 0.0 { (e * (e + 2.0), 2.0) } else { (1.0 + 2.0 * e, 2.0 * e * e) };
            *y = x * (top / (top + rest));
        }
    }
}

#[cfg(feature = "flex")]
multiversion! {
    fn backward(x: &[f32], dy: &[f32], dx: &mut [f32]) {
        for ((dx, x), dy) in dx.iter_mut().zip(x).zip(dy) {
            let e = exp(-x.abs());
            let (top, rest, slope) =
                if *x < 0.0 { (e * (e + 2.0), 2.0, e) } else { (1.0 + 2.0 * e, 2.0 * e * e, e * e) };
            let q = 1.0 / (top + rest);
            *dx = dy * (top * q + x * 4.0 * (1.0 + e) * slope * q * q);
        }
    }
}

#[cfg(feature = "flex")]
#[derive(Debug)]
struct MishOp;

#[cfg(feature = "flex")]
impl Backward<Flex, 1> for MishOp {
    type State = (FlexTensor, Vec<usize>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let (x, shape) = ops.state;
        let [parent] = ops.parents;
        if let Some(node) = parent {
            let mut dx = vec![0.0; slice(&x).len()];
            backward(slice(&x), slice(&dy), &mut dx);
            raw::register(grads, node.id, dx, &shape);
        }
    }
}

#[cfg(feature = "flex")]
fn tracked<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let shape = x.dims();
    let x = raw::track(x);
    let node = x.node();
    let x = contiguous(x.into_primitive());
    let mut y = vec![0.0; shape.iter().product()];
    forward(slice(&x), &mut y);
    let y = make(y, &shape);
    let y = match MishOp.prepare::<NoCheckpointing>([node]).compute_bound().stateful() {
        OpsKind::Tracked(prep) => prep.finish((x, shape.to_vec()), y),
        OpsKind::UnTracked(prep) => prep.finish(y),
    };
    Tensor::from_primitive::<Tracked>(y)
}
