//! Uploads that arrive in several requests, and what tasks that are still held have uploaded.
//!
//! A cut upload keeps what has arrived: its holder asks how much that is and goes on from there. What has arrived belongs to
//! one worker's hold on one task, is in nobody else's way, and goes when the hold ends or when nothing came for
//! [`IDLE`]. A stored blob is noted for its task until the task is let go, so that collection leaves it alone however long the
//! row that will name it takes.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use checkpoint::BlobError;
use protocol::message::Grant;
use protocol::{Digest, Incarnation, TaskId, WorkerId};

use super::{BlobStore, Upload};

/// How long an upload may rest.
pub const IDLE: Duration = Duration::from_secs(600);
/// How many uploads one holder may have begun.
const PER_HOLDER: usize = 8;

/// Whose upload it is. The fence is left out: it grows when a gang regroups, and its lead uploads on.
type Holder = (TaskId, WorkerId, Incarnation);

#[derive(Debug, Default)]
pub(super) struct Uploads {
    begun: Mutex<HashMap<(Holder, Digest), Begun>>,
    held: Mutex<BTreeMap<TaskId, BTreeSet<Digest>>>,
}

#[derive(Debug)]
struct Begun {
    /// `None` while a request writes to it.
    upload: Option<Upload>,
    bytes: u64,
    touched: Instant,
}

/// Why an upload does not go on.
#[derive(Debug, thiserror::Error)]
pub enum ResumeError {
    /// It goes on at another byte.
    #[error("{staged} bytes of this blob have arrived; go on from there, not from {offset}")]
    Offset {
        /// Bytes that have arrived.
        staged: u64,
        /// Where the request begins.
        offset: u64,
    },
    /// Another request writes to it.
    #[error("another request is uploading this blob")]
    Busy,
    /// The holder has begun too many.
    #[error("{0} uploads have been begun and not ended by this worker")]
    TooMany(usize),
    /// The store does not take it.
    #[error(transparent)]
    Blob(#[from] BlobError),
}

fn holder(grant: &Grant) -> Holder {
    (grant.task.clone(), grant.worker.clone(), grant.incarnation)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl BlobStore {
    /// How many bytes of a blob have arrived in the name of a grant.
    pub fn staged(&self, grant: &Grant, digest: Digest) -> u64 {
        let begun = lock(&self.uploads().begun);
        let upload = begun.get(&(holder(grant), digest)).and_then(|begun| begun.upload.as_ref());
        upload.map_or(0, Upload::written)
    }

    /// Takes up an upload of `bytes` bytes at byte `offset`; at 0 it begins, anew if need be. What has arrived when it is
    /// dropped waits for the holder's next request.
    pub fn take_up(&self, grant: &Grant, digest: Digest, offset: u64, bytes: u64) -> Result<Arriving, ResumeError> {
        let arriving = |upload| Arriving { store: self.clone(), holder: holder(grant), digest, upload: Some(upload) };
        let mut all = lock(&self.uploads().begun);
        let place = (holder(grant), digest);
        if let Some(begun) = all.get_mut(&place) {
            let Some(upload) = begun.upload.take() else { return Err(ResumeError::Busy) };
            begun.touched = Instant::now();
            let staged = upload.written();
            if staged == offset && begun.bytes == bytes {
                return Ok(arriving(upload));
            }
            if offset != 0 {
                begun.upload = Some(upload);
                return Err(ResumeError::Offset { staged, offset });
            }
            drop(upload);
        } else if offset != 0 {
            return Err(ResumeError::Offset { staged: 0, offset });
        } else {
            let of_holder = all.keys().filter(|(holder, _)| *holder == place.0).count();
            if of_holder >= PER_HOLDER {
                return Err(ResumeError::TooMany(of_holder));
            }
        }
        match self.begin(bytes) {
            Ok(upload) => {
                all.insert(place, Begun { upload: None, bytes, touched: Instant::now() });
                Ok(arriving(upload))
            }
            Err(error) => {
                all.remove(&place);
                Err(error.into())
            }
        }
    }

    /// Notes that a held task has stored a blob, which is kept until [`Self::let_go`].
    pub fn hold(&self, task: &TaskId, digest: Digest) {
        lock(&self.uploads().held).entry(task.clone()).or_default().insert(digest);
    }

    /// What held tasks have stored: roots of a collection.
    pub fn held(&self) -> BTreeSet<Digest> {
        lock(&self.uploads().held).values().flatten().copied().collect()
    }

    /// Forgets what belongs to tasks that are not held any more, and uploads at which nothing came for long.
    pub fn let_go(&self, is_held: impl Fn(&TaskId) -> bool) {
        lock(&self.uploads().held).retain(|task, _| is_held(task));
        // One that a request writes to right now ends with that request.
        lock(&self.uploads().begun).retain(|((task, _, _), _), begun| {
            begun.upload.is_none() || (is_held(task) && begun.touched.elapsed() < IDLE)
        });
    }
}

/// An upload that a request writes to.
#[derive(Debug)]
pub struct Arriving {
    store: BlobStore,
    holder: Holder,
    digest: Digest,
    /// `None` once it has ended.
    upload: Option<Upload>,
}

impl Arriving {
    /// Appends bytes. An error ends the upload.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        let Some(upload) = &mut self.upload else { return Err(BlobError::Refused("the upload has ended".to_owned())) };
        let written = upload.write(bytes);
        if written.is_err() {
            self.upload = None;
        }
        written
    }

    /// Bytes that have arrived.
    pub fn written(&self) -> u64 {
        self.upload.as_ref().map_or(0, Upload::written)
    }

    /// Stores the blob if all of it has arrived, and notes it for its task; says whether it did.
    pub fn finish(mut self) -> Result<bool, BlobError> {
        let Some(upload) = self.upload.take_if(|upload| upload.is_complete()) else { return Ok(false) };
        // Before it is there: a collection in between must not take it.
        self.store.hold(&self.holder.0, self.digest);
        self.store.commit(upload, self.digest)?;
        Ok(true)
    }
}

impl Drop for Arriving {
    fn drop(&mut self) {
        let mut all = lock(&self.store.uploads().begun);
        let place = (self.holder.clone(), self.digest);
        match (self.upload.take(), all.get_mut(&place)) {
            (Some(upload), Some(begun)) => {
                begun.upload = Some(upload);
                begun.touched = Instant::now();
            }
            _ => drop(all.remove(&place)),
        }
    }
}
