//! The length estimator: predicts the length of a caption's motion. Source: MoMask (Guo et al., CVPR 2024),
//! `LengthEstimator`.
//!
//! A caption's embedding passes three hidden layers (Linear, layer norm, leaky ReLU) to the logits of classes. Class c
//! is a motion of c movements of four frames. Dropout precedes the second and the third linear layer.

use burn::module::{Module, Param};
use burn::tensor::activation::log_softmax;
use burn::tensor::{Tensor, TensorData};
use motion::Stream;

use super::evaluator::UNIT;
use super::{Init, Linear, Norm};
use crate::kernels::{Dropout, dropout};

/// Slope of every leaky ReLU here.
const SLOPE: f64 = 0.2;
/// Added to variances in layer norms.
const EPS: f64 = 1e-5;
/// Widths of the hidden layers.
const HIDDEN: [usize; 3] = [512, 256, 128];
/// Standard deviation of the initial weights.
const DEVIATION: f64 = 0.02;

/// Estimator from a caption embedding to the logits of lengths.
#[derive(Module, Debug)]
pub struct LengthEstimator {
    /// Text -> 512.
    pub output_0: Linear,
    pub output_1: Norm,
    /// 512 -> 256.
    pub output_4: Linear,
    pub output_5: Norm,
    /// 256 -> 128.
    pub output_8: Linear,
    pub output_9: Norm,
    /// 128 -> classes.
    pub output_11: Linear,
}

impl LengthEstimator {
    /// Frames by which a class is longer than the class before it.
    pub const UNIT: usize = UNIT;
    /// Number of classes as published: up to 49 movements, 196 frames.
    pub const CLASSES: usize = 50;

    /// Creates an estimator: weights normal with deviation 0.02, biases 0.
    pub fn new(text: usize, classes: usize, init: &mut Init<'_>) -> Self {
        let [a, b, c] = HIDDEN;
        Self {
            output_0: linear(init, text, a),
            output_1: Norm::new(init, a),
            output_4: linear(init, a, b),
            output_5: Norm::new(init, b),
            output_8: linear(init, b, c),
            output_9: Norm::new(init, c),
            output_11: linear(init, c, classes),
        }
    }

    /// [B, text] -> [B, classes].
    pub fn forward(&self, text_bc: Tensor<2>, drop: &mut Dropout) -> Tensor<2> {
        self.forward_dropping(text_bc, |x| dropout(x, drop))
    }

    /// As [`forward`](Self::forward), with `drop` called before the second and before the third linear layer.
    pub fn forward_dropping(&self, text_bc: Tensor<2>, mut drop: impl FnMut(Tensor<2>) -> Tensor<2>) -> Tensor<2> {
        let hidden = |x: Tensor<2>, linear: &Linear, norm: &Norm| norm.leaky(linear.forward(x), None, EPS, SLOPE);
        let x = hidden(text_bc, &self.output_0, &self.output_1);
        let x = hidden(drop(x), &self.output_4, &self.output_5);
        let x = hidden(drop(x), &self.output_8, &self.output_9);
        self.output_11.forward(x)
    }

    /// The class of a motion of `frames` frames.
    pub fn class(frames: usize, classes: usize) -> usize {
        (frames / UNIT).min(classes - 1)
    }

    /// Cross-entropy of the logits [B, classes] against one class per row, summed over the batch.
    pub fn loss(logits_bc: Tensor<2>, classes: &[usize]) -> Tensor<1> {
        let [batch, count] = logits_bc.dims();
        let mut own = vec![0.0_f32; batch * count];
        classes.iter().enumerate().for_each(|(b, class)| own[b * count + class] = 1.0);
        let own = Tensor::<2>::from_data(TensorData::new(own, [batch, count]), &logits_bc.device());
        (log_softmax(logits_bc, 1) * own).sum().neg()
    }

    /// Draws a class from the softmax of host-side logits: the largest of `p / e` with exponential `e`. `exponential`
    /// returns the next `e`.
    pub fn draw(logits: &[f32], exponential: impl FnMut() -> f64) -> usize {
        let mut exponential = exponential;
        // Logarithms are compared, so that nothing overflows.
        let scores = logits.iter().map(|logit| f64::from(*logit) - exponential().ln());
        scores.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(class, _)| class)
    }

    /// Draws a length in frames from host-side logits, at least one movement.
    pub fn sample(logits: &[f32], stream: &mut Stream) -> usize {
        Self::draw(logits, || -(1.0 - stream.uniform()).ln()).max(1) * UNIT
    }
}

fn linear(init: &mut Init<'_>, inner: usize, out: usize) -> Linear {
    // A copy through the host makes the parameter a leaf of the tape.
    let scaled = (init.normal([out, inner]).val().detach() * DEVIATION).into_data();
    let weight = Param::from_tensor(Tensor::from_data(scaled, init.device()));
    Linear { weight, bias: Some(init.constant(0.0, [out])) }
}
