//! The artifact container over bytes: manifests, aligned tensors, limits.
//!
//! An artifact is a [`Manifest`](protocol::Manifest) that lists blobs; tensors are safetensors, everything else is JSON.
//! Nothing in it is executable on load. Not its job: where blobs live, and whether they may be written.

pub mod bundle;

use std::fmt;
use std::sync::Arc;

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
    /// The grant has ended.
    #[error("write refused: {0}")]
    Refused(String),
    /// Full or not writable.
    #[error("{0}")]
    Storage(String),
    /// Anything else, after retries.
    #[error("{0}")]
    Unavailable(String),
}

/// Content-addressed bytes. Reads are verified.
pub trait Blobs: Send + Sync + fmt::Debug {
    /// The bytes named `digest`.
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError>;
    /// Stores bytes and returns their name. Storing the same bytes twice stores them once.
    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError>;
}
