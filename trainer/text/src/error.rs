//! Errors in the files of a published encoder.

use motion::DataPath;

/// Largest number of characters of a message, which may quote a file.
const SHOWN: usize = 2_000;

/// A defect in a file of an encoder, with the expected content and the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{place}: {what}")]
pub struct EncoderError {
    /// The folder or the file.
    pub place: String,
    /// The defect, the expected content and the remedy.
    pub what: String,
}

impl EncoderError {
    pub(crate) fn new(place: impl ToString, what: impl Into<String>) -> Self {
        let mut what = what.into();
        // It may list what is missing.
        if let Some((end, _)) = what.char_indices().nth(SHOWN) {
            what.truncate(end);
            what.push_str("...");
        }
        Self { place: place.to_string(), what }
    }

    pub(crate) fn at(place: &DataPath, what: impl Into<String>) -> Self {
        Self::new(place.display(), what)
    }
}
