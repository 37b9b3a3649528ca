//! The store as a whole: a folder with a database, blobs and a lock.
//!
//! ```text
//! .stride/
//!   stride.db        SQLite, WAL
//!   blobs/sha256/    bytes by digest
//!   staging/         blobs on their way; emptied when the store is opened
//!   lock             the operating system's lock, and who holds it
//! ```
//!
//! One process holds a store. A second one is told who, and asks that one over HTTP.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::stage::Keep;
use protocol::{Alias, Digest, ModelName, TaskId};
use sqlx::SqlitePool;

use crate::blob::BlobStore;
use crate::blob::fs::{Folder, free_bytes, is_full, is_read_only};
use crate::catalog::{Expect, Pick, PromoteOrder, Promotion, Which};
use crate::db;
use crate::db::writer::{Done, Order, Writer};
use crate::lock::{Holder, StoreLock, Taken, network_filesystem};
use crate::retention::Plan;
use crate::{Write, WriteError};

/// Below this much free space nothing is opened for writing: the database's log would not fit.
const OPEN_NEEDS_BYTES: u64 = 16 << 20;

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
            Self::NotAStore(_) => "`trainer run PIPELINE` makes one; name its folder with `--store`".into(),
            Self::ReadOnly { .. } => "make the folder writable for this user, or choose another with `--store`".into(),
            Self::Full { .. } => "free some space, or choose a folder on another disk with `--store`".into(),
            Self::NetworkFilesystem { .. } => {
                "choose a folder on a local disk with `--store`; workers on other machines need none, they talk to the server".into()
            }
            Self::NewerSchema { .. } => "use the newer build that wrote it, or choose another folder with `--store`".into(),
            Self::Damaged { .. } => "restore it from a backup, or choose another folder with `--store`".into(),
            Self::Other { .. } => "look at the folder's permissions and disk, or choose another with `--store`".into(),
        }
    }

    fn io(path: &Path, e: &io::Error) -> Self {
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

/// A store, held by this process. Clones share it; the last one to go lets it go.
#[derive(Debug, Clone)]
pub struct Store(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    dir: PathBuf,
    blobs: BlobStore,
    readers: SqlitePool,
    /// Before `lock`: the writer ends first.
    writer: Writer,
    lock: Arc<StoreLock>,
}

impl Store {
    /// Opens the store in `dir`, making it if there is none. `holder` says to others what this process is.
    pub async fn open(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        let io = |path: &Path, e: io::Error| OpenError::io(path, &e);
        DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|e| io(dir, e))?;
        let dir = dir.canonicalize().map_err(|e| io(dir, e))?;
        close_to_others(&dir).map_err(|e| io(&dir, e))?;
        if let Some(kind) = network_filesystem(&dir).map_err(|e| io(&dir, e))? {
            return Err(OpenError::NetworkFilesystem { dir, kind });
        }
        let path = dir.join("lock");
        let lock = match StoreLock::take(&path, holder).map_err(|e| io(&path, e))? {
            Taken::Ours(lock) => Arc::new(lock),
            Taken::Busy(holder) => return Err(OpenError::Busy { dir, holder }),
        };
        let free = free_bytes(&dir).map_err(|e| io(&dir, e))?;
        if free < OPEN_NEEDS_BYTES {
            let message = format!("{free} bytes are free, {OPEN_NEEDS_BYTES} are needed");
            return Err(OpenError::Full { path: dir, message });
        }
        let blobs = BlobStore::new(Folder::open(&dir).map_err(|e| io(&dir, e))?);
        let writer = Writer::start(dir.clone(), blobs.clone(), Arc::clone(&lock)).await?;
        let readers = db::open_readers(&dir);
        Ok(Self(Arc::new(Inner { dir, blobs, readers, writer, lock })))
    }

    /// Opens a store that is there.
    pub async fn open_existing(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        if !db::is_there(dir) {
            return Err(OpenError::NotAStore(dir.to_owned()));
        }
        Self::open(dir, holder).await
    }

    /// Tells other processes where this one answers requests.
    pub fn set_address(&self, address: impl Into<String>) -> io::Result<()> {
        self.0.lock.set_address(address.into())
    }

    /// What others are told about this process.
    pub fn holder(&self) -> Holder {
        self.0.lock.holder()
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.0.dir
    }

    /// The blobs. Their calls block.
    pub fn blobs(&self) -> &BlobStore {
        &self.0.blobs
    }

    pub(crate) fn readers(&self) -> &SqlitePool {
        &self.0.readers
    }

    /// One transaction: returns once all of `writes` would survive a loss of power, or none is stored.
    pub async fn write(&self, writes: Vec<Write>) -> Result<(), WriteError> {
        self.order(Order::Write(writes)).await.map(|_| ())
    }

    /// Moves an alias to a version: compares it with `expect` if given, judges the gates, moves, logs.
    #[expect(clippy::too_many_arguments, reason = "what a promotion is made of")]
    pub async fn promote(
        &self,
        model: &ModelName,
        pick: Pick,
        alias: &Alias,
        expect: Option<Expect>,
        require: Vec<String>,
        reason: &str,
        actor: &str,
    ) -> Result<Promotion, WriteError> {
        let order = PromoteOrder {
            model: model.clone(),
            alias: alias.clone(),
            to: Which::Pick(pick),
            expect,
            require,
            reason: reason.to_owned(),
            actor: actor.to_owned(),
        };
        promoted(self.order(Order::Promote(order)).await?)
    }

    /// Moves an alias back to `to`, or to the version before its last promotion. This is a log entry itself.
    pub async fn rollback(
        &self,
        model: &ModelName,
        alias: &Alias,
        to: Option<u64>,
        expect: Option<Expect>,
        reason: &str,
        actor: &str,
    ) -> Result<Promotion, WriteError> {
        let (model, alias, reason, actor) = (model.clone(), alias.clone(), reason.to_owned(), actor.to_owned());
        promoted(self.order(Order::Rollback { model, alias, to, expect, reason, actor }).await?)
    }

    /// Forgets a task's checkpoints but those that `keep` names; returns the manifests that were forgotten. Their blobs go
    /// with the next [`Self::gc`].
    pub async fn prune_checkpoints(&self, task: &TaskId, keep: Keep) -> Result<Vec<Digest>, WriteError> {
        match self.order(Order::PruneCheckpoints { task: task.clone(), keep }).await? {
            Done::Pruned(manifests) => Ok(manifests),
            done => Err(unexpected(&done)),
        }
    }

    /// Keeps an artifact whatever else points at it.
    pub async fn pin(&self, digest: Digest, reason: &str) -> Result<(), WriteError> {
        self.order(Order::Pin { digest, reason: Some(reason.to_owned()) }).await.map(|_| ())
    }

    /// Ends a pin.
    pub async fn unpin(&self, digest: Digest) -> Result<(), WriteError> {
        self.order(Order::Pin { digest, reason: None }).await.map(|_| ())
    }

    /// Removes blobs that nothing needs and that were last put more than `grace_ms` ago; returns what went.
    pub async fn gc(&self, grace_ms: i64) -> Result<Plan, WriteError> {
        match self.order(Order::Collect { grace_ms }).await? {
            Done::Collected(plan) => Ok(plan),
            done => Err(unexpected(&done)),
        }
    }

    async fn order(&self, order: Order) -> Result<Done, WriteError> {
        self.0.writer.order(order).await
    }
}

/// Takes the folder from everybody but its user; whoever cannot reach it reaches nothing in it. A folder of somebody else, or
/// of a group that was let in by hand, stays as it is.
fn close_to_others(dir: &Path) -> io::Result<()> {
    let metadata = fs::metadata(dir)?;
    let mode = metadata.permissions().mode();
    if mode & 0o007 != 0 && metadata.uid() == nix::unistd::geteuid().as_raw() {
        fs::set_permissions(dir, fs::Permissions::from_mode(mode & !0o077))?;
    }
    Ok(())
}

fn promoted(done: Done) -> Result<Promotion, WriteError> {
    match done {
        Done::Promoted(promotion) => Ok(*promotion),
        done => Err(unexpected(&done)),
    }
}

fn unexpected(done: &Done) -> WriteError {
    WriteError::Internal(format!("the writer answered {done:?} to another order"))
}
