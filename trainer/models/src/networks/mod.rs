//! The published networks. Field names are the published tensor names, so paths of parameters are the published paths.
//!
//! Notation in tensor names: b batch, t frames or tokens, h width, n latent tokens, d latent width, f features.

mod attend;
mod clip_text;
mod condition;
mod control;
mod conv;
mod denoiser;
mod discord;
mod discriminator;
mod dit;
mod embedding;
mod encoder;
mod evaluator;
mod feedback;
mod gpt;
mod init;
mod length;
mod mdm;
mod mmm;
mod momask;
mod stablemofusion;
mod t5;
mod tokenizer;
mod trajectory;
mod transformer;
mod vae;

pub use clip_text::{ClipActivation, ClipStates, ClipText, ClipTextConfig, renamed_from_openai};
pub use condition::ConditionEmbedding;
pub use control::{Control, copied_from};
pub use denoiser::{Denoiser, DenoiserConfig};
pub use discord::{FlowUnet, Projection, TimeFeatures, UnetConfig};
pub use discriminator::Discriminator;
pub use dit::{ATTENTION_DROPOUT, DitConfig, FlowDit, falling};
pub use embedding::{guidance_embedding, position_sinusoid, time_sinusoid, time_sinusoid_f32};
pub use encoder::Layers;
pub use evaluator::{
    BiGru, Conv, Deconv, Evaluator, EvaluatorConfig, MotionEncoder, MovementDecoder, MovementEncoder, TextEncoder,
};
pub use feedback::{Feedback, FeedbackConfig};
pub use gpt::{Gpt, GptConfig};
pub use init::Init;
pub use length::LengthEstimator;
pub use mdm::{Mdm, MdmConfig};
pub use mmm::{Mmm, MmmCondition, MmmConfig};
pub use momask::{MaskedTransformer, MomaskConfig, ResidualTransformer};
pub use stablemofusion::{StableMoFusion, StableMoFusionConfig, TokenCondition};
pub use t5::{T5Config, T5Encoder, T5FeedForward, distance_bucket, mean_of_tokens, normalised};
pub use tokenizer::{LEVELS, STRIDE, Tokenizer, TokenizerConfig, UNIT};
pub use trajectory::{Hints, TrajectoryConfig, TrajectoryEncoder};
pub use transformer::{Attention, Block, Linear, Norm, SkipStack, StackConfig};
pub use vae::{Posterior, Vae, VaeConfig};

/// Rows of a learned position table; they limit the length of a sequence.
pub const POSITIONS: usize = 500;
