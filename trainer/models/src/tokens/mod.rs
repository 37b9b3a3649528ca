//! Sampling token ids from the published generators, and their training losses.
//!
//! Everything but the networks runs on the host: ids are integers, and masking is decided by comparisons. Draws are
//! arguments, so that a caller keys them and a test stores them.
//!
//! Losses are sums over the examples, in a form that adds up over slices. The weights come from a caller that has the
//! whole batch.

pub mod autoregressive;
mod logits;
pub mod masked;
mod masking;
pub mod mmm;
pub mod residual;

pub use logits::{Uniforms, cross_entropy, gumbel_draw, keep_top, probability};
pub use masking::{cosine, grid};
