//! Convolutional encoder and decoder around a codebook, the same in T2M-GPT (Zhang et al., CVPR 2023), MoMask (Guo et al., CVPR 2024) and
//! MMM (Pinyoanuntapong et al., CVPR 2024), after OpenAI's Jukebox.
//!
//! Encoder: convolution, then per level a strided convolution and a stack of dilated residual blocks, then a convolution to codes.
//! Decoder: the mirror image, with nearest-neighbour up-sampling. Dilations of a stack fall, 9, 3, 1, on both sides. The codebooks are no
//! parameters: see [`crate::quantizer`].

use burn::module::Module;
use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use serde::{Deserialize, Serialize};

use super::Init;
use super::conv::{Conv1d, GAP, Gap, repeat};
use crate::kernels::{Dropout, dropout};

/// Size of a tokenizer's networks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenizerConfig {
    /// Features per frame: 263 or 251.
    pub features: usize,
    /// Width of a code.
    pub dim: usize,
    /// Width between the convolutions.
    pub width: usize,
    /// Levels, each of which makes sequences shorter by `stride`.
    pub levels: usize,
    /// What a level shortens by.
    pub stride: usize,
    /// Residual blocks of a level.
    pub depth: usize,
    /// What dilations grow by from block to block.
    pub growth: usize,
}

impl TokenizerConfig {
    /// Frames that one token stands for.
    pub fn unit(&self) -> usize {
        (0..self.levels).map(|_| self.stride).product()
    }
}

/// `x + D(C1(relu(C3(relu(x)))))`.
#[derive(Module, Debug)]
pub struct ResidualBlock {
    /// Three taps, dilated.
    pub conv1: Conv1d,
    /// One tap.
    pub conv2: Conv1d,
}

impl ResidualBlock {
    fn forward(&self, x_btc: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        let hidden = self.conv1.forward(relu(x_btc.clone()));
        x_btc + dropout(self.conv2.forward(relu(hidden)), drop)
    }
}

/// Residual blocks with falling dilation.
#[derive(Module, Debug)]
pub struct ResidualStack {
    /// The widest reach first.
    pub model: Vec<ResidualBlock>,
}

impl ResidualStack {
    fn new(config: &TokenizerConfig, init: &mut Init<'_>) -> Self {
        let TokenizerConfig { width, depth, growth, .. } = *config;
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
    /// First and last.
    Conv(Conv1d),
    /// ReLU.
    Activation(Gap),
    /// A level.
    Level((Conv1d, ResidualStack)),
}

/// Motion to rows of codes' width.
#[derive(Module, Debug)]
pub struct TokenEncoder {
    /// Convolution, ReLU, levels, convolution.
    pub model: Vec<EncoderPart>,
}

/// An entry of the decoder's sequence.
#[derive(Module, Debug)]
pub enum DecoderPart {
    /// The first and the last two.
    Conv(Conv1d),
    /// ReLU.
    Activation(Gap),
    /// A level.
    Level((ResidualStack, Gap, Conv1d)),
}

/// Sums of codes to motion.
#[derive(Module, Debug)]
pub struct TokenDecoder {
    /// Convolution, ReLU, levels, convolution, ReLU, convolution.
    pub model: Vec<DecoderPart>,
}

/// Encoder and decoder of a tokenizer.
#[derive(Module, Debug)]
pub struct Tokenizer {
    /// Motion to rows.
    pub encoder: TokenEncoder,
    /// Rows to motion.
    pub decoder: TokenDecoder,
    stride: usize,
}

impl Tokenizer {
    /// A fresh one, in PyTorch's default range.
    pub fn new(config: &TokenizerConfig, init: &mut Init<'_>) -> Self {
        let TokenizerConfig { features, dim, width, levels, stride, .. } = *config;
        let mut encoder = vec![EncoderPart::Conv(Conv1d::same(init, features, width, 3)), EncoderPart::Activation(GAP)];
        encoder.extend((0..levels).map(|_| {
            let down = Conv1d::strided(init, width, width, 2 * stride, stride, stride / 2);
            EncoderPart::Level((down, ResidualStack::new(config, init)))
        }));
        encoder.push(EncoderPart::Conv(Conv1d::same(init, width, dim, 3)));
        let mut decoder = vec![DecoderPart::Conv(Conv1d::same(init, dim, width, 3)), DecoderPart::Activation(GAP)];
        decoder.extend((0..levels).map(|_| {
            let stack = ResidualStack::new(config, init);
            DecoderPart::Level((stack, GAP, Conv1d::same(init, width, width, 3)))
        }));
        decoder.push(DecoderPart::Conv(Conv1d::same(init, width, width, 3)));
        decoder.push(DecoderPart::Activation(GAP));
        decoder.push(DecoderPart::Conv(Conv1d::same(init, width, features, 3)));
        Self { encoder: TokenEncoder { model: encoder }, decoder: TokenDecoder { model: decoder }, stride }
    }

    /// Normalised features [B, T, F] -> rows [B, T / unit, d]; a rest of T that makes no whole token is not looked at by a token of its own.
    pub fn encode(&self, features_btf: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        self.encoder.model.iter().fold(features_btf, |x, part| match part {
            EncoderPart::Conv(conv) => conv.forward(x),
            EncoderPart::Activation(_) => relu(x),
            EncoderPart::Level((down, stack)) => stack.forward(down.forward(x), drop),
        })
    }

    /// Sums of codes [B, n, d] -> normalised features [B, unit n, F].
    pub fn decode(&self, codes_bnd: Tensor<3>, drop: &mut Dropout) -> Tensor<3> {
        self.decoder.model.iter().fold(codes_bnd, |x, part| match part {
            DecoderPart::Conv(conv) => conv.forward(x),
            DecoderPart::Activation(_) => relu(x),
            DecoderPart::Level((stack, _, conv)) => conv.forward(repeat(stack.forward(x, drop), self.stride)),
        })
    }
}
