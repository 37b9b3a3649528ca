//! A folder of this process for parsers that read files.

use std::fs;
use std::path::PathBuf;
use std::sync::OnceLock;

/// The folder. Its content stays between calls.
///
/// # Panics
/// If it cannot be created.
pub fn folder() -> PathBuf {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    FOLDER.get_or_init(|| tempfile::tempdir().expect("a folder for temporary files")).path().to_owned()
}

/// Writes a file with these bytes into the folder.
///
/// # Panics
/// If it cannot be written.
pub fn file(name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder().join(name);
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).expect("a folder of ours");
    }
    fs::write(&path, bytes).expect("a file of ours");
    path
}
