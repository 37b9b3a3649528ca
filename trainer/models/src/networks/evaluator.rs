//! The text-motion evaluator: three networks that map captions and motions into one space, in which metrics are
//! computed.
//!
//! Source: text-to-motion (Guo et al., CVPR 2022). Two strided convolutions make one movement of every four frames. A
//! bidirectional GRU over the movements returns a motion's embedding, another over the words a caption's. Sequences are
//! ragged: the forward GRU stops at a sequence's own last token and the backward GRU starts there, so padding has no
//! effect. Notation: c channels in, g width of a GRU.
//!
//! [`MovementDecoder`] belongs only to the first phase of the training, in which encoder and decoder form an
//! autoencoder.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use super::{Init, Linear, Norm};
use crate::kernels::{self, Dropout, Sweep, dropout, gru, leaky_relu};

/// Slope of every leaky ReLU here.
const SLOPE: f64 = 0.2;
/// Added to variances in layer norms.
const EPS: f64 = 1e-5;
/// Windows that halve the frames.
const HALVING: Sweep = Sweep { stride: 2, dilation: 1, padding: 1 };
/// Frames per movement.
pub(crate) const UNIT: usize = 4;

/// Sizes of the networks. The published evaluator: 512, 512, 1024, 300, 15, 512, 512.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EvaluatorConfig {
    /// Features of a frame without the four foot contacts.
    pub features: usize,
    /// Width between the two convolutions.
    pub movement_hidden: usize,
    /// Width of a movement.
    pub movement: usize,
    /// Width of the motion GRU.
    pub motion_hidden: usize,
    /// Width of a word vector.
    pub word: usize,
    /// Number of word classes.
    pub classes: usize,
    /// Width of the text GRU.
    pub text_hidden: usize,
    /// Width of an embedding.
    pub embedding: usize,
}

/// A convolution over four frames with stride 2 and one frame of zeros on either side.
#[derive(Module, Debug)]
pub struct Conv {
    /// Weights of shape [out, in, 4].
    pub weight: Param<Tensor<3>>,
    /// Bias of shape [out].
    pub bias: Param<Tensor<1>>,
}

impl Conv {
    fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.xavier_normal((inner + out) * UNIT, [out, inner, UNIT]), bias: init.constant(0.0, [out]) }
    }

    /// Creates a layer with these weights.
    pub fn from_weights(weight: Tensor<3>, bias: Tensor<1>) -> Self {
        Self { weight: Param::from_tensor(weight), bias: Param::from_tensor(bias) }
    }

    /// Maps [B, T, in] to [B, T / 2, out].
    pub fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        kernels::conv(x_btc, self.weight.val(), Some(self.bias.val()), HALVING)
    }
}

/// The transpose of [`Conv`], which doubles the frames.
#[derive(Module, Debug)]
pub struct Deconv {
    /// Weights of shape [in, out, 4].
    pub weight: Param<Tensor<3>>,
    /// Bias of shape [out].
    pub bias: Param<Tensor<1>>,
}

impl Deconv {
    fn new(init: &mut Init<'_>, inner: usize, out: usize) -> Self {
        Self { weight: init.xavier_normal((inner + out) * UNIT, [inner, out, UNIT]), bias: init.constant(0.0, [out]) }
    }

    /// Creates a layer with these weights.
    pub fn from_weights(weight: Tensor<3>, bias: Tensor<1>) -> Self {
        Self { weight: Param::from_tensor(weight), bias: Param::from_tensor(bias) }
    }

    /// Maps [B, T, in] to [B, 2 T, out].
    pub fn forward(&self, x_btc: Tensor<3>) -> Tensor<3> {
        kernels::transposed_conv(x_btc, self.weight.val(), self.bias.val(), HALVING)
    }
}

fn linear(init: &mut Init<'_>, inner: usize, out: usize) -> Linear {
    Linear { weight: init.xavier_normal(inner + out, [out, inner]), bias: Some(init.constant(0.0, [out])) }
}

/// Encoder from features to movements.
#[derive(Module, Debug)]
pub struct MovementEncoder {
    /// Features -> hidden.
    pub main_0: Conv,
    /// Hidden -> movement.
    pub main_3: Conv,
    /// Movement -> movement.
    pub out_net: Linear,
}

impl MovementEncoder {
    /// Creates an encoder with initial weights.
    pub fn new(config: &EvaluatorConfig, init: &mut Init<'_>) -> Self {
        Self {
            main_0: Conv::new(init, config.features, config.movement_hidden),
            main_3: Conv::new(init, config.movement_hidden, config.movement),
            out_net: linear(init, config.movement, config.movement),
        }
    }

    /// [B, T, features] -> [B, T / 4, movement].
    pub fn forward(&self, features_btf: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        let x = leaky_relu(dropout(self.main_0.forward(features_btf), drop), SLOPE);
        let x = leaky_relu(dropout(self.main_3.forward(x), drop), SLOPE);
        self.out_net.forward(x)
    }
}

/// Decoder from movements to features, contacts included.
#[derive(Module, Debug)]
pub struct MovementDecoder {
    /// Movement -> hidden.
    pub main_0: Deconv,
    /// Hidden -> all features.
    pub main_2: Deconv,
    /// Features -> features.
    pub out_net: Linear,
}

impl MovementDecoder {
    /// Creates a decoder with initial weights; `features` counts the contacts too.
    pub fn new(config: &EvaluatorConfig, features: usize, init: &mut Init<'_>) -> Self {
        Self {
            main_0: Deconv::new(init, config.movement, config.movement_hidden),
            main_2: Deconv::new(init, config.movement_hidden, features),
            out_net: linear(init, features, features),
        }
    }

    /// [B, N, movement] -> [B, 4 N, features].
    pub fn forward(&self, movements_bnc: Tensor<3>) -> Tensor<3> {
        let x = leaky_relu(self.main_0.forward(movements_bnc), SLOPE);
        self.out_net.forward(leaky_relu(self.main_2.forward(x), SLOPE))
    }
}

/// One bidirectional layer of gated recurrent units. Rows of the weights are the gates r, z, n.
#[derive(Module, Debug)]
pub struct BiGru {
    /// Forward in time; shape [3g, in].
    pub weight_ih_l0: Param<Tensor<2>>,
    /// Forward in time; shape [3g, g].
    pub weight_hh_l0: Param<Tensor<2>>,
    /// Forward in time; shape [3g].
    pub bias_ih_l0: Param<Tensor<1>>,
    /// Forward in time; shape [3g].
    pub bias_hh_l0: Param<Tensor<1>>,
    /// Backward in time; shape [3g, in].
    pub weight_ih_l0_reverse: Param<Tensor<2>>,
    /// Backward in time; shape [3g, g].
    pub weight_hh_l0_reverse: Param<Tensor<2>>,
    /// Backward in time; shape [3g].
    pub bias_ih_l0_reverse: Param<Tensor<1>>,
    /// Backward in time; shape [3g].
    pub bias_hh_l0_reverse: Param<Tensor<1>>,
}

impl BiGru {
    /// Initialises all weights uniformly within `±1 / sqrt(g)`, PyTorch's default.
    pub fn new(init: &mut Init<'_>, inner: usize, width: usize) -> Self {
        let rows = 3 * width;
        Self {
            weight_ih_l0: init.fan_in(width, [rows, inner]),
            weight_hh_l0: init.fan_in(width, [rows, width]),
            bias_ih_l0: init.fan_in(width, [rows]),
            bias_hh_l0: init.fan_in(width, [rows]),
            weight_ih_l0_reverse: init.fan_in(width, [rows, inner]),
            weight_hh_l0_reverse: init.fan_in(width, [rows, width]),
            bias_ih_l0_reverse: init.fan_in(width, [rows]),
            bias_hh_l0_reverse: init.fan_in(width, [rows]),
        }
    }

    /// The states after each token of `x_btc` [B, T, in] in either direction, from the states `start` [B, g]. The first
    /// `lengths[b]` tokens are valid. Past the end, a forward state repeats the last one before it, and a backward
    /// state is its start.
    pub fn forward(&self, x_btc: Tensor<3>, lengths: &[usize], start: [Tensor<2>; 2]) -> [Tensor<3>; 2] {
        let [forward, backward] = start;
        let gates = |w: &Param<Tensor<2>>, b: &Param<Tensor<1>>| kernels::linear(x_btc.clone(), w.val(), Some(b.val()));
        let w = self.weight_hh_l0.val();
        let b = self.bias_hh_l0.val();
        let ahead = gru(gates(&self.weight_ih_l0, &self.bias_ih_l0), forward, w, b, lengths, false);
        let w = self.weight_hh_l0_reverse.val();
        let b = self.bias_hh_l0_reverse.val();
        let back = gru(gates(&self.weight_ih_l0_reverse, &self.bias_ih_l0_reverse), backward, w, b, lengths, true);
        [ahead, back]
    }

    /// The last state of either direction, side by side [B, 2g], from learned initial states `hidden` [2, 1, g].
    fn last(&self, x_btc: Tensor<3>, lengths: &[usize], hidden: &Param<Tensor<3>>) -> Tensor<2> {
        let [batch, tokens, _] = x_btc.dims();
        let width = hidden.dims()[2];
        let start =
            |k: usize| hidden.val().slice([k..k + 1, 0..1, 0..width]).reshape([1, width]).expand([batch, width]);
        let [ahead, back] = self.forward(x_btc, lengths, [start(0), start(1)]);
        let at = |x: Tensor<3>, t: usize| x.slice([0..batch, t..t + 1, 0..width]).reshape([batch, width]);
        Tensor::cat(vec![at(ahead, tokens - 1), at(back, 0)], 1)
    }
}

/// Encoder from movements to the embedding of a motion.
#[derive(Module, Debug)]
pub struct MotionEncoder {
    /// Movement -> g.
    pub input_emb: Linear,
    /// GRU over the movements.
    pub gru: BiGru,
    /// 2g -> g.
    pub output_net_0: Linear,
    pub output_net_1: Norm,
    /// g -> embedding.
    pub output_net_3: Linear,
    /// Initial states [2, 1, g].
    pub hidden: Param<Tensor<3>>,
}

impl MotionEncoder {
    /// Creates an encoder with initial weights.
    pub fn new(config: &EvaluatorConfig, init: &mut Init<'_>) -> Self {
        let width = config.motion_hidden;
        Self {
            input_emb: linear(init, config.movement, width),
            gru: BiGru::new(init, width, width),
            output_net_0: linear(init, 2 * width, width),
            output_net_1: Norm::new(init, width),
            output_net_3: linear(init, width, config.embedding),
            hidden: init.normal([2, 1, width]),
        }
    }

    /// Maps movements [B, N, movement] to embeddings [B, embedding]; the first `lengths[b]` movements are valid.
    pub fn forward(&self, movements_bnc: Tensor<3>, lengths: &[usize]) -> Tensor<2> {
        let last = self.gru.last(self.input_emb.forward(movements_bnc), lengths, &self.hidden);
        let x = self.output_net_1.leaky(self.output_net_0.forward(last), None, EPS, SLOPE);
        self.output_net_3.forward(x)
    }
}

/// Encoder from words to the embedding of a caption.
#[derive(Module, Debug)]
pub struct TextEncoder {
    /// Word classes -> word vector.
    pub pos_emb: Linear,
    /// Word vector -> g.
    pub input_emb: Linear,
    /// GRU over the words.
    pub gru: BiGru,
    /// 2g -> g.
    pub output_net_0: Linear,
    pub output_net_1: Norm,
    /// g -> embedding.
    pub output_net_3: Linear,
    /// Initial states [2, 1, g].
    pub hidden: Param<Tensor<3>>,
}

impl TextEncoder {
    /// Creates an encoder with initial weights.
    pub fn new(config: &EvaluatorConfig, init: &mut Init<'_>) -> Self {
        let width = config.text_hidden;
        Self {
            pos_emb: linear(init, config.classes, config.word),
            input_emb: linear(init, config.word, width),
            gru: BiGru::new(init, width, width),
            output_net_0: linear(init, 2 * width, width),
            output_net_1: Norm::new(init, width),
            output_net_3: linear(init, width, config.embedding),
            hidden: init.normal([2, 1, width]),
        }
    }

    /// Maps word vectors [B, W, word] and one-hot classes [B, W, classes] to [B, embedding]; the first `lengths[b]` are
    /// valid.
    pub fn forward(&self, words_bwc: Tensor<3>, classes_bwc: Tensor<3>, lengths: &[usize]) -> Tensor<2> {
        let words = words_bwc + self.pos_emb.forward(classes_bwc);
        let last = self.gru.last(self.input_emb.forward(words), lengths, &self.hidden);
        let x = self.output_net_1.leaky(self.output_net_0.forward(last), None, EPS, SLOPE);
        self.output_net_3.forward(x)
    }
}

/// All three networks, as in the published file.
#[derive(Module, Debug)]
pub struct Evaluator {
    pub text_encoder: TextEncoder,
    pub motion_encoder: MotionEncoder,
    pub movement_encoder: MovementEncoder,
}

impl Evaluator {
    /// Creates networks with initial weights.
    pub fn new(config: &EvaluatorConfig, init: &mut Init<'_>) -> Self {
        Self {
            text_encoder: TextEncoder::new(config, init),
            motion_encoder: MotionEncoder::new(config, init),
            movement_encoder: MovementEncoder::new(config, init),
        }
    }

    /// Embeddings [B, embedding] of normalised motions [B, T, features + contacts]. The first `frames[b]` frames are
    /// valid; the length is rounded down to whole movements.
    pub fn motion(&self, motion_btf: Tensor<3>, frames: &[usize]) -> Tensor<2> {
        let [batch, all, _] = motion_btf.dims();
        let features = self.movement_encoder.main_0.weight.dims()[1];
        let movements =
            self.movement_encoder.forward(motion_btf.slice([0..batch, 0..all, 0..features]), &mut Dropout::off());
        let lengths: Vec<usize> = frames.iter().map(|frames| frames / UNIT).collect();
        self.motion_encoder.forward(movements, &lengths)
    }

    /// The device of the parameters.
    pub fn device(&self) -> Device {
        self.text_encoder.hidden.val().device()
    }
}
