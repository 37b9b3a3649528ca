//! Errors of fetching a published set.

use std::io;
use std::path::{Path, PathBuf};

/// A set cannot be completed.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// The folder has something else than the set.
    #[error("{}: {what}", folder.display())]
    Taken {
        folder: PathBuf,
        /// Difference between the folder and the set.
        what: String,
    },
    /// Another process fetches into the folder.
    #[error("{}: another process fetches into this folder", folder.display())]
    Busy { folder: PathBuf },
    /// The server cannot be reached, or stopped sending.
    #[error("{address}: {why}")]
    Away {
        address: String,
        /// Error of the connection.
        why: String,
    },
    /// The server refuses the archive, or it is too large.
    #[error("{address}: {why}")]
    Refused {
        address: String,
        /// Answer of the server.
        why: String,
    },
    /// The source has other content than the list.
    #[error("{from}: {what}")]
    Content {
        /// Address, archive or folder.
        from: String,
        /// Difference from the list.
        what: String,
    },
    /// The disk is full.
    #[error("{}: the disk is full; the set needs {} MB more", file.display(), bytes.div_ceil(1_000_000))]
    DiskFull {
        file: PathBuf,
        /// Size of the files that are missing.
        bytes: u64,
    },
    /// A file cannot be read or written.
    #[error("{}: {source}", file.display())]
    Io {
        file: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
}

impl FetchError {
    /// Advice to the user.
    pub fn advice(&self) -> &'static str {
        match self {
            Self::Taken { .. } => "name another folder, or move this one away",
            Self::Busy { .. } => "wait for it to end",
            Self::Away { .. } => "the same command continues; without a network, `--from` reads a clone or an archive",
            Self::Refused { .. } => "check the address and the proxy; `--from` reads a clone or an archive instead",
            Self::Content { .. } => "the checked files are kept; the same command tries again, `--from` reads a clone",
            Self::DiskFull { .. } => "free some space, or name a folder on another disk; the same command continues",
            Self::Io { source, .. } if source.kind() == io::ErrorKind::NotFound => {
                "name a file or folder that exists; `--from` reads a clone or an archive"
            }
            Self::Io { .. } => "make the folder writable, or name another one; the same command continues",
        }
    }

    /// Returns true if the same command may succeed later.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Away { .. } | Self::Busy { .. })
    }
}

/// Names the file of a system's error. A full disk is reported with the bytes that are missing.
pub(crate) fn io_error(file: &Path, missing: u64) -> impl Fn(io::Error) -> FetchError + '_ {
    move |source| match source.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            FetchError::DiskFull { file: file.to_owned(), bytes: missing }
        }
        _ => FetchError::Io { file: file.to_owned(), source },
    }
}
