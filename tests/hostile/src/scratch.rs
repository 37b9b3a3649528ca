//! A folder of this process for parsers that read files.

use std::fs;
use std::path::PathBuf;
use std::sync::OnceLock;

/// The folder, which stays as it was left.
///
/// # Panics
/// If there is no place for it.
pub fn folder() -> PathBuf {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    FOLDER.get_or_init(|| tempfile::tempdir().expect("a folder for temporary files")).path().to_owned()
}

/// A file in it with these bytes.
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
