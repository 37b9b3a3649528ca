//! Layer normalisation over the last axis (Ba et al., arXiv:1607.06450), alone or after a residual addition.

use burn::tensor::Tensor;

#[cfg(feature = "flex")]
use super::raw::{self, Place, Tracked, contiguous, make, slice};
#[cfg(feature = "flex")]
use super::simd::multiversion;
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

/// `gamma (x - mean) / sqrt(var + eps) + beta` over the last axis, with the population variance.
pub fn layer_norm<const D: usize>(x: Tensor<D>, gamma: Tensor<1>, beta: Tensor<1>, eps: f64) -> Tensor<D> {
    normalise(x, None, gamma, beta, eps)
}

/// `layer_norm(x + y)`: the residual addition and the norm in one pass.
pub fn add_layer_norm<const D: usize>(
    x: Tensor<D>,
    y: Tensor<D>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    eps: f64,
) -> Tensor<D> {
    normalise(x, Some(y), gamma, beta, eps)
}

fn normalise<const D: usize>(
    x: Tensor<D>,
    y: Option<Tensor<D>>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    eps: f64,
) -> Tensor<D> {
    #[cfg(feature = "flex")]
    match raw::place(&x, raw::on_tape(&gamma) || raw::on_tape(&beta) || y.as_ref().is_some_and(raw::on_tape)) {
        Place::Tracked => return tracked(x, y, gamma, beta, eps),
        Place::Plain => {
            let shape = x.dims();
            let (x, gamma, beta) =
                (contiguous(raw::plain(x)), contiguous(raw::plain(gamma)), contiguous(raw::plain(beta)));
            let mut hat = match y {
                Some(y) => sum(slice(&x), slice(&contiguous(raw::plain(y)))),
                None => slice(&x).to_vec(),
            };
            let width = shape[D - 1];
            let mut scales = vec![0.0; hat.len() / width];
            standardise(&mut hat, &mut scales, eps);
            scale_shift(&mut hat, slice(&gamma), slice(&beta));
            return Tensor::from_primitive::<Flex>(make(hat, &shape));
        }
        Place::Other => {}
    }
    let x = match y {
        Some(y) => x + y,
        None => x,
    };
    let centred = x.clone() - x.mean_dim(D - 1);
    let variance = centred.clone().powi_scalar(2).mean_dim(D - 1);
    centred / (variance + eps).sqrt() * gamma.unsqueeze() + beta.unsqueeze()
}

#[cfg(feature = "flex")]
multiversion! {
    fn sum(x: &[f32], y: &[f32]) -> Vec<f32> {
        x.iter().zip(y).map(|(x, y)| x + y).collect()
    }
}

/// Sums in 16 lanes, then adds the lanes in order. It vectorises and has one order for all widths.
#[cfg(feature = "flex")]
#[inline(always)]
fn lanes(mut items: impl FnMut(usize) -> f32, width: usize) -> f32 {
    let mut lane = [0.0_f32; 16];
    let whole = width / 16 * 16;
    let mut i = 0;
    while i < whole {
        for (l, slot) in lane.iter_mut().enumerate() {
            *slot += items(i + l);
        }
        i += 16;
    }
    let mut rest = 0.0;
    while i < width {
        rest += items(i);
        i += 1;
    }
    lane.iter().sum::<f32>() + rest
}

#[cfg(feature = "flex")]
multiversion! {
    /// Each row of `x` becomes `(x - mean) / sqrt(var + eps)`; `scales` gets `1 / sqrt(var + eps)`.
    fn standardise(x: &mut [f32], scales: &mut [f32], eps: f64) {
        let width = x.len() / scales.len();
        #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "a width is small; eps is a setting")]
        let (count, eps) = (width as f32, eps as f32);
        for (row, scale) in x.chunks_exact_mut(width).zip(scales) {
            let mean = lanes(|i| row[i], width) / count;
            for v in row.iter_mut() {
                *v -= mean;
            }
            let variance = lanes(|i| row[i] * row[i], width) / count;
            *scale = 1.0 / (variance + eps).sqrt();
            for v in row.iter_mut() {
                *v *= *scale;
            }
        }
    }
}

#[cfg(feature = "flex")]
multiversion! {
    fn scale_shift(x: &mut [f32], gamma: &[f32], beta: &[f32]) {
        for row in x.chunks_exact_mut(gamma.len()) {
            for ((v, g), b) in row.iter_mut().zip(gamma).zip(beta) {
                *v = *v * g + b;
            }
        }
    }
}

#[cfg(feature = "flex")]
multiversion! {
    /// `dx = scale (g - mean(g) - hat mean(g hat))` with `g = dy gamma`; adds to `dgamma` and `dbeta`.
    fn backward(hat: &[f32], scales: &[f32], gamma: &[f32], dy: &[f32], dx: &mut [f32], dgamma: &mut [f32], dbeta: &mut [f32]) {
        let width = gamma.len();
        #[expect(clippy::cast_precision_loss, reason = "a width is small")]
        let count = width as f32;
        for (((hat, dy), dx), scale) in
            hat.chunks_exact(width).zip(dy.chunks_exact(width)).zip(dx.chunks_exact_mut(width)).zip(scales)
        {
            for i in 0..width {
                dgamma[i] += dy[i] * hat[i];
                dbeta[i] += dy[i];
            }
            let first = lanes(|i| dy[i] * gamma[i], width) / count;
            let second = lanes(|i| dy[i] * gamma[i] * hat[i], width) / count;
            for i in 0..width {
                dx[i] = scale * (dy[i] * gamma[i] - first - hat[i] * second);
            }
        }
    }
}

#[cfg(feature = "flex")]
#[derive(Debug)]
struct NormOp {
    residual: bool,
}

#[cfg(feature = "flex")]
#[derive(Debug, Clone)]
struct NormState {
    hat: FlexTensor,
    scales: FlexTensor,
    gamma: FlexTensor,
    shape: Vec<usize>,
}

#[cfg(feature = "flex")]
impl Backward<Flex, 4> for NormOp {
    type State = NormState;

    fn backward(self, ops: Ops<Self::State, 4>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let NormState { hat, scales, gamma, shape } = ops.state;
        let [px, py, pg, pb] = ops.parents;
        let width = slice(&gamma).len();
        let (mut dx, mut dgamma, mut dbeta) = (vec![0.0; slice(&hat).len()], vec![0.0; width], vec![0.0; width]);
        backward(slice(&hat), slice(&scales), slice(&gamma), slice(&dy), &mut dx, &mut dgamma, &mut dbeta);
        if let (Some(node), true) = (py, self.residual) {
            raw::register(grads, node.id, dx.clone(), &shape);
        }
        if let Some(node) = px {
            raw::register(grads, node.id, dx, &shape);
        }
        if let Some(node) = pg {
            raw::register(grads, node.id, dgamma, &[width]);
        }
        if let Some(node) = pb {
            raw::register(grads, node.id, dbeta, &[width]);
        }
    }
}

#[cfg(feature = "flex")]
fn tracked<const D: usize>(
    x: Tensor<D>,
    y: Option<Tensor<D>>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    eps: f64,
) -> Tensor<D> {
    let shape = x.dims();
    let residual = y.is_some();
    // Without a residual its parent is an unused constant.
    let y = y.unwrap_or_else(|| Tensor::zeros([1; D], &x.device()));
    let (x, y, gamma, beta) = (raw::track(x), raw::track(y), raw::track(gamma), raw::track(beta));
    let nodes = [x.node(), y.node(), gamma.node(), beta.node()];
    let x = contiguous(x.into_primitive());
    let (gamma, beta) = (contiguous(gamma.into_primitive()), contiguous(beta.into_primitive()));
    let mut hat = if residual { sum(slice(&x), slice(&contiguous(y.into_primitive()))) } else { slice(&x).to_vec() };
    let mut scales = vec![0.0; hat.len() / shape[D - 1]];
    standardise(&mut hat, &mut scales, eps);
    let mut out = hat.clone();
    scale_shift(&mut out, slice(&gamma), slice(&beta));
    let out = make(out, &shape);
    let out = match (NormOp { residual }).prepare::<NoCheckpointing>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prep) => {
            let rows = scales.len();
            let state =
                NormState { hat: make(hat, &shape), scales: make(scales, &[rows]), gamma, shape: shape.to_vec() };
            prep.finish(state, out)
        }
        OpsKind::UnTracked(prep) => prep.finish(out),
    };
    Tensor::from_primitive::<Tracked>(out)
}
