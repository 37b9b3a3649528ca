//! Generation of a motion from a sentence, with a model of any kind.
//!
//! Not a stage: it keeps nothing, and it reads the clock, because the time per sentence is the purpose of few-step
//! models. The motion is a function of (model, sentence, frames, sampler, seed).

mod draw;
mod generated;
pub mod generator;
mod loaded;
mod refine;
pub mod stream;
pub mod timing;

pub use self::generated::{Edited, Generated, Timing};
pub use self::loaded::{DEFAULT_FRAMES, Generator};
