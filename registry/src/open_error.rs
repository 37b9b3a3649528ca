//! Errors of opening a store, with their remedies.

use std::io;
use std::path::{Path, PathBuf};

use crate::blob::place::Place;
use crate::blob::{is_full, is_read_only};
use crate::identity::Mismatch;
use crate::lock::Holder;

/// Reason why a store could not be opened. Nothing was changed.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// Another process holds the store.
    #[error("store `{}` is in use by {holder}", dir.display())]
    Busy {
        /// Folder of the store.
        dir: PathBuf,
        /// The process that holds it.
        holder: Holder,
    },
    /// Another process holds the store's blobs, which several folders can reach.
    #[error("the blobs of store `{}` are in use by {by}, which keeps renewing `{marker}`", dir.display())]
    Held {
        dir: PathBuf,
        /// Description of the process.
        by: String,
        /// The marker beside the blobs.
        marker: String,
    },
    /// Database, blobs and folder do not belong together, or one of them is missing or too old.
    #[error("store `{}` is incomplete: {mismatch}", dir.display())]
    Mismatch {
        dir: PathBuf,
        /// The mismatch.
        mismatch: Mismatch,
    },
    /// The blobs are in another place than the one given.
    #[error("the blobs of store `{}` are at `{place}`, not at `{asked}`", dir.display())]
    Elsewhere {
        dir: PathBuf,
        /// Actual place of the blobs.
        place: Place,
        /// The given place.
        asked: Place,
    },
    /// The blobs' place cannot be used; the message has the cause and remedy.
    #[error("store `{}`: {message}", dir.display())]
    Blobs {
        dir: PathBuf,
        /// Cause and remedy.
        message: String,
    },
    /// The folder names another catalog than the command.
    #[error("store `{}`: {message}", dir.display())]
    Catalog {
        dir: PathBuf,
        /// Cause and remedy.
        message: String,
    },
    /// The folder is not a store and has other files.
    #[error("there is no store in `{}`, and the folder is not empty: it has {found}", dir.display())]
    NotEmpty {
        dir: PathBuf,
        /// Names of some of its files.
        found: String,
    },
    /// The store does not exist and must not be created.
    #[error("there is no store in `{}`", .0.display())]
    NotAStore(PathBuf),
    /// The store is not writable.
    #[error("store is not writable: `{}`: {message}", path.display())]
    ReadOnly {
        /// Path of the failed call.
        path: PathBuf,
        /// Error of the operating system.
        message: String,
    },
    /// The disk is full.
    #[error("no space for the store: `{}`: {message}", path.display())]
    Full {
        /// Path of the failed call.
        path: PathBuf,
        /// Error of the operating system.
        message: String,
    },
    /// SQLite's locks do not work on this file system.
    #[error("store `{}` is on {kind}, where a database can lose committed data", dir.display())]
    NetworkFilesystem {
        dir: PathBuf,
        /// Name of the file system.
        kind: &'static str,
    },
    /// A newer build has changed the schema.
    #[error("database `{}` has schema {found}, but this build reads up to {known}", path.display())]
    NewerSchema {
        /// Path of the database.
        path: PathBuf,
        /// Schema of the database.
        found: i64,
        /// Newest schema of this build.
        known: i64,
    },
    /// An older build made the database, and a read-only process does not migrate it.
    #[error("database `{}` has schema {found}, but this build reads {known}", path.display())]
    OlderSchema {
        /// Path of the database.
        path: PathBuf,
        /// Schema of the database.
        found: i64,
        /// The schema that this build reads.
        known: i64,
    },
    /// The file is not a database, or not one of a store.
    #[error("database `{}` is damaged: {message}", path.display())]
    Damaged {
        /// Path of the database.
        path: PathBuf,
        /// Error of the database.
        message: String,
    },
    /// Another error of the operating system.
    #[error("store: `{}`: {message}", path.display())]
    Other {
        /// Path of the failed call.
        path: PathBuf,
        /// Error of the operating system.
        message: String,
    },
}

impl OpenError {
    /// Returns the remedy for the user.
    pub fn hint(&self) -> String {
        match self {
            Self::Busy { holder: Holder { address: Some(address), .. }, .. } => {
                format!("send work to {address}, wait for it to end, or choose another folder with `--store`")
            }
            Self::Busy { holder, .. } => {
                format!("wait for process {} to end, or choose another folder with `--store`", holder.pid)
            }
            Self::Held { .. } => "nothing was changed: stop that process first and continue with the store that has the newer work; a \
                                  copy of a store needs its own place for blobs: use `registry backup` and `registry restore`"
                .into(),
            Self::Mismatch { mismatch, .. } => mismatch.hint().into(),
            Self::Elsewhere { asked, .. } => format!(
                "leave `--blobs` out, or choose another folder with `--store`; if the blobs were moved, `registry adopt --blobs \
                 {asked}` uses them there"
            ),
            Self::Blobs { .. } | Self::Catalog { .. } => "nothing was changed; fix the problem and run the same command again".into(),
            Self::NotEmpty { .. } => "choose a folder that is empty or does not exist with `--store`".into(),
            Self::NotAStore(_) => "`trainer run PIPELINE` creates one; name its folder with `--store`".into(),
            Self::ReadOnly { .. } => "make the folder writable for this user, or choose another with `--store`".into(),
            Self::Full { .. } => "`registry gc` removes unneeded blobs, even on a full disk; or free space in another way".into(),
            Self::NetworkFilesystem { .. } => {
                "choose a folder on a local disk with `--store`; workers on other machines need no store; they use the server".into()
            }
            Self::NewerSchema { .. } => "use the newer build that wrote it, or choose another folder with `--store`".into(),
            Self::OlderSchema { .. } => "a command that writes, such as `registry gc`, migrates it".into(),
            Self::Damaged { .. } => "restore it from a backup, or choose another folder with `--store`".into(),
            // Errors of PostgreSQL have its address as their path.
            Self::Other { path, .. } if path.starts_with("postgres:") => {
                "nothing was changed: check that the database exists and answers, its address, and the file of the password".into()
            }
            Self::Other { .. } => "check the folder's permissions and disk, or choose another with `--store`".into(),
        }
    }

    pub(crate) fn io(path: &Path, e: &io::Error) -> Self {
        let path = path.to_owned();
        let message = e.to_string();
        if is_full(e) {
            Self::Full { path, message }
        } else if is_read_only(e) {
            Self::ReadOnly { path, message }
        } else {
            Self::Other { path, message }
        }
    }
}
