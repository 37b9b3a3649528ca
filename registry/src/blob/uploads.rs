//! Uploads that arrive in several requests, and what tasks that are still held have uploaded.
//!
//! A cut upload keeps what has arrived: its holder asks how much that is and goes on from there, of another process that opens
//! the store as well. What has arrived belongs to one worker's hold on one task, is in nobody else's way, and goes when the hold
//! ends or when nothing came for [`IDLE`]. A stored blob is noted for its task until the task is let go, so that collection leaves it
//! alone however long the row that will name it takes ([`Holds`]).

use std::collections::{BTreeSet, HashMap};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use checkpoint::BlobError;
use protocol::digest::Hasher;
use protocol::message::Grant;
use protocol::{Digest, TaskId};

use super::BlobStore;
use super::begun::{Begun, Holder, Upload};

/// How long an upload may rest.
pub const IDLE: Duration = Duration::from_secs(600);
/// How many uploads one holder may have begun.
const PER_HOLDER: usize = 8;

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

/// What an upload is called where blobs arrive: the same in every process, and nobody else's.
fn name((holder, digest): &(Holder, Digest)) -> String {
    let (task, worker, incarnation) = holder;
    Digest::of(format!("{task}\n{worker}\n{incarnation}\n{digest}").as_bytes()).hex()
}

fn holder(grant: &Grant) -> Holder {
    (grant.task.clone(), grant.worker.clone(), grant.incarnation)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl BlobStore {
    /// How many bytes of a blob have arrived in the name of a grant.
    pub fn staged(&self, grant: &Grant, digest: Digest) -> Result<u64, BlobError> {
        let place = (holder(grant), digest);
        self.recall(&place)?;
        let begun = lock(&self.uploads().begun);
        let upload = begun.get(&place).and_then(|begun| begun.upload.as_ref());
        Ok(upload.map_or(0, Upload::written))
    }

    /// Takes up an upload of `bytes` bytes at byte `offset`; at 0 it begins, anew if need be. What has arrived when it is
    /// dropped waits for the holder's next request.
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
        match self.backend().stage_as(&name(&place), bytes) {
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

    /// Takes up what has arrived of an upload and waits, or what has arrived for an earlier process if this one knows nothing of it.
    fn recall(&self, place: &(Holder, Digest)) -> Result<(), BlobError> {
        if lock(&self.uploads().begun).get(place).is_some_and(|begun| !begun.waits) {
            return Ok(());
        }
        // Hashed without the lock, which every other upload takes.
        let (mut hasher, mut written) = (Hasher::default(), 0);
        let mut read = |part: &[u8]| {
            hasher.update(part);
            written += part.len() as u64;
        };
        let staged = self.backend().staged_as(&name(place), &mut read)?;
        let mut all = lock(&self.uploads().begun);
        // Another request may have been as fast, and be writing to it.
        if all.get(place).is_none_or(|begun| begun.waits) {
            all.remove(place);
            if let Some(staged) = staged {
                let upload = Some(Upload { staged, hasher, written, bytes: written, content: None });
                all.insert(place.clone(), Begun { upload, waits: false, bytes: None, touched: Instant::now() });
            }
        }
        Ok(())
    }

    /// Forgets an upload, and what has arrived of it.
    fn discard(&self, all: &mut HashMap<(Holder, Digest), Begun>, place: &(Holder, Digest)) {
        all.remove(place);
        if let Err(error) = self.backend().unstage(&name(place)) {
            tracing::warn!(%error, "a part of a blob stays where blobs arrive");
        }
    }

    /// Notes that a held task has stored a blob, which is kept until [`Self::let_go`].
    pub fn hold(&self, task: &TaskId, digest: Digest) {
        lock(&self.uploads().held).hold(task, digest);
    }

    /// Keeps a blob, which need not be there yet, for as long as what is returned lives: until the row that names it is stored.
    #[must_use = "the blob is kept only as long as this lives"]
    pub fn protect(&self, digest: Digest) -> Protected {
        *lock(&self.uploads().protected).entry(digest).or_default() += 1;
        Protected { store: self.clone(), digest }
    }

    /// What held tasks have stored, and what is protected: roots of a collection.
    pub fn held(&self) -> BTreeSet<Digest> {
        let mut held = lock(&self.uploads().held).all();
        held.extend(lock(&self.uploads().protected).keys());
        held
    }

    /// Forgets what belongs to tasks that are not held any more, and uploads at which nothing came for `idle`, usually [`IDLE`].
    pub fn let_go(&self, idle: Duration, is_held: impl Fn(&TaskId) -> bool) {
        lock(&self.uploads().held).let_go(&is_held);
        let mut all = lock(&self.uploads().begun);
        // One that a request writes to right now ends with that request.
        let rests = |begun: &Begun| begun.upload.is_some() || begun.waits;
        let over = |begun: &Begun, task| rests(begun) && (begun.touched.elapsed() >= idle || !is_held(task));
        let gone = all.iter().filter(|(((task, _, _), _), begun)| over(begun, task)).map(|(place, _)| place.clone());
        for place in gone.collect::<Vec<_>>() {
            self.discard(&mut all, &place);
        }
        if self.uploads().since.elapsed() < idle {
            return;
        }
        // Nobody has asked for what else an earlier process has left.
        let known: BTreeSet<String> = all.keys().map(name).collect();
        if let Err(error) = self.backend().unstage_but(&known) {
            tracing::warn!(%error, "parts of blobs stay where blobs arrive");
        }
    }
}

/// Keeps a blob from collection.
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
    /// `None` once it has ended.
    upload: Option<Upload>,
    /// It has ended, and its bytes are where they arrived.
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

    /// Bytes that have arrived.
    pub fn written(&self) -> u64 {
        self.upload.as_ref().map_or(0, Upload::written)
    }

    /// Stores the blob if all of it has arrived, and notes it for its task; says whether it did. If it cannot be stored now, what has
    /// arrived waits for the holder's next request.
    pub fn finish(mut self) -> Result<bool, BlobError> {
        let Some(upload) = self.upload.take_if(|upload| upload.is_complete()) else { return Ok(false) };
        // Before it is there: a collection in between must not take it.
        self.store.hold(&self.holder.0, self.digest);
        let stored = self.store.commit(upload, self.digest);
        let may_be_later =
            |e: &BlobError| matches!(e, BlobError::Unreachable(_) | BlobError::Unavailable(_) | BlobError::Storage(_));
        self.waits = stored.as_ref().is_err_and(may_be_later);
        stored.map(|()| true)
    }
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
