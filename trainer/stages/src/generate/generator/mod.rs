//! Models as evaluation, `generate`, `time` and registration use them: captions, lengths and seeds in, motions out.
//!
//! A model is opened from its artifact alone, by the generator that its manifest names. The generator decides which
//! parts the model needs. To add one: a file here that implements [`MotionGenerator`], and a line in the table of
//! [`open`].

mod draw;
mod feature_diffusion;
mod interface;
mod latent_diffusion;
mod mmm_condition;
mod table;
mod texts;
mod tokens;

pub use draw::{check_sampler, edited, infilling, motions};
pub(crate) use feature_diffusion::NAME as FEATURE_DIFFUSION;
pub use interface::{Batch, ControlRequest, Edit, Infilling, Lap, LatentGenerator, MotionGenerator, Seeds, Text};
pub(crate) use latent_diffusion::NAME as LATENT_DIFFUSION;
pub(crate) use mmm_condition::{codebook, with_words};
pub use table::open;
pub(crate) use texts::Texts;
pub(crate) use tokens::{GeneratorMeta, MASKED_PREFIX, NAME as TOKENS, RESIDUAL_PREFIX};
