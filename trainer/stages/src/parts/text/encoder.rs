//! The interface of text encoders, and the common part of their manifests.

use serde::{Deserialize, Serialize};

use crate::context::StageError;

/// The part of an artifact's meta, of kind `text-encoder`, that all encoders share.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TextEncoderMeta {
    /// Name of the encoder in the table of [`open`](super::open).
    pub encoder: String,
    /// Width of a caption's vector.
    pub dim: usize,
}

/// Embeds captions as vectors. A caption's result depends on it alone, to the bit, not on other captions of the batch.
pub trait TextEncoder: std::fmt::Debug {
    /// Width of a caption's vector.
    fn dim(&self) -> usize;

    /// Width of a token's vector.
    fn token_dim(&self) -> usize {
        self.dim()
    }

    /// A vector for each caption, `[captions, dim]`. The empty caption's is the null condition of classifier-free
    /// guidance.
    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError>;

    /// A vector for each token of each caption, `[tokens, token_dim]` per caption; at least one.
    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError>;
}
