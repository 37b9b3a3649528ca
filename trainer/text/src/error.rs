//! What is wrong with an encoder's files.

use std::path::Path;

/// What is wrong with a file of an encoder, what was expected, and what to do.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{place}: {what}")]
pub struct EncoderError {
    /// The folder, or the file.
    pub place: String,
    /// What is wrong with it.
    pub what: String,
}

impl EncoderError {
    pub(crate) fn new(place: impl ToString, what: impl Into<String>) -> Self {
        Self { place: place.to_string(), what: what.into() }
    }

    pub(crate) fn at(place: &Path, what: impl Into<String>) -> Self {
        Self::new(place.display(), what)
    }
}
