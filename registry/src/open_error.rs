//! Why a store could not be opened, and what to do about it.

use std::io;
use std::path::{Path, PathBuf};

use crate::blob::place::Place;
use crate::blob::{is_full, is_read_only};
use crate::identity::Mismatch;
use crate::lock::Holder;

/// Why a store could not be opened. Nothing in it was changed.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// Another process holds it.
    #[error("store `{}` is in use by {holder}", dir.display())]
    Busy {
        /// The store.
        dir: PathBuf,
        /// Who.
        holder: Holder,
    },
    /// Another process holds its blobs, which this folder is not the only one to reach.
    #[error("the blobs of store `{}` are in use by {by}: `{marker}` is renewed all the time", dir.display())]
    Held {
        /// The store.
        dir: PathBuf,
        /// Who.
        by: String,
        /// The marker beside the blobs.
        marker: String,
    },
    /// Its database, its blobs and its folder do not belong together, or one of them is missing or has gone back.
    #[error("store `{}` is not whole: {mismatch}", dir.display())]
    Mismatch {
        /// The store.
        dir: PathBuf,
        /// What does not fit.
        mismatch: Mismatch,
    },
    /// Its blobs lie elsewhere than where it was said.
    #[error("the blobs of store `{}` are at `{place}`, not at `{asked}`", dir.display())]
    Elsewhere {
        /// The store.
        dir: PathBuf,
        /// Where they are.
        place: Place,
        /// Where they were said to be.
        asked: Place,
    },
    /// The place of its blobs cannot be used; the message says why and what to do.
    #[error("store `{}`: {message}", dir.display())]
    Blobs {
        /// The store.
        dir: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// No store, and the folder is somebody else's.
    #[error("there is no store in `{}`, and none is made among other files: it holds {found}", dir.display())]
    NotEmpty {
        /// The folder.
        dir: PathBuf,
        /// Some of what lies in it.
        found: String,
    },
    /// There is none, and none was to be made.
    #[error("there is no store in `{}`", .0.display())]
    NotAStore(PathBuf),
    /// It cannot be written to.
    #[error("store is not writable: `{}`: {message}", path.display())]
    ReadOnly {
        /// What was tried.
        path: PathBuf,
        /// What the system said.
        message: String,
    },
    /// No space.
    #[error("no space for the store: `{}`: {message}", path.display())]
    Full {
        /// What was tried.
        path: PathBuf,
        /// What the system said.
        message: String,
    },
    /// SQLite's locks do not hold there.
    #[error("store `{}` lies on {kind}, where a database can lose committed data", dir.display())]
    NetworkFilesystem {
        /// The store.
        dir: PathBuf,
        /// Which file system.
        kind: &'static str,
    },
    /// A newer build has changed the schema.
    #[error("database `{}` has schema {found}, this build knows {known}", path.display())]
    NewerSchema {
        /// The database.
        path: PathBuf,
        /// Its schema.
        found: i64,
        /// The newest that this build knows.
        known: i64,
    },
    /// An older build made it, and a process that only reads does not change it.
    #[error("database `{}` has schema {found}, this build reads {known}", path.display())]
    OlderSchema {
        /// The database.
        path: PathBuf,
        /// Its schema.
        found: i64,
        /// The one that this build reads.
        known: i64,
    },
    /// It is not a database, or not one of ours.
    #[error("database `{}` is damaged: {message}", path.display())]
    Damaged {
        /// The database.
        path: PathBuf,
        /// What the database said.
        message: String,
    },
    /// Anything else.
    #[error("store: `{}`: {message}", path.display())]
    Other {
        /// What was tried.
        path: PathBuf,
        /// What the system said.
        message: String,
    },
}

impl OpenError {
    /// What the user can do.
    pub fn hint(&self) -> String {
        match self {
            Self::Busy { holder: Holder { address: Some(address), .. }, .. } => {
                format!("send work to {address}, wait for it to end, or choose another folder with `--store`")
            }
            Self::Busy { holder, .. } => {
                format!("wait for process {} to end, or choose another folder with `--store`", holder.pid)
            }
            Self::Held { .. } => "nothing was changed: stop that process first, and go on with the store that has the newer work; a \
                                  copy of a store needs a place for blobs of its own, which `registry backup` and `restore` give it"
                .into(),
            Self::Mismatch { mismatch, .. } => mismatch.hint().into(),
            Self::Elsewhere { asked, .. } => format!(
                "leave `--blobs` out, or choose another folder with `--store`; if the blobs were moved, `registry adopt --blobs \
                 {asked}` goes on with them there"
            ),
            Self::Blobs { .. } => "nothing was changed; see to it and run the same command again".into(),
            Self::NotEmpty { .. } => "choose a folder that is empty or does not exist with `--store`".into(),
            Self::NotAStore(_) => "`trainer run PIPELINE` makes one; name its folder with `--store`".into(),
            Self::ReadOnly { .. } => "make the folder writable for this user, or choose another with `--store`".into(),
            Self::Full { .. } => "`registry gc` removes what nothing needs, on a full disk too; or free some space otherwise".into(),
            Self::NetworkFilesystem { .. } => {
                "choose a folder on a local disk with `--store`; workers on other machines need none, they talk to the server".into()
            }
            Self::NewerSchema { .. } => "use the newer build that wrote it, or choose another folder with `--store`".into(),
            Self::OlderSchema { .. } => "a command that writes, such as `registry gc`, brings it up to date".into(),
            Self::Damaged { .. } => "restore it from a backup, or choose another folder with `--store`".into(),
            Self::Other { .. } => "look at the folder's permissions and disk, or choose another with `--store`".into(),
        }
    }

    pub(crate) fn io(path: &Path, e: &io::Error) -> Self {
        let (path, message) = (path.to_owned(), e.to_string());
        if is_full(e) {
            Self::Full { path, message }
        } else if is_read_only(e) {
            Self::ReadOnly { path, message }
        } else {
            Self::Other { path, message }
        }
    }
}
