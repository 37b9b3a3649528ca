//! The blob store: verifies what is read and reused, stores equal bytes once, and repairs damaged blobs.

use std::fmt;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, RwLock};

use checkpoint::{Blob, BlobError, Blobs, digest_of, read_parts};
use protocol::Digest;

use super::backend::{Backend, Entry, Problem, Stat};
use super::begun::{Upload, Uploads};
use super::fs::Folder;
use super::known::{Finding, Findings, Known};
use super::memory::Memory;
use super::reader::{Reader, read_error};
use super::seen::Seen;

/// Content-addressed bytes over a [`Backend`]. Clones share it.
#[derive(Debug, Clone)]
pub struct BlobStore(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    backend: Arc<dyn Backend>,
    /// Read-locked while a blob is touched, write-locked while one is removed, so that a blob is not reported as stored
    /// while it is being removed. One lock for all digests with the same first byte.
    removals: [RwLock<()>; 256],
    /// Held while a damaged blob is verified again and put aside.
    mending: Mutex<()>,
    known: Arc<Findings>,
    seen: Seen,
    uploads: Uploads,
    permit: OnceLock<Permit>,
}

/// Check whether a blob may be removed now.
struct Permit(Box<dyn Fn() -> Result<(), BlobError> + Send + Sync>);

impl fmt::Debug for Permit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Permit")
    }
}

impl BlobStore {
    /// Makes a store over `backend`.
    pub fn new(backend: impl Backend + 'static) -> Self {
        Self::over(Arc::new(backend))
    }

    /// Makes a store over a backend that is chosen at run time.
    pub fn over(backend: Arc<dyn Backend>) -> Self {
        Self::with(backend, Known::default())
    }

    /// Makes a store over a backend with a file that records verified blobs. Only for the holder of the store's lock.
    pub fn remembering(backend: Arc<dyn Backend>, verified: &Path) -> Self {
        Self::with(backend, Known::read(verified))
    }

    fn with(backend: Arc<dyn Backend>, known: Known) -> Self {
        Self(Arc::new(Shared {
            backend,
            removals: std::array::from_fn(|_| RwLock::default()),
            mending: Mutex::default(),
            known: Arc::new(Findings::new(known)),
            seen: Seen::default(),
            permit: OnceLock::new(),
            uploads: Uploads::new(),
        }))
    }

    /// Opens the blobs of the store in a folder. Only for the holder of the store's lock.
    pub fn open_folder(dir: &Path) -> std::io::Result<Self> {
        let folder = Folder::open(dir)?;
        Ok(Self::remembering(Arc::new(folder), &dir.join("blobs/verified")))
    }

    /// Makes a store in memory for tests.
    pub fn in_memory() -> Self {
        Self::new(Memory::default())
    }

    pub(super) fn backend(&self) -> &dyn Backend {
        &*self.0.backend
    }

    /// Returns the backend.
    pub fn place(&self) -> Arc<dyn Backend> {
        Arc::clone(&self.0.backend)
    }

    pub(super) fn uploads(&self) -> &Uploads {
        &self.0.uploads
    }

    /// Sets a check that must pass before each removal of a blob.
    pub(crate) fn permit_removals_by(&self, permit: impl Fn() -> Result<(), BlobError> + Send + Sync + 'static) {
        // Set once, when the store is opened.
        let _ = self.0.permit.set(Permit(Box::new(permit)));
    }

    fn may_remove(&self) -> Result<(), BlobError> {
        self.0.permit.get().map_or(Ok(()), |permit| (permit.0)())
    }

    pub(super) fn seen(&self) -> &Seen {
        &self.0.seen
    }

    pub(super) fn known(&self) -> MutexGuard<'_, Known> {
        self.0.known.lock()
    }

    pub(super) fn removal(&self, digest: Digest) -> &RwLock<()> {
        let byte = u8::from_str_radix(&digest.hex()[..2], 16).unwrap_or_default();
        &self.0.removals[usize::from(byte)]
    }

    /// Returns the current problem of the backend, as seen in the last calls.
    pub fn problem(&self) -> Option<Problem> {
        self.backend().problem()
    }

    pub(super) fn must_stat(&self, digest: Digest) -> Result<Stat, BlobError> {
        let stat = self.backend().stat(digest)?;
        if stat.is_none() {
            self.seen().forget(digest);
        }
        stat.ok_or(BlobError::NotFound(digest))
    }

    /// Refuses a blob that was found damaged and not written since.
    pub(super) fn not_damaged(&self, digest: Digest) -> Result<Stat, BlobError> {
        let stat = self.must_stat(digest)?;
        self.refuse_damaged(digest, &stat)?;
        Ok(stat)
    }

    fn refuse_damaged(&self, digest: Digest, stat: &Stat) -> Result<(), BlobError> {
        match self.known().finding(digest, &stat.stamp) {
            Some(Finding::Damaged(found)) => {
                self.seen().forget(digest);
                Err(BlobError::Corrupt { expected: digest, found })
            }
            Some(Finding::Whole) | None => Ok(()),
        }
    }

    /// Returns the verified bytes of a blob in memory.
    pub fn get(&self, digest: Digest) -> Result<Vec<u8>, BlobError> {
        self.read(digest)?.all()
    }

    /// Opens a blob for reading in parts; it is verified before its last part is returned.
    pub fn read(&self, digest: Digest) -> Result<Reader, BlobError> {
        let stat = self.must_stat(digest)?;
        self.reader(digest, stat)
    }

    /// Opens a blob with this metadata for reading.
    pub(super) fn reader(&self, digest: Digest, stat: Stat) -> Result<Reader, BlobError> {
        self.refuse_damaged(digest, &stat)?;
        Reader::new(self.backend(), &self.0.known, digest, stat)
    }

    /// Verifies a blob and opens it for reading from byte `from` on.
    pub fn read_from(&self, digest: Digest, from: u64) -> Result<Reader, BlobError> {
        let stat = self.verify(digest)?;
        if from > stat.bytes {
            return Err(checkpoint::past_the_end(from, 0, stat.bytes));
        }
        Reader::verified(self.backend(), &self.0.known, digest, stat, from)
    }

    /// Checks that a blob exists and is whole. Hashes it unless that was done since its last write.
    pub fn verify(&self, digest: Digest) -> Result<Stat, BlobError> {
        let stat = self.not_damaged(digest)?;
        if self.known().finding(digest, &stat.stamp) != Some(Finding::Whole) {
            let mut reader = Reader::new(self.backend(), &self.0.known, digest, stat.clone())?;
            while reader.next_part()?.is_some() {}
        }
        Ok(stat)
    }

    /// Hashes a blob even if it was verified before: a disk may lose bytes without a write.
    pub fn check(&self, digest: Digest) -> Result<(), BlobError> {
        let mut reader = Reader::new(self.backend(), &self.0.known, digest, self.must_stat(digest)?)?;
        while reader.next_part()?.is_some() {}
        Ok(())
    }

    /// Stores bytes and returns their digest when they are durable.
    pub fn put(&self, bytes: &[u8]) -> Result<Digest, BlobError> {
        self.put_copy(&bytes)
    }

    /// Stores a copy of `source`, which is read in parts, and returns its digest when it is durable.
    pub fn put_copy(&self, source: &dyn Blob) -> Result<Digest, BlobError> {
        let digest = digest_of(source)?;
        if !self.reuse(digest)? {
            let mut upload = self.begin(source.bytes())?;
            read_parts(source, |part| upload.write(part))?;
            self.commit(upload, digest)?;
        }
        Ok(digest)
    }

    /// Starts to store a blob of `bytes` bytes.
    pub fn begin(&self, bytes: u64) -> Result<Upload, BlobError> {
        Ok(Upload::new(self.backend().stage(bytes)?, bytes))
    }

    /// Names an upload `digest` and returns when it is durable. Refuses it if its bytes do not hash to `digest`.
    pub fn commit(&self, upload: Upload, digest: Digest) -> Result<(), BlobError> {
        let found = upload.hasher.finish();
        if found != digest {
            return Err(BlobError::Corrupt { expected: digest, found });
        }
        let bytes = upload.written;
        let content = upload.content;
        if self.reuse(digest)? {
            self.seen().complete(digest, content);
            return Ok(());
        }
        // A running collection removes only blobs that were old when it started.
        if upload.staged.commit(digest)? {
            let _no_removal = self.removal(digest).read().unwrap_or_else(PoisonError::into_inner);
            let stat = self.must_stat(digest)?;
            self.known().set(digest, stat.stamp, Finding::Whole);
            self.seen().note(digest, bytes);
            self.seen().complete(digest, content);
            return Ok(());
        }
        // Another thread has stored the same bytes first.
        if self.reuse(digest)? {
            return Ok(());
        }
        Err(BlobError::Unavailable(format!("blob {digest} was removed while it was being stored; store it again")))
    }

    /// Reuses a blob that exists and is whole, as if it had been put now. Puts a damaged one aside, so that it can be
    /// stored again.
    pub fn reuse(&self, digest: Digest) -> Result<bool, BlobError> {
        loop {
            let stat = match self.verify(digest) {
                Ok(stat) => stat,
                Err(BlobError::NotFound(_)) => return Ok(false),
                Err(BlobError::Corrupt { .. }) => {
                    let _mending = self.0.mending.lock().unwrap_or_else(PoisonError::into_inner);
                    // Another thread may have repaired it.
                    if let Err(BlobError::Corrupt { .. }) = self.verify(digest) {
                        self.may_remove()?;
                        self.backend().put_aside(digest)?;
                        self.known().forget(digest);
                        self.seen().forget(digest);
                    }
                    continue;
                }
                Err(e) => return Err(e),
            };
            // Not held while gigabytes are hashed, because a collection and its waiters would block.
            let _no_removal = self.removal(digest).read().unwrap_or_else(PoisonError::into_inner);
            if self.backend().stat(digest)?.is_some_and(|now| now.stamp == stat.stamp) {
                let touched = self.backend().touch(digest)?;
                self.known().set(digest, touched.stamp, Finding::Whole);
                self.seen().note(digest, touched.bytes);
                return Ok(true);
            }
        }
    }

    /// Returns the length of a blob, or `None` if it does not exist. Does not read the blob.
    pub fn size(&self, digest: Digest) -> Result<Option<u64>, BlobError> {
        Ok(self.backend().stat(digest)?.map(|stat| stat.bytes))
    }

    /// Returns true if the blob exists. Does not read the blob.
    pub fn exists(&self, digest: Digest) -> Result<bool, BlobError> {
        Ok(self.size(digest)?.is_some())
    }

    /// Returns the length of a blob that this process has just stored or reused. Sends no request to the backend.
    pub(crate) fn just_stored(&self, digest: Digest) -> Option<u64> {
        self.seen().bytes(digest)
    }

    /// Lists all blobs, sorted by digest.
    pub fn list(&self) -> Result<Vec<Entry>, BlobError> {
        let mut entries = self.backend().list()?;
        entries.sort_unstable_by_key(|entry| entry.digest);
        Ok(entries)
    }

    /// Lists the files among the blobs that are not the store's. They are never touched.
    pub fn strays(&self) -> Result<Vec<String>, BlobError> {
        self.backend().strays()
    }

    /// Describes uploads in parts that have not ended, without this process's own.
    pub fn unfinished(&self) -> Result<Vec<String>, BlobError> {
        self.backend().unfinished()
    }

    /// Ends the uploads that [`Self::unfinished`] lists and returns their number.
    pub(crate) fn give_up_unfinished(&self) -> Result<u64, BlobError> {
        self.may_remove()?;
        self.backend().give_up_unfinished()
    }

    /// Lists the damaged blobs that were put aside.
    pub fn aside(&self) -> Result<Vec<String>, BlobError> {
        self.backend().aside()
    }

    /// Removes a blob and returns it, unless its put time is `is_young` or a held task has stored it. Puts a damaged
    /// one aside instead of deleting it.
    pub(crate) fn remove_unless(
        &self,
        digest: Digest,
        is_young: impl FnOnce(i64) -> bool,
    ) -> Result<Option<Entry>, BlobError> {
        let _alone = self.removal(digest).write().unwrap_or_else(PoisonError::into_inner);
        if self.held().contains(&digest) {
            return Ok(None);
        }
        self.seen().forget(digest);
        match self.backend().stat(digest)? {
            Some(stat) if !is_young(stat.put_ms) => {
                self.may_remove()?;
                let damaged = self.known().is_damaged(digest);
                if damaged {
                    self.backend().put_aside(digest)?
                } else {
                    self.backend().remove(digest)?
                }
                self.known().forget(digest);
                Ok(Some(Entry { digest, bytes: stat.bytes, put_ms: stat.put_ms }))
            }
            _ => Ok(None),
        }
    }
}

impl Blobs for BlobStore {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        Self::get(self, digest).map(Arc::from)
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        Self::put(self, &bytes)
    }

    fn put_copy(&self, source: &dyn Blob) -> Result<Digest, BlobError> {
        Self::put_copy(self, source)
    }

    fn open(&self, digest: Digest) -> Result<Box<dyn Blob>, BlobError> {
        let bytes = self.verify(digest)?.bytes;
        Ok(Box::new(Opened { store: self.clone(), digest, bytes }))
    }
}

/// A verified blob.
#[derive(Debug)]
struct Opened {
    store: BlobStore,
    digest: Digest,
    bytes: u64,
}

impl Blob for Opened {
    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        if offset.checked_add(out.len() as u64).is_none_or(|end| end > self.bytes) {
            return Err(checkpoint::past_the_end(offset, out.len(), self.bytes));
        }
        self.store.backend().read(self.digest, offset)?.read_exact(out).map_err(|e| read_error(self.digest, &e))
    }
}
