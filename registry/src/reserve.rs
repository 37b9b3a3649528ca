//! A reserve of some megabytes that is released when the disk is full. The database can then be opened for a
//! collection.

use std::fs::{self, File};
use std::io;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};

use crate::blob::disk::free_bytes;

/// Free space below which a store is opened only for a collection, because the database's log would not fit.
pub(crate) const OPEN_NEEDS_BYTES: u64 = 16 << 20;
/// Size of the reserve: enough for the database's log during a collection.
const BYTES: u64 = 4 << 20;

fn path(dir: &Path) -> PathBuf {
    dir.join("reserve")
}

/// Creates the reserve if it is missing and there is space for it.
pub(crate) fn keep(dir: &Path) {
    let path = path(dir);
    if path.exists() || !free_bytes(dir).is_ok_and(|free| free >= OPEN_NEEDS_BYTES + BYTES) {
        return;
    }
    let make = || -> io::Result<()> {
        let file = File::create(&path)?;
        nix::fcntl::posix_fallocate(file.as_fd(), 0, i64::try_from(BYTES).unwrap_or(i64::MAX))?;
        Ok(())
    };
    if let Err(error) = make() {
        // The file system has no reservations; a full disk must be freed by hand.
        tracing::debug!(%error, "no reserve for a full disk");
        let _ = fs::remove_file(&path);
    }
}

/// Releases the reserve if the disk is full.
pub(crate) fn release_if_full(dir: &Path) {
    if free_bytes(dir).is_ok_and(|free| free < OPEN_NEEDS_BYTES) {
        // The reserve may be missing or already released.
        let _ = fs::remove_file(path(dir));
    }
}
