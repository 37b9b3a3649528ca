//! The published networks. Field names are the published tensor names, so that paths of parameters are too.
//!
//! Notation in tensor names: b batch, t frames or tokens, h width, n latent tokens, d latent width, f features.

mod denoiser;
mod discriminator;
mod embedding;
mod evaluator;
mod init;
mod length;
mod transformer;
mod vae;

pub use denoiser::{Denoiser, DenoiserConfig};
pub use discriminator::Discriminator;
pub use embedding::{guidance_embedding, time_sinusoid};
pub use evaluator::{
    BiGru, Conv, Deconv, Evaluator, EvaluatorConfig, MotionEncoder, MovementDecoder, MovementEncoder, TextEncoder,
};
pub use init::Init;
pub use length::LengthEstimator;
pub use transformer::{Attention, Block, Linear, Norm, SkipStack, StackConfig};
pub use vae::{Posterior, Vae, VaeConfig};

/// Rows of a learned position table, which bound the length of a sequence.
pub const POSITIONS: usize = 500;
