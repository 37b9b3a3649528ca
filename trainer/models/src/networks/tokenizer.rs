//! Convolutional encoder and decoder around a codebook, after OpenAI's Jukebox. They are the same in T2M-GPT (Zhang et
//! al., CVPR 2023), MoMask (Guo et al., CVPR 2024) and MMM (Pinyoanuntapong et al., CVPR 2024).
//!
//! Encoder: a convolution, then per level a strided convolution and a stack of dilated residual blocks, then a
//! convolution to codes. Decoder: the mirror image, with nearest-neighbour up-sampling. Dilations of a stack decrease,
//! 9, 3, 1, on both sides. The codebooks are no parameters: see [`crate::quantizer`].

use burn::module::Module;
use burn::tensor::Tensor;
use protocol::stage::TokenizerNetwork;

use super::Init;
use super::conv::{Conv1d, GAP, Gap, repeat};
use crate::kernels::{Dropout, dropout, leaky_relu};

/// Size of a tokenizer's networks.
#[derive(Debug, Clone, PartialEq)]
pub struct TokenizerConfig {
    /// Features per frame: 263 or 251.
    pub features: usize,
    /// Width of a code.
    pub dim: usize,
    /// Size of encoder and decoder, whose dropout is an argument of each pass.
    pub network: TokenizerNetwork,
}

/// Number of levels, each of which shortens sequences by [`STRIDE`].
pub const LEVELS: usize = 2;
/// Factor by which a level shortens sequences.
pub const STRIDE: usize = 2;
/// Frames per token.
pub const UNIT: usize = STRIDE.pow(LEVELS as u32);

fn relu(x_btc: Tensor<3>) -> Tensor<3> {
    leaky_relu(x_btc, 0.0)
}

/// A residual block, `x + D(C1(relu(C3(relu(x)))))` with dropout D.
#[derive(Module, Debug)]
pub struct ResidualBlock {
    /// Dilated convolution with three taps.
    pub conv1: Conv1d,
    /// Convolution with one tap.
    pub conv2: Conv1d,
}

impl ResidualBlock {
    fn forward(&self, x_btc: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        let hidden = self.conv1.forward(relu(x_btc.clone()));
        x_btc + dropout(self.conv2.forward(relu(hidden)), drop)
    }
}

/// Residual blocks with decreasing dilation.
#[derive(Module, Debug)]
pub struct ResidualStack {
    /// Blocks, the largest dilation first.
    pub model: Vec<ResidualBlock>,
}

impl ResidualStack {
    fn new(network: &TokenizerNetwork, init: &mut Init<'_>) -> Self {
        let TokenizerNetwork { width, depth, growth, .. } = *network;
        let block = |i: usize| {
            let dilation = (i + 1..depth).map(|_| growth).product();
            ResidualBlock {
                conv1: Conv1d::dilated(init, width, width, 3, dilation),
                conv2: Conv1d::same(init, width, width, 1),
            }
        };
        Self { model: (0..depth).map(block).collect() }
    }

    fn forward(&self, x_btc: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        self.model.iter().fold(x_btc, |x, block| block.forward(x, drop))
    }
}

/// An entry of the encoder's sequence.
#[derive(Module, Debug)]
pub enum EncoderPart {
    /// The first and the last convolution.
    Conv(Conv1d),
    /// The ReLU after the first convolution.
    Activation(Gap),
    /// A strided convolution and its residual blocks.
    Level((Conv1d, ResidualStack)),
}

/// Encoder from motion to rows of a code's width.
#[derive(Module, Debug)]
pub struct TokenEncoder {
    /// Convolution, ReLU, levels, convolution, in this order.
    pub model: Vec<EncoderPart>,
}

/// An entry of the decoder's sequence.
#[derive(Module, Debug)]
pub enum DecoderPart {
    /// The first and the last two convolutions.
    Conv(Conv1d),
    /// The ReLUs around the levels.
    Activation(Gap),
    /// Residual blocks, up-sampling and a convolution.
    Level((ResidualStack, Gap, Conv1d)),
}

/// Decoder from sums of codes to motion.
#[derive(Module, Debug)]
pub struct TokenDecoder {
    /// Convolution, ReLU, levels, convolution, ReLU, convolution.
    pub model: Vec<DecoderPart>,
}

/// Encoder and decoder of a tokenizer.
#[derive(Module, Debug)]
pub struct Tokenizer {
    /// Encoder from motion to rows.
    pub encoder: TokenEncoder,
    /// Decoder from rows to motion.
    pub decoder: TokenDecoder,
}

impl Tokenizer {
    /// Creates a tokenizer initialised in PyTorch's default range.
    pub fn new(config: &TokenizerConfig, init: &mut Init<'_>) -> Self {
        let TokenizerConfig { features, dim, ref network } = *config;
        let width = network.width;
        let mut encoder = vec![EncoderPart::Conv(Conv1d::same(init, features, width, 3)), EncoderPart::Activation(GAP)];
        encoder.extend((0..LEVELS).map(|_| {
            let down = Conv1d::strided(init, width, width, 2 * STRIDE, STRIDE, STRIDE / 2);
            EncoderPart::Level((down, ResidualStack::new(network, init)))
        }));
        encoder.push(EncoderPart::Conv(Conv1d::same(init, width, dim, 3)));
        let mut decoder = vec![DecoderPart::Conv(Conv1d::same(init, dim, width, 3)), DecoderPart::Activation(GAP)];
        decoder.extend((0..LEVELS).map(|_| {
            let stack = ResidualStack::new(network, init);
            DecoderPart::Level((stack, GAP, Conv1d::same(init, width, width, 3)))
        }));
        decoder.push(DecoderPart::Conv(Conv1d::same(init, width, width, 3)));
        decoder.push(DecoderPart::Activation(GAP));
        decoder.push(DecoderPart::Conv(Conv1d::same(init, width, features, 3)));
        Self { encoder: TokenEncoder { model: encoder }, decoder: TokenDecoder { model: decoder } }
    }

    /// Encodes normalised features [B, T, F] as rows [B, T / unit, d]. Frames at the end that do not fill a token get
    /// no token of their own.
    pub fn encode(&self, features_btf: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        self.encoder.model.iter().fold(features_btf, |x, part| match part {
            EncoderPart::Conv(conv) => conv.forward(x),
            EncoderPart::Activation(_) => relu(x),
            EncoderPart::Level((down, stack)) => stack.forward(down.forward(x), drop),
        })
    }

    /// Decodes sums of codes [B, n, d] into normalised features [B, unit n, F].
    pub fn decode(&self, codes_bnd: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        self.decoder.model.iter().fold(codes_bnd, |x, part| match part {
            DecoderPart::Conv(conv) => conv.forward(x),
            DecoderPart::Activation(_) => relu(x),
            DecoderPart::Level((stack, _, conv)) => conv.forward(repeat(stack.forward(x, drop), STRIDE)),
        })
    }
}
