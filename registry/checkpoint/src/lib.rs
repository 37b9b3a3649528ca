//! The artifact container over bytes: manifests, aligned tensors, limits.
//!
//! An artifact is a [`Manifest`](protocol::Manifest) that lists blobs; tensors are safetensors, everything else is JSON.
//! Nothing in it is executable on load. Not its job: where blobs live, and whether they may be written.

pub mod model;
pub mod published;
pub mod torch;

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use protocol::Digest;

/// Why a blob could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// No such blob.
    #[error("blob {0} is not in the store")]
    NotFound(Digest),
    /// The bytes do not hash to the name.
    #[error("blob {expected} is corrupt: its bytes hash to {found}")]
    Corrupt {
        /// The name.
        expected: Digest,
        /// What the bytes hash to.
        found: Digest,
    },
    /// The store found the bytes damaged and does not hand them out; the message names the blob.
    #[error("{0}")]
    Damaged(String),
    /// The grant has ended.
    #[error("write refused: {0}")]
    Refused(String),
    /// The store takes no such bytes from any caller at any time.
    #[error("{0}")]
    Unfit(String),
    /// Full or not writable.
    #[error("{0}")]
    Storage(String),
    /// The place where blobs lie does not answer; the same call may succeed later.
    #[error("{0}")]
    Unreachable(String),
    /// Anything else, after retries.
    #[error("{0}")]
    Unavailable(String),
}

/// Content-addressed bytes. Reads are verified.
///
/// What may be large goes through [`put_pieces`](Self::put_pieces) and [`open`](Self::open), which hold no second copy of it.
pub trait Blobs: Send + Sync + fmt::Debug {
    /// The bytes named `digest`, in memory.
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError>;

    /// Stores bytes and returns their name. Storing the same bytes twice stores them once.
    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError>;

    /// Stores the bytes that `pieces` are one after the other.
    fn put_pieces(&self, pieces: &[&[u8]]) -> Result<Digest, BlobError> {
        self.put(pieces.concat())
    }

    /// The blob named `digest`, verified, to be read where it is needed.
    fn open(&self, digest: Digest) -> Result<Box<dyn Blob>, BlobError> {
        Ok(Box::new(self.get(digest)?))
    }

    /// The blob named `digest`, verified, as bytes that need no memory of this process where a file of the machine has them. For what
    /// is read again and again, such as a dataset.
    fn map(&self, digest: Digest) -> Result<Bytes, BlobError> {
        Ok(Bytes::from_owner(self.get(digest)?))
    }
}

/// Where a blob lies below the folder of a store that keeps its blobs beside its database.
pub fn blob_path(store: &Path, digest: Digest) -> PathBuf {
    let hex = digest.hex();
    store.join(BLOBS).join(&hex[..2]).join(&hex[2..])
}

/// The folder of all blobs, below that of their store.
pub const BLOBS: &str = "blobs/sha256";

/// A verified blob.
pub trait Blob: Send + fmt::Debug {
    /// Its length.
    fn bytes(&self) -> u64;

    /// Fills `out` with what begins at `offset`; a blob that ends before that is an error.
    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError>;
}

impl Blob for Arc<[u8]> {
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

/// The error of a read that a blob is too short for.
pub fn past_the_end(offset: u64, wanted: usize, bytes: u64) -> BlobError {
    BlobError::Unavailable(format!("a blob of {bytes} bytes has no {wanted} bytes at {offset}"))
}
