//! What is wrong with an encoder's files.

use std::path::Path;

/// Characters that are said of a file.
const SHOWN: usize = 2_000;

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
        let mut what = what.into();
        // It may quote the file.
        if let Some((end, _)) = what.char_indices().nth(SHOWN) {
            what.truncate(end);
            what.push_str("...");
        }
        Self { place: place.to_string(), what }
    }

    pub(crate) fn at(place: &Path, what: impl Into<String>) -> Self {
        Self::new(place.display(), what)
    }
}
