//! Content-addressed bytes: what a blob is called is what it hashes to.
//!
//! [`BlobStore`] verifies what is read, stores equal bytes once, and keeps collection away from blobs that are being
//! put. Where bytes lie is a [`Backend`]'s matter: a folder ([`fs::Folder`]) or memory ([`memory::Memory`]); all pass the
//! same functions in `registry/tests/conformance.rs`.
//!
//! Not its job: which blobs are needed ([`crate::retention`]), and who may write.

pub mod fs;
pub mod memory;

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, PoisonError, RwLock};

use checkpoint::{BlobError, Blobs};
use protocol::{Digest, Manifest};

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

/// Where bytes lie. Calls may come from many threads; one digest may be written by two of them at once.
pub trait Backend: Send + Sync + fmt::Debug {
    /// The bytes as they lie there, unverified.
    fn read(&self, digest: Digest) -> Result<Vec<u8>, BlobError>;
    /// Returns once the bytes would survive a loss of power. Never shows a part of them under their name.
    fn write(&self, digest: Digest, bytes: &[u8]) -> Result<(), BlobError>;
    /// The length, if it is there.
    fn size(&self, digest: Digest) -> Result<Option<u64>, BlobError>;
    /// When it was last put, in milliseconds since 1970, if it is there.
    fn put_ms(&self, digest: Digest) -> Result<Option<i64>, BlobError>;
    /// Marks a blob that is there as put just now, and makes sure that it would survive a loss of power.
    fn touch(&self, digest: Digest) -> Result<(), BlobError>;
    /// Removes it; it need not be there.
    fn remove(&self, digest: Digest) -> Result<(), BlobError>;
    /// All blobs, in no particular order.
    fn list(&self) -> Result<Vec<Entry>, BlobError>;
}

/// Content-addressed bytes over a [`Backend`]. Clones share it.
#[derive(Debug, Clone)]
pub struct BlobStore {
    backend: Arc<dyn Backend>,
    /// Held shared while a blob is put, exclusively while one is removed: so that nobody is told that a blob is stored
    /// which is going away.
    removal: Arc<RwLock<()>>,
}

impl BlobStore {
    /// Over `backend`.
    pub fn new(backend: impl Backend + 'static) -> Self {
        Self::over(Arc::new(backend))
    }

    /// Over a backend that is chosen at run time.
    pub fn over(backend: Arc<dyn Backend>) -> Self {
        Self { backend, removal: Arc::default() }
    }

    /// In memory, for tests.
    pub fn in_memory() -> Self {
        Self::new(memory::Memory::default())
    }

    /// The bytes named `digest`, verified.
    pub fn get(&self, digest: Digest) -> Result<Vec<u8>, BlobError> {
        let bytes = self.backend.read(digest)?;
        let found = Digest::of(&bytes);
        if found == digest { Ok(bytes) } else { Err(BlobError::Corrupt { expected: digest, found }) }
    }

    /// Stores bytes and returns their name, once they would survive a loss of power.
    pub fn put(&self, bytes: &[u8]) -> Result<Digest, BlobError> {
        let digest = Digest::of(bytes);
        let _no_removal = self.removal.read().unwrap_or_else(PoisonError::into_inner);
        // A blob of another length under this name was damaged from outside; these bytes mend it.
        if self.backend.size(digest)? == Some(bytes.len() as u64) {
            self.backend.touch(digest)?;
        } else {
            self.backend.write(digest, bytes)?;
        }
        Ok(digest)
    }

    /// Stores bytes that somebody else named, and refuses them if they are named wrongly.
    pub fn put_named(&self, digest: Digest, bytes: &[u8]) -> Result<(), BlobError> {
        let found = Digest::of(bytes);
        if found != digest {
            return Err(BlobError::Corrupt { expected: digest, found });
        }
        self.put(bytes).map(|_| ())
    }

    /// The length, if it is there. Does not read it.
    pub fn size(&self, digest: Digest) -> Result<Option<u64>, BlobError> {
        self.backend.size(digest)
    }

    /// Whether it is there. Does not read it.
    pub fn exists(&self, digest: Digest) -> Result<bool, BlobError> {
        Ok(self.size(digest)?.is_some())
    }

    /// A blob as a listing shows it, if it is there.
    pub(crate) fn entry(&self, digest: Digest) -> Result<Option<Entry>, BlobError> {
        let (bytes, put_ms) = (self.backend.size(digest)?, self.backend.put_ms(digest)?);
        Ok(bytes.zip(put_ms).map(|(bytes, put_ms)| Entry { digest, bytes, put_ms }))
    }

    /// All blobs by name.
    pub fn list(&self) -> Result<BTreeMap<Digest, Entry>, BlobError> {
        Ok(self.backend.list()?.into_iter().map(|entry| (entry.digest, entry)).collect())
    }

    /// Removes a blob unless it was put after `before_ms`; says whether it did.
    pub(crate) fn remove_older(&self, digest: Digest, before_ms: i64) -> Result<bool, BlobError> {
        let _alone = self.removal.write().unwrap_or_else(PoisonError::into_inner);
        match self.backend.put_ms(digest)? {
            Some(put_ms) if put_ms < before_ms => self.backend.remove(digest).map(|()| true),
            _ => Ok(false),
        }
    }

    /// The manifest named `digest`.
    pub fn manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
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
}

impl Blobs for BlobStore {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        Self::get(self, digest).map(Arc::from)
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        Self::put(self, &bytes)
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
