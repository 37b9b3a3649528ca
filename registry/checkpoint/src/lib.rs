//! The artifact container over bytes: manifests, aligned tensors, limits.
//!
//! An artifact is a [`Manifest`](protocol::Manifest) that lists blobs; tensors are safetensors, everything else is
//! JSON. Loading an artifact executes no code. Other crates decide where blobs are stored and which writes are allowed.

pub mod file;
pub mod model;
pub mod published;
pub mod torch;

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use protocol::digest::Hasher;
use protocol::{Digest, FileEntry};

/// Error of reading or writing a blob.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// The blob does not exist.
    #[error("blob {0} is not in the store")]
    NotFound(Digest),
    /// The bytes do not hash to the blob's digest.
    #[error("blob {expected} is corrupt: its bytes hash to {found}")]
    Corrupt {
        /// Digest of the blob.
        expected: Digest,
        /// Digest of the bytes.
        found: Digest,
    },
    /// The store refuses to return bytes that it found damaged; the message names the blob.
    #[error("{0}")]
    Damaged(String),
    /// The grant has ended.
    #[error("write refused: {0}")]
    Refused(String),
    /// The store refuses such bytes from any caller.
    #[error("{0}")]
    Unfit(String),
    /// The disk is full or not writable.
    #[error("{0}")]
    Storage(String),
    /// The blobs' backend does not answer; the same call may succeed later.
    #[error("{0}")]
    Unreachable(String),
    /// Any other error, after retries.
    #[error("{0}")]
    Unavailable(String),
}

/// Content-addressed bytes. Reads are verified. The module [`file`] reads and writes the files of artifacts.
///
/// Large blobs should use [`put_copy`](Self::put_copy) and [`open`](Self::open), which hold no second copy.
pub trait Blobs: Send + Sync + fmt::Debug {
    /// Returns the bytes named `digest` in memory.
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError>;

    /// Stores bytes and returns their digest. Equal bytes are stored once.
    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError>;

    /// Stores a copy of `source`, which is read in parts.
    fn put_copy(&self, source: &dyn Blob) -> Result<Digest, BlobError> {
        let mut bytes = vec![0; usize::try_from(source.bytes()).unwrap_or(usize::MAX)];
        source.read_at(0, &mut bytes)?;
        self.put(bytes)
    }

    /// Stores the concatenation of `pieces`.
    fn put_pieces(&self, pieces: &[&[u8]]) -> Result<Digest, BlobError> {
        self.put_copy(&Joined::new(pieces.to_vec()))
    }

    /// Verifies and opens the blob named `digest` for reading in parts.
    fn open(&self, digest: Digest) -> Result<Box<dyn Blob>, BlobError> {
        Ok(Box::new(self.get(digest)?))
    }

    /// Verifies and maps the blob named `digest`. The bytes need no memory of this process if a local file has them.
    /// For blobs that are read repeatedly, such as a dataset.
    fn map(&self, digest: Digest) -> Result<Bytes, BlobError> {
        Ok(Bytes::from_owner(self.get(digest)?))
    }

    /// Maps a file of several blobs. `None` if this store cannot; [`file::map`] then reads it into memory.
    fn map_chunks(&self, file: &FileEntry) -> Option<Result<Bytes, BlobError>> {
        let _ = file;
        None
    }
}

/// Returns the path of a blob in the folder of a store that keeps its blobs beside its database.
pub fn blob_path(store: &Path, digest: Digest) -> PathBuf {
    let hex = digest.hex();
    store.join(BLOBS).join(&hex[..2]).join(&hex[2..])
}

/// The folder of all blobs, relative to their store's.
pub const BLOBS: &str = "blobs/sha256";

/// A verified blob.
pub trait Blob: Send + Sync + fmt::Debug {
    /// Returns the blob's length.
    fn bytes(&self) -> u64;

    /// Fills `out` with the bytes from `offset` on; a blob that is too short is an error.
    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError>;
}

impl Blob for Arc<[u8]> {
    fn bytes(&self) -> u64 {
        self.len() as u64
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        (&**self).read_at(offset, out)
    }
}

impl Blob for &[u8] {
    fn bytes(&self) -> u64 {
        self.len() as u64
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        let start = usize::try_from(offset).ok();
        let range = start.and_then(|start| Some(start..start.checked_add(out.len())?));
        match range.and_then(|range| self.get(range)) {
            Some(bytes) => {
                out.copy_from_slice(bytes);
                Ok(())
            }
            None => Err(past_the_end(offset, out.len(), self.len() as u64)),
        }
    }
}

impl Blob for Box<dyn Blob> {
    fn bytes(&self) -> u64 {
        (**self).bytes()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        (**self).read_at(offset, out)
    }
}

/// Several blobs as one.
#[derive(Debug)]
pub struct Joined<B> {
    blobs: Vec<B>,
    bytes: u64,
}

impl<B: Blob> Joined<B> {
    /// The concatenation of `blobs`.
    pub fn new(blobs: Vec<B>) -> Self {
        let bytes = blobs.iter().map(Blob::bytes).sum();
        Self { blobs, bytes }
    }
}

impl<B: Blob> Blob for Joined<B> {
    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        let wanted = out.len();
        if offset.checked_add(wanted as u64).is_none_or(|end| end > self.bytes) {
            return Err(past_the_end(offset, wanted, self.bytes));
        }
        let mut skip = offset;
        let mut out = out;
        for blob in &self.blobs {
            if out.is_empty() {
                break;
            }
            if skip >= blob.bytes() {
                skip -= blob.bytes();
                continue;
            }
            let here = usize::try_from(blob.bytes() - skip).unwrap_or(usize::MAX).min(out.len());
            let (part, rest) = out.split_at_mut(here);
            blob.read_at(skip, part)?;
            out = rest;
            skip = 0;
        }
        Ok(())
    }
}

/// Calls `take` with all bytes of a blob, in parts.
///
/// # Errors
/// The first error of a read or of `take`.
pub fn read_parts<E: From<BlobError>>(blob: &dyn Blob, mut take: impl FnMut(&[u8]) -> Result<(), E>) -> Result<(), E> {
    const PART: u64 = 1 << 20;
    let mut part = vec![0; PART.min(blob.bytes()) as usize];
    let mut offset = 0;
    while offset < blob.bytes() {
        let length = (blob.bytes() - offset).min(PART);
        let part = &mut part[..length as usize];
        blob.read_at(offset, part)?;
        take(part)?;
        offset += length;
    }
    Ok(())
}

/// Digest of a blob, which is read in parts.
///
/// # Errors
/// The first error of a read.
pub fn digest_of(blob: &dyn Blob) -> Result<Digest, BlobError> {
    let mut hasher = Hasher::default();
    read_parts(blob, |part| {
        hasher.update(part);
        Ok::<_, BlobError>(())
    })?;
    Ok(hasher.finish())
}

/// Error of a read past the end of a blob.
pub fn past_the_end(offset: u64, wanted: usize, bytes: u64) -> BlobError {
    BlobError::Unavailable(format!("cannot read {wanted} bytes at {offset}: the blob has {bytes} bytes"))
}
