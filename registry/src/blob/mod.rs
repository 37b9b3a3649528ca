//! Content-addressed bytes: what a blob is called is what it hashes to.
//!
//! [`BlobStore`] verifies what is read and what is used again, stores equal bytes once, mends what was damaged, and keeps
//! collection away from blobs that are being put. Bytes come and go in parts; nothing here holds a whole blob unless it was
//! asked to. Where bytes lie is a [`Backend`]'s matter: a folder ([`fs::Folder`]), an object store ([`objects::Objects`]) or
//! memory ([`memory::Memory`]); all pass the same functions in `registry/tests/conformance.rs`.
//!
//! Not its job: which blobs are needed ([`crate::retention`]), and who may write.

pub mod disk;
pub mod fs;
mod holds;
mod known;
pub mod memory;
pub mod objects;
pub mod place;
mod reader;
mod staging;
mod uploads;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::io::Read;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use checkpoint::{Blob, BlobError, Blobs};
use protocol::digest::Hasher;
use protocol::{Digest, Manifest};

pub use self::reader::{PART_BYTES, Reader};
pub use self::uploads::{Arriving, IDLE, Protected, ResumeError};

use self::holds::Holds;
use self::known::{Finding, Known};
use self::uploads::Uploads;

/// The file that remembers what held tasks have stored.
const HELD: &str = "held";

/// The largest manifest that is read; ours are at most a few megabytes.
pub const MANIFEST_BYTES: u64 = 64 << 20;

/// A blob as a listing shows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry {
    /// Its name.
    pub digest: Digest,
    /// Its length.
    pub bytes: u64,
    /// When it was last put, in milliseconds since 1970.
    pub put_ms: i64,
}

/// What a backend says of a blob without reading it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stat {
    /// Its length.
    pub bytes: u64,
    /// When it was last put, in milliseconds since 1970.
    pub put_ms: i64,
    /// Another text after every change of the bytes, in one line.
    pub stamp: String,
}

/// Where bytes lie. Calls block, and may come from many threads; one digest may be put by two of them at once.
pub trait Backend: Send + Sync + fmt::Debug {
    /// A place for a blob of `bytes` bytes to arrive at.
    fn stage(&self, bytes: u64) -> Result<Box<dyn Staged>, BlobError>;
    /// The bytes as they lie there from byte `from` on, unverified.
    fn read(&self, digest: Digest, from: u64) -> Result<Box<dyn Read + Send>, BlobError>;
    /// What is known without reading it, if it is there.
    fn stat(&self, digest: Digest) -> Result<Option<Stat>, BlobError>;
    /// Marks a blob that is there as put just now, and makes sure that it would survive a loss of power.
    fn touch(&self, digest: Digest) -> Result<Stat, BlobError>;
    /// Removes it; it need not be there.
    fn remove(&self, digest: Digest) -> Result<(), BlobError>;
    /// Takes away its name but keeps the bytes for somebody to look at; it need not be there.
    fn put_aside(&self, digest: Digest) -> Result<(), BlobError>;
    /// All blobs, in no particular order. What else lies there is left out.
    fn list(&self) -> Result<Vec<Entry>, BlobError>;
    /// Whether there is no blob.
    fn is_empty(&self) -> Result<bool, BlobError>;
    /// What lies among the blobs and is not the store's.
    fn strays(&self) -> Result<Vec<String>, BlobError>;
    /// What was put aside.
    fn aside(&self) -> Result<Vec<String>, BlobError>;
    /// Where the marker lies, in words.
    fn marker_place(&self) -> String;
    /// The marker, a text of one line that stands beside the blobs and says whose they are.
    fn marker(&self) -> Result<Option<String>, BlobError>;
    /// Puts a marker in the place of `old`, `None` for none; `false`, and nothing is changed, if there is not `old`. Of two that
    /// try this at once one is told `false`.
    fn set_marker(&self, old: Option<&str>, marker: &str) -> Result<bool, BlobError>;

    /// As [`stage`](Self::stage), in place of what is staged under a name of 64 hexadecimal digits. A backend that can keeps what has
    /// arrived when it is dropped, and when the process ends.
    fn stage_as(&self, name: &str, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let _ = name;
        self.stage(bytes)
    }
    /// Goes on with what is staged under a name, if there is something, and gives what has arrived to `read`.
    fn staged_as(&self, name: &str, read: &mut dyn FnMut(&[u8])) -> Result<Option<Box<dyn Staged>>, BlobError> {
        let _ = (name, read);
        Ok(None)
    }
    /// Forgets what is staged under a name, if there is something.
    fn unstage(&self, name: &str) -> Result<(), BlobError> {
        let _ = name;
        Ok(())
    }
    /// Forgets what is staged under other names than these.
    fn unstage_but(&self, names: &BTreeSet<String>) -> Result<(), BlobError> {
        let _ = names;
        Ok(())
    }
}

/// A blob on its way into a [`Backend`]. It is gone if it is dropped.
pub trait Staged: Send + fmt::Debug {
    /// Appends bytes.
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError>;
    /// Gives it its name; returns once it would survive a loss of power. `false`, and nothing is changed, if a blob has that
    /// name already. Never shows a part of it under the name.
    fn commit(self: Box<Self>, digest: Digest) -> Result<bool, BlobError>;
}

/// Bytes that arrive in parts and are hashed on the way. They are gone if it is dropped.
#[derive(Debug)]
pub struct Upload {
    staged: Box<dyn Staged>,
    hasher: Hasher,
    written: u64,
    /// How many bytes there may be.
    bytes: u64,
}

impl Upload {
    /// Appends bytes, on disk or where blobs lie.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        let written = self.written + bytes.len() as u64;
        if written > self.bytes {
            return Err(BlobError::Refused(format!("more bytes came than the {} that were announced", self.bytes)));
        }
        self.staged.write(bytes)?;
        self.hasher.update(bytes);
        self.written = written;
        Ok(())
    }

    /// Bytes that have arrived.
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Whether all announced bytes have arrived.
    pub fn is_complete(&self) -> bool {
        self.written == self.bytes
    }
}

/// Content-addressed bytes over a [`Backend`]. Clones share it.
#[derive(Debug, Clone)]
pub struct BlobStore(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    backend: Arc<dyn Backend>,
    /// Held shared while a blob is touched, exclusively while one is removed: so that nobody is told that a blob is stored
    /// which is going away.
    removal: RwLock<()>,
    /// Held while a damaged blob is looked at once more and put aside.
    mending: Mutex<()>,
    known: Mutex<Known>,
    uploads: Uploads,
}

impl BlobStore {
    /// Over `backend`.
    pub fn new(backend: impl Backend + 'static) -> Self {
        Self::over(Arc::new(backend))
    }

    /// Over a backend that is chosen at run time.
    pub fn over(backend: Arc<dyn Backend>) -> Self {
        Self::with(backend, Known::default(), Holds::default())
    }

    /// Over a backend; `verified` is the file that remembers what was hashed, and beside it lies another, `held`, that remembers what
    /// held tasks have stored. Only for the holder of the store's lock.
    pub fn remembering(backend: Arc<dyn Backend>, verified: &Path) -> Self {
        Self::with(backend, Known::read(verified), Holds::keep(&verified.with_file_name(HELD)))
    }

    /// Over a backend, beside the holder of the store's lock, who remembers at `verified`.
    pub fn beside(backend: Arc<dyn Backend>, verified: &Path) -> Self {
        Self::with(backend, Known::default(), Holds::of_others(&verified.with_file_name(HELD)))
    }

    fn with(backend: Arc<dyn Backend>, known: Known, held: Holds) -> Self {
        Self(Arc::new(Shared {
            backend,
            removal: RwLock::default(),
            mending: Mutex::default(),
            known: Mutex::new(known),
            uploads: Uploads::new(held),
        }))
    }

    /// The blobs of the store in a folder. Only for the holder of the store's lock.
    pub fn open_folder(dir: &Path) -> std::io::Result<Self> {
        let folder = fs::Folder::open(dir)?;
        Ok(Self::remembering(Arc::new(folder), &dir.join("blobs/verified")))
    }

    /// The blobs of the store in a folder, for reading only; another process may hold its lock.
    pub fn folder_to_read(dir: &Path) -> Self {
        Self::beside(Arc::new(fs::Folder::to_read(dir)), &dir.join("blobs/verified"))
    }

    /// In memory, for tests.
    pub fn in_memory() -> Self {
        Self::new(memory::Memory::default())
    }

    fn backend(&self) -> &dyn Backend {
        &*self.0.backend
    }

    /// Where the bytes lie.
    pub(crate) fn place(&self) -> Arc<dyn Backend> {
        Arc::clone(&self.0.backend)
    }

    fn uploads(&self) -> &Uploads {
        &self.0.uploads
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.0.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes note of what reading a blob has shown.
    fn found(&self, digest: Digest, stat: &Stat, finding: Finding) {
        if let Finding::Damaged(found) = finding {
            tracing::error!("blob {digest} is damaged: its bytes hash to {found}");
        }
        self.known().set(digest, stat.stamp.clone(), finding);
    }

    fn must_stat(&self, digest: Digest) -> Result<Stat, BlobError> {
        self.backend().stat(digest)?.ok_or(BlobError::NotFound(digest))
    }

    /// Refuses a blob that was found damaged and was not written to since.
    fn not_damaged(&self, digest: Digest) -> Result<Stat, BlobError> {
        let stat = self.must_stat(digest)?;
        match self.known().finding(digest, &stat.stamp) {
            Some(Finding::Damaged(found)) => Err(BlobError::Corrupt { expected: digest, found }),
            Some(Finding::Whole) | None => Ok(stat),
        }
    }

    /// The bytes named `digest`, verified, in memory.
    pub fn get(&self, digest: Digest) -> Result<Vec<u8>, BlobError> {
        let mut reader = self.read(digest)?;
        let mut bytes = Vec::with_capacity(usize::try_from(reader.bytes()).unwrap_or_default());
        while let Some(part) = reader.next_part()? {
            bytes.extend_from_slice(&part);
        }
        Ok(bytes)
    }

    /// The bytes named `digest` part by part, verified by the time the last part is there.
    pub fn read(&self, digest: Digest) -> Result<Reader, BlobError> {
        let stat = self.not_damaged(digest)?;
        Reader::new(self.clone(), digest, stat)
    }

    /// The bytes named `digest` from byte `from` on, once all of it is known to be whole.
    pub fn read_from(&self, digest: Digest, from: u64) -> Result<Reader, BlobError> {
        let stat = self.verify(digest)?;
        if from > stat.bytes {
            return Err(checkpoint::past_the_end(from, 0, stat.bytes));
        }
        Reader::verified(self.clone(), digest, stat, from)
    }

    /// Makes sure that a blob is there and whole. Hashes it, unless that was done since it was last written to.
    pub fn verify(&self, digest: Digest) -> Result<Stat, BlobError> {
        let stat = self.not_damaged(digest)?;
        if self.known().finding(digest, &stat.stamp) != Some(Finding::Whole) {
            let mut reader = Reader::new(self.clone(), digest, stat.clone())?;
            while reader.next_part()?.is_some() {}
        }
        Ok(stat)
    }

    /// Hashes a blob whatever is known of it: a disk may lose bytes without a write.
    pub fn check(&self, digest: Digest) -> Result<(), BlobError> {
        let mut reader = Reader::new(self.clone(), digest, self.must_stat(digest)?)?;
        while reader.next_part()?.is_some() {}
        Ok(())
    }

    /// Stores bytes and returns their name, once they would survive a loss of power.
    pub fn put(&self, bytes: &[u8]) -> Result<Digest, BlobError> {
        self.put_pieces(&[bytes])
    }

    /// Stores the bytes that `pieces` are one after the other.
    pub fn put_pieces(&self, pieces: &[&[u8]]) -> Result<Digest, BlobError> {
        let mut hasher = Hasher::default();
        pieces.iter().for_each(|piece| hasher.update(piece));
        let digest = hasher.finish();
        if !self.reuse(digest)? {
            let mut upload = self.begin(pieces.iter().map(|piece| piece.len() as u64).sum())?;
            for piece in pieces {
                upload.write(piece)?;
            }
            self.commit(upload, digest)?;
        }
        Ok(digest)
    }

    /// Stores bytes that somebody else named, and refuses them if they are named wrongly.
    pub fn put_named(&self, digest: Digest, bytes: &[u8]) -> Result<(), BlobError> {
        let mut upload = self.begin(bytes.len() as u64)?;
        upload.write(bytes)?;
        self.commit(upload, digest)
    }

    /// Begins to store a blob of `bytes` bytes.
    pub fn begin(&self, bytes: u64) -> Result<Upload, BlobError> {
        Ok(Upload { staged: self.backend().stage(bytes)?, hasher: Hasher::default(), written: 0, bytes })
    }

    /// Gives an upload the name `digest`, and refuses it if that is not what its bytes hash to. Returns once it would survive a
    /// loss of power.
    pub fn commit(&self, upload: Upload, digest: Digest) -> Result<(), BlobError> {
        let found = upload.hasher.finish();
        if found != digest {
            return Err(BlobError::Corrupt { expected: digest, found });
        }
        if self.reuse(digest)? {
            return Ok(());
        }
        // A collection that runs now removes only what was old when it began.
        if upload.staged.commit(digest)? {
            let stat = self.must_stat(digest)?;
            self.known().set(digest, stat.stamp, Finding::Whole);
            return Ok(());
        }
        // Another thread was faster with the same bytes.
        if self.reuse(digest)? {
            return Ok(());
        }
        Err(BlobError::Unavailable(format!("blob {digest} went away while it was stored; store it again")))
    }

    /// Uses a blob again that is there and whole, as if it had been put just now. What is damaged is put aside, to be put anew.
    pub fn reuse(&self, digest: Digest) -> Result<bool, BlobError> {
        loop {
            let stat = match self.verify(digest) {
                Ok(stat) => stat,
                Err(BlobError::NotFound(_)) => return Ok(false),
                Err(BlobError::Corrupt { .. }) => {
                    let _mending = self.0.mending.lock().unwrap_or_else(PoisonError::into_inner);
                    // Somebody else may have mended it.
                    if let Err(BlobError::Corrupt { .. }) = self.verify(digest) {
                        self.backend().put_aside(digest)?;
                        self.known().forget(digest);
                    }
                    continue;
                }
                Err(e) => return Err(e),
            };
            // Not held while gigabytes are hashed: a collection would wait, and everybody who waits for it.
            let _no_removal = self.0.removal.read().unwrap_or_else(PoisonError::into_inner);
            if self.backend().stat(digest)?.is_some_and(|now| now.stamp == stat.stamp) {
                let touched = self.backend().touch(digest)?;
                self.known().set(digest, touched.stamp, Finding::Whole);
                return Ok(true);
            }
        }
    }

    /// The length, if it is there. Does not read it.
    pub fn size(&self, digest: Digest) -> Result<Option<u64>, BlobError> {
        Ok(self.backend().stat(digest)?.map(|stat| stat.bytes))
    }

    /// Whether it is there. Does not read it.
    pub fn exists(&self, digest: Digest) -> Result<bool, BlobError> {
        Ok(self.size(digest)?.is_some())
    }

    /// A blob as a listing shows it, if it is there.
    pub(crate) fn entry(&self, digest: Digest) -> Result<Option<Entry>, BlobError> {
        let stat = self.backend().stat(digest)?;
        Ok(stat.map(|stat| Entry { digest, bytes: stat.bytes, put_ms: stat.put_ms }))
    }

    /// All blobs by name.
    pub fn list(&self) -> Result<BTreeMap<Digest, Entry>, BlobError> {
        Ok(self.backend().list()?.into_iter().map(|entry| (entry.digest, entry)).collect())
    }

    /// What lies among the blobs and is not the store's. It is left alone.
    pub fn strays(&self) -> Result<Vec<String>, BlobError> {
        self.backend().strays()
    }

    /// Damaged blobs that were put aside.
    pub fn aside(&self) -> Result<Vec<String>, BlobError> {
        self.backend().aside()
    }

    /// Removes a blob unless it was put after `before_ms` or a held task has put it; says whether it did. One that is known
    /// to be damaged is put aside instead.
    pub(crate) fn remove_older(&self, digest: Digest, before_ms: i64) -> Result<bool, BlobError> {
        let _alone = self.0.removal.write().unwrap_or_else(PoisonError::into_inner);
        if self.held().contains(&digest) {
            return Ok(false);
        }
        match self.backend().stat(digest)? {
            Some(stat) if stat.put_ms < before_ms => {
                let damaged = self.known().is_damaged(digest);
                if damaged {
                    self.backend().put_aside(digest)?
                } else {
                    self.backend().remove(digest)?
                }
                self.known().forget(digest);
                Ok(true)
            }
            _ => Ok(false),
        }
    }

    /// The manifest named `digest`.
    pub fn manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let stat = self.must_stat(digest).map_err(ManifestError::Blob)?;
        if stat.bytes > MANIFEST_BYTES {
            let cause = format!("it has {} bytes, and a manifest at most {MANIFEST_BYTES}", stat.bytes);
            return Err(ManifestError::NotAManifest { digest, cause });
        }
        let bytes = self.get(digest).map_err(ManifestError::Blob)?;
        let manifest: Manifest =
            serde_json::from_slice(&bytes).map_err(|e| ManifestError::NotAManifest { digest, cause: e.to_string() })?;
        if manifest.format != Manifest::FORMAT {
            return Err(ManifestError::Format { digest, found: manifest.format });
        }
        Ok(manifest)
    }

    /// The manifest named `digest`, once every blob that it lists is known to be there with the right length.
    pub fn complete_manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let manifest = self.manifest(digest)?;
        for (name, file) in &manifest.files {
            match self.size(file.digest).map_err(ManifestError::Blob)? {
                Some(bytes) if bytes == file.bytes => {}
                found => {
                    return Err(ManifestError::Incomplete {
                        digest,
                        file: name.clone(),
                        blob: file.digest,
                        expected: file.bytes,
                        found: found.map_or_else(|| "not in the store".into(), |bytes| format!("{bytes} bytes long")),
                    });
                }
            }
        }
        Ok(manifest)
    }

    /// The manifest named `digest`, once every blob that it lists is known to be whole. Takes as long as hashing what was
    /// not hashed since it was last written to.
    pub fn whole_manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let manifest = self.complete_manifest(digest)?;
        for file in manifest.files.values() {
            self.verify(file.digest).map_err(ManifestError::Blob)?;
        }
        Ok(manifest)
    }

    /// What is wrong with an artifact, if anything is: a part of it is missing or damaged. An error says nothing about it.
    pub fn flaw(&self, artifact: Digest) -> Result<Option<ManifestError>, BlobError> {
        match self.whole_manifest(artifact) {
            Ok(_) => Ok(None),
            Err(ManifestError::Blob(
                e @ (BlobError::Unavailable(_) | BlobError::Storage(_) | BlobError::Refused(_)),
            )) => Err(e),
            Err(flaw) => Ok(Some(flaw)),
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

    fn put_pieces(&self, pieces: &[&[u8]]) -> Result<Digest, BlobError> {
        Self::put_pieces(self, pieces)
    }

    fn open(&self, digest: Digest) -> Result<Box<dyn Blob>, BlobError> {
        let bytes = self.verify(digest)?.bytes;
        Ok(Box::new(Opened { store: self.clone(), digest, bytes }))
    }
}

/// A blob that was found whole.
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
        let failed = |e| BlobError::Unavailable(format!("failed to read blob {}: {e}", self.digest));
        self.store.backend().read(self.digest, offset)?.read_exact(out).map_err(failed)
    }
}

/// Why an artifact cannot be taken for whole.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The manifest itself, or a blob of it, could not be read.
    #[error(transparent)]
    Blob(BlobError),
    /// Another blob than a manifest.
    #[error("blob {digest} is not a manifest: {cause}")]
    NotAManifest {
        /// The blob.
        digest: Digest,
        /// What the reader said.
        cause: String,
    },
    /// Written by a newer build.
    #[error("manifest {digest} has format {found}, this build reads {expected}; use a newer build", expected = Manifest::FORMAT)]
    Format {
        /// The manifest.
        digest: Digest,
        /// Its version.
        found: u32,
    },
    /// A file is missing or cut.
    #[error("manifest {digest} lists `{file}` as blob {blob} of {expected} bytes, which is {found}")]
    Incomplete {
        /// The manifest.
        digest: Digest,
        /// The file's name in it.
        file: String,
        /// The blob.
        blob: Digest,
        /// Bytes by the manifest.
        expected: u64,
        /// What is there.
        found: String,
    },
}
