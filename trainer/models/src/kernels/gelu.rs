//! GELU, exact: `x Phi(x)` with Phi the normal distribution function (Hendrycks and Gimpel, arXiv:1606.08415, not its
//! tanh approximation).

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::raw::{self, Place, Tracked, contiguous, make, slice};
#[cfg(feature = "flex")]
use super::simd::{erf, exp, multiversion};
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

/// GELU of every element.
pub fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
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
    // Composed, because on some backends Burn's GELU has the gradient of the tanh approximation. Measured on ndarray:
    // gradients of a denoiser differ by 2e-4 of the largest.
    let cdf = (x.clone() * std::f32::consts::FRAC_1_SQRT_2).erf() + 1.0;
    x * cdf * 0.5
}

#[cfg(feature = "flex")]
multiversion! {
    fn forward(x: &[f32], y: &mut [f32]) {
        for (y, x) in y.iter_mut().zip(x) {
            *y = 0.5 * x * (1.0 + erf(x * std::f32::consts::FRAC_1_SQRT_2));
        }
    }
}

#[cfg(feature = "flex")]
multiversion! {
    fn backward(x: &[f32], dy: &[f32], dx: &mut [f32]) {
        const DENSITY: f32 = 0.398_942_3;
        for ((dx, x), dy) in dx.iter_mut().zip(x).zip(dy) {
            let cdf = 0.5 * (1.0 + erf(x * std::f32::consts::FRAC_1_SQRT_2));
            *dx = dy * (cdf + x * DENSITY * exp(-0.5 * x * x));
        }
    }
}

#[cfg(feature = "flex")]
#[derive(Debug)]
struct GeluOp;

#[cfg(feature = "flex")]
impl Backward<Flex, 1> for GeluOp {
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
    let y = match GeluOp.prepare::<NoCheckpointing>([node]).compute_bound().stateful() {
        OpsKind::Tracked(prep) => prep.finish((x, shape.to_vec()), y),
        OpsKind::UnTracked(prep) => prep.finish(y),
    };
    Tensor::from_primitive::<Tracked>(y)
}
