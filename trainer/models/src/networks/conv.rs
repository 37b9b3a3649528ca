//! Convolutions over time on [B, T, C], and the parts of upstream's sequences.

use burn::module::{Module, Param};
use burn::tensor::Tensor;

use super::Init;
use crate::kernels::{self, Sweep};

/// An entry of a sequence without parameters, such as an activation or a reshape; it only takes up a number.
pub(super) type Gap = bool;
/// The one value of a [`Gap`].
pub(super) const GAP: Gap = false;

/// A convolution over time.
#[derive(Module, Debug)]
pub struct Conv1d {
    /// Weights of shape [out, in, taps].
    pub weight: Param<Tensor<3>>,
    /// Bias of shape [out].
    pub bias: Option<Param<Tensor<1>>>,
    #[module(skip)]
    sweep: Sweep,
    /// Pads with repeated edges instead of zeros.
    replicate: bool,
}

impl Conv1d {
    /// Creates a layer with stride 1 and an odd number of taps, which keeps the number of frames. Weight and bias are
    /// initialised in PyTorch's default range.
    pub fn same(init: &mut Init<'_>, inner: usize, out: usize, taps: usize) -> Self {
        Self::dilated(init, inner, out, taps, 1)
    }

    /// Like [`same`](Self::same), with `dilation` frames between taps.
    pub fn dilated(init: &mut Init<'_>, inner: usize, out: usize, taps: usize, dilation: usize) -> Self {
        let sweep = Sweep { stride: 1, dilation, padding: dilation * (taps / 2) };
        Self { sweep, ..Self::strided(init, inner, out, taps, 1, 0) }
    }

    /// Creates a layer on every `stride`-th window, with `padding` frames of zeros on either side.
    pub fn strided(init: &mut Init<'_>, inner: usize, out: usize, taps: usize, stride: usize, padding: usize) -> Self {
        let fan = inner * taps;
        Self {
            weight: init.fan_in(fan, [out, inner, taps]),
            bias: Some(init.fan_in(fan, [out])),
            sweep: Sweep { stride, dilation: 1, padding },
            replicate: false,
        }
    }

    /// Removes the bias.
    #[must_use]
    pub fn without_bias(self) -> Self {
        Self { bias: None, ..self }
    }

    /// Pads with repeated edges instead of zeros.
    #[must_use]
    pub fn replicating(self) -> Self {
        Self { replicate: true, ..self }
    }

    /// Maps [B, T, in] to [B, T', out] with `T' = (T + 2 padding - dilation (taps - 1) - 1) / stride + 1`.
    ///
    /// # Panics
    /// If the padded sequence is shorter than a window.
    pub fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        let weight = self.weight.val();
        let bias = self.bias.as_ref().map(Param::val);
        if self.replicate {
            let x = edged(x_btc, self.sweep.padding);
            return kernels::conv(x, weight, bias, Sweep { padding: 0, ..self.sweep });
        }
        kernels::conv(x_btc, weight, bias, self.sweep)
    }
}

/// Repeats the first and the last frame `count` times each.
fn edged(x_btc: Tensor<3>, count: usize) -> Tensor<3> {
    let [batch, frames, inner] = x_btc.dims();
    let edge = |at: usize| x_btc.clone().slice([0..batch, at..at + 1, 0..inner]).expand([batch, count, inner]);
    Tensor::cat(vec![edge(0), x_btc.clone(), edge(frames - 1)], 1)
}

/// A transposed convolution of two taps and stride 2: it doubles the frames, and windows do not overlap.
#[derive(Module, Debug)]
pub struct Doubling {
    /// Weights of shape [in, out, 2].
    pub weight: Param<Tensor<3>>,
    /// Bias of shape [out].
    pub bias: Param<Tensor<1>>,
}

impl Doubling {
    /// Initialises weight and bias in PyTorch's default range, which counts outputs for this layer.
    pub fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.fan_in(2 * out, [inner, out, 2]), bias: init.fan_in(2 * out, [out]) }
    }

    /// Maps [B, T, in] to [B, 2 T, out].
    pub fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        let [batch, frames, _] = x_btc.dims();
        let [inner, out, taps] = self.weight.dims();
        let weight = self.weight.val().permute([2, 1, 0]).reshape([taps * out, inner]);
        let bias = self.bias.val();
        let bias = Tensor::cat(vec![bias; taps], 0);
        kernels::linear(x_btc, weight, Some(bias)).reshape([batch, taps * frames, out])
    }
}

/// Repeats every frame `times` times (nearest-neighbour up-sampling). [B, T, C] -> [B, times T, C].
pub(super) fn repeat(x_btc: Tensor<3>, times: usize) -> Tensor<3> {
    let [batch, frames, width] = x_btc.dims();
    let x = x_btc.reshape([batch, frames, 1, width]).expand([batch, frames, times, width]);
    x.reshape([batch, times * frames, width])
}
