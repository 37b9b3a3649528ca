//! Unfinished uploads: bytes that are hashed as they arrive, and the table of uploads between two requests.

use std::collections::{BTreeMap, HashMap};
use std::sync::Mutex;
use std::time::Instant;

use checkpoint::BlobError;
use protocol::digest::Hasher;
use protocol::limits::SMALL_BLOB_BYTES;
use protocol::{Digest, Incarnation, TaskId, WorkerId};

use super::backend::Staged;
use super::holds::Holds;

/// An upload that is hashed as it arrives. Dropping it deletes the bytes.
#[derive(Debug)]
pub struct Upload {
    pub(super) staged: Box<dyn Staged>,
    pub(super) hasher: Hasher,
    pub(super) written: u64,
    /// The announced length.
    pub(super) bytes: u64,
    /// The bytes so far, while they are few and all came to this process.
    pub(super) content: Option<Vec<u8>>,
}

impl Upload {
    /// Starts an upload of at most `bytes` bytes.
    pub(super) fn new(staged: Box<dyn Staged>, bytes: u64) -> Self {
        Self { staged, hasher: Hasher::default(), written: 0, bytes, content: Some(Vec::new()) }
    }

    /// Appends bytes to the staging area.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        let written = self.written + bytes.len() as u64;
        if written > self.bytes {
            return Err(BlobError::Refused(format!("received more bytes than the announced {}", self.bytes)));
        }
        self.staged.write(bytes)?;
        self.hasher.update(bytes);
        self.written = written;
        self.content = self.content.take().filter(|_| written <= SMALL_BLOB_BYTES).map(|mut content| {
            content.extend_from_slice(bytes);
            content
        });
        Ok(())
    }

    /// Returns the number of bytes that have arrived.
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Returns true if all announced bytes have arrived.
    pub fn is_complete(&self) -> bool {
        self.written == self.bytes
    }
}

/// Owner of an upload. Has no fence, because the fence grows when a gang regroups while its lead continues the upload.
pub(super) type Holder = (TaskId, WorkerId, Incarnation);

/// Uploads of one process, and blobs that collection must keep before a row names them.
#[derive(Debug)]
pub(super) struct Uploads {
    pub(super) begun: Mutex<HashMap<(Holder, Digest), Begun>>,
    pub(super) held: Mutex<Holds>,
    /// Blobs that callers in this process are about to name in a row, with the number of callers.
    pub(super) protected: Mutex<BTreeMap<Digest, usize>>,
    pub(super) since: Instant,
}

impl Uploads {
    pub(super) fn new() -> Self {
        Self { begun: Mutex::default(), held: Mutex::default(), protected: Mutex::default(), since: Instant::now() }
    }
}

/// An upload between its requests.
#[derive(Debug)]
pub(super) struct Begun {
    /// `None` while a request writes to it, and while it waits.
    pub(super) upload: Option<Upload>,
    /// True if all bytes have arrived but could not be stored. They stay in the staging area for the next request.
    pub(super) waits: bool,
    /// The announced length; `None` if an earlier process began the upload.
    pub(super) bytes: Option<u64>,
    pub(super) touched: Instant,
}
