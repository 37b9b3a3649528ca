//! The built-in encoder: words and word pairs hashed to signed coordinates. It has no weights.

use motion::text::{EMBEDDING_WIDTH, hashed_embedding, hashed_tokens};

use super::encoder::TextEncoder;
use crate::context::StageError;

/// Words and word pairs hashed to signed coordinates.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hashed;

impl TextEncoder for Hashed {
    fn dim(&self) -> usize {
        EMBEDDING_WIDTH
    }

    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError> {
        Ok(captions.iter().flat_map(|caption| hashed_embedding(caption)).collect())
    }

    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError> {
        Ok(captions.iter().map(|caption| hashed_tokens(caption).concat()).collect())
    }
}
