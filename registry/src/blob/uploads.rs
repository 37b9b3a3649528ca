//! Uploads that arrive in several requests, and the blobs that held tasks have uploaded.
//!
//! An interrupted upload keeps its bytes. Its owner asks for their number and continues from there, even after another
//! process has opened the store. The bytes belong to one worker's hold on one task and block no other upload. They are
//! deleted when the hold ends, or after [`IDLE`] without a request. A stored blob is recorded for its task until the
//! task is released. Collection therefore keeps it however late a row names it (`holds`).

use std::collections::{BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use checkpoint::BlobError;
use protocol::digest::Hasher;
use protocol::message::Grant;
use protocol::{Digest, TaskId};

use super::BlobStore;
use super::begun::{Begun, Holder, Upload};

/// Time without a request after which an upload is deleted.
pub const IDLE: Duration = Duration::from_secs(600);
/// Limit of unfinished uploads of one owner.
const PER_HOLDER: usize = 8;

/// Reason why an upload cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum ResumeError {
    /// The upload continues at another byte.
    #[error("{staged} bytes of this blob have arrived; continue at byte {staged}, not at {offset}")]
    Offset {
        /// Number of bytes that have arrived.
        staged: u64,
        /// Offset of the request.
        offset: u64,
    },
    /// Another request writes to the upload.
    #[error("another request is uploading this blob")]
    Busy,
    /// The owner has too many unfinished uploads.
    #[error("this worker has {0} unfinished uploads; finish one first")]
    TooMany(usize),
    /// The blob store refused the bytes.
    #[error(transparent)]
    Blob(#[from] BlobError),
}

/// Returns the unique name of an upload's staging file, equal in every process.
pub(super) fn staged_name((holder, digest): &(Holder, Digest)) -> String {
    let (task, worker, incarnation) = holder;
    Digest::of(format!("{task}\n{worker}\n{incarnation}\n{digest}").as_bytes()).hex()
}

pub(super) fn holder(grant: &Grant) -> Holder {
    (grant.task.clone(), grant.worker.clone(), grant.incarnation)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl BlobStore {
    /// Returns the number of bytes of a blob that have arrived for a grant.
    pub fn staged(&self, grant: &Grant, digest: Digest) -> Result<u64, BlobError> {
        let place = (holder(grant), digest);
        self.recall(&place)?;
        let begun = lock(&self.uploads().begun);
        let upload = begun.get(&place).and_then(|begun| begun.upload.as_ref());
        Ok(upload.map_or(0, Upload::written))
    }

    /// Continues an upload of `bytes` bytes at byte `offset`; offset 0 starts it again. Dropping the returned value
    /// keeps the bytes for the owner's next request.
    pub fn take_up(&self, grant: &Grant, digest: Digest, offset: u64, bytes: u64) -> Result<Arriving, ResumeError> {
        let arriving = |upload| Arriving {
            store: self.clone(),
            holder: holder(grant),
            digest,
            upload: Some(upload),
            waits: false,
        };
        let place = (holder(grant), digest);
        self.recall(&place)?;
        let mut all = lock(&self.uploads().begun);
        if let Some(begun) = all.get_mut(&place) {
            let Some(mut upload) = begun.upload.take() else { return Err(ResumeError::Busy) };
            begun.touched = Instant::now();
            let staged = upload.written();
            let fits = begun.bytes.is_none_or(|announced| announced == bytes) && staged <= bytes;
            if staged == offset && fits {
                begun.bytes = Some(bytes);
                upload.bytes = bytes;
                return Ok(arriving(upload));
            }
            if offset != 0 && staged <= bytes {
                begun.upload = Some(upload);
                return Err(ResumeError::Offset { staged, offset });
            }
            drop(upload);
        }
        if offset != 0 {
            self.discard(&mut all, &place);
            return Err(ResumeError::Offset { staged: 0, offset });
        }
        let of_holder = all.keys().filter(|other| other.0 == place.0 && **other != place).count();
        if of_holder >= PER_HOLDER {
            return Err(ResumeError::TooMany(of_holder));
        }
        match self.backend().stage_as(&staged_name(&place), bytes) {
            Ok(staged) => {
                all.insert(place, Begun { upload: None, waits: false, bytes: Some(bytes), touched: Instant::now() });
                Ok(arriving(Upload::new(staged, bytes)))
            }
            Err(error) => {
                self.discard(&mut all, &place);
                Err(error.into())
            }
        }
    }

    /// Opens the staged bytes of an upload that waits, or that an earlier process began.
    fn recall(&self, place: &(Holder, Digest)) -> Result<(), BlobError> {
        if lock(&self.uploads().begun).get(place).is_some_and(|begun| !begun.waits) {
            return Ok(());
        }
        // Hashed without the lock that every other upload needs.
        let mut hasher = Hasher::default();
        let mut written = 0;
        let mut read = |part: &[u8]| {
            hasher.update(part);
            written += part.len() as u64;
        };
        let staged = self.backend().staged_as(&staged_name(place), &mut read)?;
        let mut all = lock(&self.uploads().begun);
        // Another request may already be writing to it.
        if all.get(place).is_none_or(|begun| begun.waits) {
            all.remove(place);
            if let Some(staged) = staged {
                let upload = Some(Upload { staged, hasher, written, bytes: written, content: None });
                all.insert(place.clone(), Begun { upload, waits: false, bytes: None, touched: Instant::now() });
            }
        }
        Ok(())
    }

    /// Deletes an upload and its bytes.
    fn discard(&self, all: &mut HashMap<(Holder, Digest), Begun>, place: &(Holder, Digest)) {
        all.remove(place);
        if let Err(error) = self.backend().unstage(&staged_name(place)) {
            tracing::warn!(%error, "cannot delete the staged bytes of an upload");
        }
    }

    /// Keeps a blob that a held task has stored until [`Self::let_go`], in this process. [`crate::Store::hold`] also
    /// keeps it for later ones.
    pub fn hold(&self, task: &TaskId, digest: Digest) {
        lock(&self.uploads().held).hold(task, digest);
    }

    /// Returns true if a held task has stored the blob.
    pub fn has_stored(&self, task: &TaskId, digest: Digest) -> bool {
        lock(&self.uploads().held).has(task, digest)
    }

    /// Protects a blob, which need not exist yet, until the returned value is dropped. Used until the row that names it
    /// is stored.
    #[must_use = "the blob is protected only while this value lives"]
    pub fn protect(&self, digest: Digest) -> Protected {
        *lock(&self.uploads().protected).entry(digest).or_default() += 1;
        Protected { store: self.clone(), digest }
    }

    /// Returns the blobs of held tasks and the protected ones: roots of a collection.
    pub fn held(&self) -> BTreeSet<Digest> {
        let mut held = lock(&self.uploads().held).all();
        held.extend(lock(&self.uploads().protected).keys());
        held
    }

    /// Releases the blobs of tasks that are no longer held, and returns these tasks. Deletes uploads without a request
    /// for `idle`, usually [`IDLE`].
    pub fn let_go(&self, idle: Duration, is_held: impl Fn(&TaskId) -> bool) -> Vec<TaskId> {
        let released = lock(&self.uploads().held).let_go(&is_held);
        let mut all = lock(&self.uploads().begun);
        // An upload that a request is writing to ends with that request.
        let rests = |begun: &Begun| begun.upload.is_some() || begun.waits;
        let over = |begun: &Begun, task| rests(begun) && (begun.touched.elapsed() >= idle || !is_held(task));
        let gone = all.iter().filter(|(((task, _, _), _), begun)| over(begun, task)).map(|(place, _)| place.clone());
        for place in gone.collect::<Vec<_>>() {
            self.discard(&mut all, &place);
        }
        if self.uploads().since.elapsed() < idle {
            return released;
        }
        // No request has asked for the other uploads of an earlier process.
        let known: BTreeSet<String> = all.keys().map(staged_name).collect();
        if let Err(error) = self.backend().unstage_but(&known) {
            tracing::warn!(%error, "cannot delete the staged bytes of old uploads");
        }
        released
    }
}

/// Protects a blob from collection while it lives.
#[derive(Debug)]
pub struct Protected {
    store: BlobStore,
    digest: Digest,
}

impl Drop for Protected {
    fn drop(&mut self) {
        let mut protected = lock(&self.store.uploads().protected);
        if let Some(count) = protected.get_mut(&self.digest) {
            *count -= 1;
            if *count == 0 {
                protected.remove(&self.digest);
            }
        }
    }
}

/// An upload that a request writes to.
#[derive(Debug)]
pub struct Arriving {
    store: BlobStore,
    holder: Holder,
    digest: Digest,
    /// `None` after the end.
    upload: Option<Upload>,
    /// True if the upload has ended but its bytes stay in the staging area.
    waits: bool,
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

    /// Returns true if all bytes have arrived.
    pub fn is_complete(&self) -> bool {
        self.upload.as_ref().is_some_and(Upload::is_complete)
    }

    /// Returns the number of bytes that have arrived.
    pub fn written(&self) -> u64 {
        self.upload.as_ref().map_or(0, Upload::written)
    }

    /// Stores the blob and records it for its task; returns `false` if bytes are missing. If it cannot be stored now,
    /// the bytes wait for the owner's next request.
    pub fn finish(mut self) -> Result<bool, BlobError> {
        let Some(upload) = self.upload.take_if(|upload| upload.is_complete()) else { return Ok(false) };
        // Recorded before the blob exists, so that a collection in between keeps it.
        self.store.hold(&self.holder.0, self.digest);
        let stored = self.store.commit(upload, self.digest);
        self.waits = stored.as_ref().is_err_and(may_pass);
        stored.map(|()| true)
    }
}

/// Returns true if the same request may succeed later.
fn may_pass(error: &BlobError) -> bool {
    matches!(error, BlobError::Unreachable(_) | BlobError::Unavailable(_) | BlobError::Storage(_))
}

impl Drop for Arriving {
    fn drop(&mut self) {
        let mut all = lock(&self.store.uploads().begun);
        let place = (self.holder.clone(), self.digest);
        match (self.upload.take(), all.get_mut(&place)) {
            (upload, Some(begun)) if upload.is_some() || self.waits => {
                *begun = Begun { upload, waits: self.waits, touched: Instant::now(), ..*begun };
            }
            _ => self.store.discard(&mut all, &place),
        }
    }
}
