//! Uploads that have begun: bytes that are hashed as they arrive, and the table of those that wait for their next request.

use std::collections::{BTreeMap, HashMap};
use std::sync::Mutex;
use std::time::Instant;

use checkpoint::BlobError;
use protocol::digest::Hasher;
use protocol::{Digest, Incarnation, TaskId, WorkerId};

use super::backend::Staged;
use super::holds::Holds;

/// Bytes that arrive in parts and are hashed on the way. They are gone if it is dropped.
#[derive(Debug)]
pub struct Upload {
    pub(super) staged: Box<dyn Staged>,
    pub(super) hasher: Hasher,
    pub(super) written: u64,
    /// How many bytes there may be.
    pub(super) bytes: u64,
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
