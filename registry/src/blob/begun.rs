//! Uploads that have begun: bytes that are hashed as they arrive, and the table of those that wait for their next request.

use std::collections::{BTreeMap, HashMap};
use std::sync::Mutex;
use std::time::Instant;

use checkpoint::BlobError;
use protocol::digest::Hasher;
use protocol::{Digest, Incarnation, TaskId, WorkerId};

use super::backend::Staged;
use super::holds::Holds;
use super::seen::SMALL_BYTES;

/// Bytes that arrive in parts and are hashed on the way. They are gone if it is dropped.
#[derive(Debug)]
pub struct Upload {
    pub(super) staged: Box<dyn Staged>,
    pub(super) hasher: Hasher,
    pub(super) written: u64,
    /// How many bytes there may be.
    pub(super) bytes: u64,
    /// What has come, while it is short and all of it came to this process.
    pub(super) content: Option<Vec<u8>>,
}

impl Upload {
    /// Nothing has come yet of the `bytes` bytes that may.
    pub(super) fn new(staged: Box<dyn Staged>, bytes: u64) -> Self {
        Self { staged, hasher: Hasher::default(), written: 0, bytes, content: Some(Vec::new()) }
    }

    /// Appends bytes, on disk or where blobs lie.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        let written = self.written + bytes.len() as u64;
        if written > self.bytes {
            return Err(BlobError::Refused(format!("more bytes came than the {} that were announced", self.bytes)));
        }
        self.staged.write(bytes)?;
        self.hasher.update(bytes);
        self.written = written;
        self.content = self.content.take().filter(|_| written <= SMALL_BYTES).map(|mut content| {
            content.extend_from_slice(bytes);
            content
        });
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

/// Whose upload it is. The fence is left out: it grows when a gang regroups, and its lead uploads on.
pub(super) type Holder = (TaskId, WorkerId, Incarnation);

/// Uploads of one process, and the blobs that are kept from collection before a row names them.
#[derive(Debug)]
pub(super) struct Uploads {
    pub(super) begun: Mutex<HashMap<(Holder, Digest), Begun>>,
    pub(super) held: Mutex<Holds>,
    /// Blobs that somebody in this process is about to name in a row, and how many do.
    pub(super) protected: Mutex<BTreeMap<Digest, usize>>,
    pub(super) since: Instant,
}

impl Uploads {
    pub(super) fn new(held: Holds) -> Self {
        Self { begun: Mutex::default(), held: Mutex::new(held), protected: Mutex::default(), since: Instant::now() }
    }
}

/// An upload between its requests.
#[derive(Debug)]
pub(super) struct Begun {
    /// `None` while a request writes to it, and while it waits.
    pub(super) upload: Option<Upload>,
    /// All of it has arrived and could not be stored: the bytes are where they arrived, for the next request to take up.
    pub(super) waits: bool,
    /// `None` if it was begun by an earlier process, which was told.
    pub(super) bytes: Option<u64>,
    pub(super) touched: Instant,
}
