//! The published networks. Field names are the published tensor names, so that paths of parameters are too.
//!
//! Notation in tensor names: b batch, t frames or tokens, h width, n latent tokens, d latent width, f features.

mod attend;
mod conv;
mod denoiser;
mod discord;
mod discriminator;
mod dit;
mod embedding;
mod evaluator;
mod gpt;
mod init;
mod length;
mod mmm;
mod momask;
mod tokenizer;
mod transformer;
mod vae;

pub use denoiser::{Denoiser, DenoiserConfig};
pub use discord::{FlowUnet, Projection, TimeFeatures, UnetConfig};
pub use discriminator::Discriminator;
pub use dit::{ATTENTION_DROPOUT, DitConfig, FlowDit, falling};
pub use embedding::{guidance_embedding, time_sinusoid, time_sinusoid_f32};
pub use evaluator::{
    BiGru, Conv, Deconv, Evaluator, EvaluatorConfig, MotionEncoder, MovementDecoder, MovementEncoder, TextEncoder,
};
pub use gpt::{Gpt, GptConfig};
pub use init::Init;
pub use length::LengthEstimator;
pub use mmm::{Mmm, MmmConfig};
pub use momask::{MaskedTransformer, MomaskConfig, ResidualTransformer};
pub use tokenizer::{Tokenizer, TokenizerConfig};
pub use transformer::{Attention, Block, Linear, Norm, SkipStack, StackConfig};
pub use vae::{Posterior, Vae, VaeConfig};

/// Rows of a learned position table, which bound the length of a sequence.
pub const POSITIONS: usize = 500;
