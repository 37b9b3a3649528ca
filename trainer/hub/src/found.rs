//! What is found.

use std::path::PathBuf;

/// A folder that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// The snapshot.
    pub folder: PathBuf,
    /// Its commit.
    pub commit: String,
    /// What was noticed on the way, for people.
    pub note: Option<String>,
}
