//! The files of a store's folder that more than the database's own module has to know.

use std::fs;
use std::path::{Path, PathBuf};

/// The database's name in its folder.
pub(crate) const DATABASE: &str = "stride.db";

/// Where a folder's database lies.
pub(crate) fn database(dir: &Path) -> PathBuf {
    dir.join(DATABASE)
}

/// Where its write-ahead log lies.
pub(crate) fn log(dir: &Path) -> PathBuf {
    dir.join(format!("{DATABASE}-wal"))
}

/// Bytes of the write-ahead log; 0 if there is none.
pub(crate) fn log_bytes(dir: &Path) -> u64 {
    fs::metadata(log(dir)).map_or(0, |metadata| metadata.len())
}

/// Whether a folder holds a database. An empty file is none: SQLite would take it for a new one, and drop its log.
pub(crate) fn has_database(dir: &Path) -> bool {
    fs::metadata(database(dir)).is_ok_and(|metadata| metadata.len() > 0)
}
