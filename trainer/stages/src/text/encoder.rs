//! What every text encoder does, and what its manifest says.

use serde::{Deserialize, Serialize};

use crate::context::StageError;

/// Meta of an artifact of kind `text-encoder`, as far as all encoders share it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TextEncoderMeta {
    /// Which one: a name in the table of [`open`](super::open).
    pub encoder: String,
    /// Width of a caption's vector.
    pub dim: usize,
}

/// Turns captions into vectors. What a caption becomes depends on it alone, to the bit, not on those beside it.
pub trait TextEncoder: std::fmt::Debug {
    /// Width of a caption's vector.
    fn dim(&self) -> usize;

    /// Width of a token's vector.
    fn token_dim(&self) -> usize {
        self.dim()
    }

    /// A vector for each caption, `[captions, dim]`. That of the empty one is the null condition of classifier-free guidance.
    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError>;

    /// A vector for each token of each caption, `[tokens, token_dim]` a caption; at least one.
    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError>;
}
