//! `y = x W^T + b`, with W as published checkpoints store it: [out, in].

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::raw::{self, Place, Tracked, View, contiguous, make, matmul, slice};
#[cfg(feature = "flex")]
use super::simd::{add_rows, fill_rows};
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

/// `x` [..., in], `weight` [out, in], `bias` [out] -> [..., out].
pub fn linear<const D: usize>(x: Tensor<D>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<D> {
    #[cfg(feature = "flex")]
    match raw::place(&x, raw::on_tape(&weight) || bias.as_ref().is_some_and(raw::on_tape)) {
        Place::Tracked => return tracked(x, weight, bias),
        Place::Plain => {
            let shape = x.dims();
            let [out, _] = weight.dims();
            let (x, w) = (contiguous(raw::plain(x)), contiguous(raw::plain(weight)));
            let b = bias.map(|b| contiguous(raw::plain(b)));
            let y = forward(slice(&x), slice(&w), b.as_ref().map(slice), shape[D - 1], out);
            let mut to = shape;
            to[D - 1] = out;
            return Tensor::from_primitive::<Flex>(make(y, &to));
        }
        Place::Other => {}
    }
    let shape = x.dims();
    let [out, inner] = weight.dims();
    let rows = shape.iter().product::<usize>() / inner;
    let y = x.reshape([rows, inner]).matmul(weight.transpose());
    let y = match bias {
        Some(bias) => y + bias.unsqueeze(),
        None => y,
    };
    let mut to = shape;
    to[D - 1] = out;
    y.reshape(to)
}

#[cfg(feature = "flex")]
fn forward(x: &[f32], w: &[f32], b: Option<&[f32]>, inner: usize, out: usize) -> Vec<f32> {
    let rows = x.len() / inner;
    let mut y = vec![0.0; rows * out];
    if let Some(b) = b {
        fill_rows(&mut y, b);
    }
    let keep = if b.is_some() { 1.0 } else { 0.0 };
    matmul((rows, out, inner), x, View::rows(inner), w, View::rows(inner).t(), &mut y, View::rows(out), keep, 1.0);
    y
}

#[cfg(feature = "flex")]
#[derive(Debug)]
struct LinearOp {
    biased: bool,
}

#[cfg(feature = "flex")]
impl Backward<Flex, 3> for LinearOp {
    type State = (FlexTensor, FlexTensor, Vec<usize>);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let (x, w, shape) = ops.state;
        let [px, pw, pb] = ops.parents;
        let inner = shape[shape.len() - 1];
        let (x, w, dy) = (slice(&x), slice(&w), slice(&dy));
        let (rows, out) = (x.len() / inner, w.len() / inner);
        if let Some(node) = px {
            let mut dx = vec![0.0; x.len()];
            matmul((rows, inner, out), dy, View::rows(out), w, View::rows(inner), &mut dx, View::rows(inner), 0.0, 1.0);
            raw::register(grads, node.id, dx, &shape);
        }
        if let Some(node) = pw {
            let mut dw = vec![0.0; w.len()];
            matmul(
                (out, inner, rows),
                dy,
                View::rows(out).t(),
                x,
                View::rows(inner),
                &mut dw,
                View::rows(inner),
                0.0,
                1.0,
            );
            raw::register(grads, node.id, dw, &[out, inner]);
        }
        if let (Some(node), true) = (pb, self.biased) {
            let mut db = vec![0.0; out];
            add_rows(&mut db, dy);
            raw::register(grads, node.id, db, &[out]);
        }
    }
}

#[cfg(feature = "flex")]
fn tracked<const D: usize>(x: Tensor<D>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<D> {
    let device = x.device();
    let (shape, [out, inner]) = (x.dims(), weight.dims());
    assert_eq!(shape[D - 1], inner, "linear: input width against weight");
    let biased = bias.is_some();
    // Without a bias the third parent is an unused constant.
    let bias = bias.unwrap_or_else(|| Tensor::zeros([1], &device));
    let x = raw::track(x);
    let w = raw::track(weight);
    let b = raw::track(bias);
    let nodes = [x.node(), w.node(), b.node()];
    let (x, w, b) = (contiguous(x.into_primitive()), contiguous(w.into_primitive()), contiguous(b.into_primitive()));
    let mut to = shape;
    to[D - 1] = out;
    let y = make(forward(slice(&x), slice(&w), biased.then(|| slice(&b)), inner, out), &to);
    let y = match (LinearOp { biased }).prepare::<NoCheckpointing>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prep) => prep.finish((x, w, shape.to_vec()), y),
        OpsKind::UnTracked(prep) => prep.finish(y),
    };
    Tensor::from_primitive::<Tracked>(y)
}
