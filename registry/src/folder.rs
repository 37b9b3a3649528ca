//! Paths of a store's folder that several modules need.

use std::fs;
use std::path::{Path, PathBuf};

/// File name of the database in its folder.
pub(crate) const DATABASE: &str = "stride.db";

/// Returns the path of the database.
pub(crate) fn database(dir: &Path) -> PathBuf {
    dir.join(DATABASE)
}

/// Returns the path of its write-ahead log.
pub(crate) fn log(dir: &Path) -> PathBuf {
    dir.join(format!("{DATABASE}-wal"))
}

/// Returns the bytes of the write-ahead log; 0 if it is missing.
pub(crate) fn log_bytes(dir: &Path) -> u64 {
    fs::metadata(log(dir)).map_or(0, |metadata| metadata.len())
}

/// Size in bytes of the database without its log; 0 if there is none.
pub(crate) fn database_bytes(dir: &Path) -> u64 {
    fs::metadata(database(dir)).map_or(0, |metadata| metadata.len())
}

/// Returns true if the folder has a database. An empty file does not count: SQLite would treat it as new and drop its
/// log.
pub(crate) fn has_database(dir: &Path) -> bool {
    fs::metadata(database(dir)).is_ok_and(|metadata| metadata.len() > 0)
}
