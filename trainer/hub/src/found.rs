//! Result of finding an encoder.

use std::path::PathBuf;

/// Folder of an encoder that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Folder of the snapshot, with one file or link per file of the encoder.
    pub folder: PathBuf,
    /// Commit of the snapshot.
    pub commit: String,
    /// A notice for the user, such as a fallback to the cache.
    pub note: Option<String>,
}
