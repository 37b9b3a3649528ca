//! A few megabytes that are given up when the disk is full, so that the database can be opened to collect what nothing needs.

use std::fs::{self, File};
use std::io;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};

use crate::blob::disk::free_bytes;

/// Below this much free space nothing is opened for anything but collecting: the database's log would not fit.
pub(crate) const OPEN_NEEDS_BYTES: u64 = 16 << 20;
/// Enough for the database's log while a collection is under way.
const BYTES: u64 = 4 << 20;

fn path(dir: &Path) -> PathBuf {
    dir.join("reserve")
}

/// Makes the reserve if it is missing and there is space for it.
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
        // A file system without reservations; a full disk has to be freed by hand there.
        tracing::debug!(%error, "no reserve for a full disk");
        let _ = fs::remove_file(&path);
    }
}

/// Gives the reserve up if the disk is full.
pub(crate) fn release_if_full(dir: &Path) {
    if free_bytes(dir).is_ok_and(|free| free < OPEN_NEEDS_BYTES) {
        // There may be none, or it was given up before.
        let _ = fs::remove_file(path(dir));
    }
}
