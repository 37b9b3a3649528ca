//! Reads of an object in ranges.

use std::io::{self, Cursor, Read};
use std::sync::Arc;

use checkpoint::BlobError;
use object_store::ObjectStoreExt as _;
use object_store::path::Path;

use super::remote::Remote;

/// Bytes of the first request of a read, or more if the reader asks for more. Each further request doubles, up to
/// [`READ_BYTES`].
const FIRST_READ_BYTES: usize = 64 << 10;
const READ_BYTES: usize = 4 << 20;

/// Reads an object in ranges, one request each, so that a slow reader keeps no connection open.
pub(super) struct Ranges {
    remote: Arc<Remote>,
    path: Path,
    at: u64,
    end: u64,
    /// Bytes of the next request.
    next: usize,
    part: Cursor<bytes::Bytes>,
}

impl Ranges {
    /// Reads the object at `path` from byte `from` to byte `end`.
    pub(super) fn new(remote: Arc<Remote>, path: Path, from: u64, end: u64) -> Self {
        Self { remote, path, at: from, end, next: FIRST_READ_BYTES, part: Cursor::default() }
    }
}

impl Read for Ranges {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let read = self.part.read(out)?;
        if read > 0 || self.at >= self.end || out.is_empty() {
            return Ok(read);
        }
        let length = self.next.max(out.len()).min(READ_BYTES);
        self.next = length.saturating_mul(2);
        let range = self.at..self.end.min(self.at + length as u64);
        let store = Arc::clone(&self.remote.store);
        let path = self.path.clone();
        let wanted = range.clone();
        let part = self.remote.wait_long(async move { store.get_range(&path, wanted).await });
        let part = part.map_err(|e| match self.remote.error("read", &self.path, &e) {
            BlobError::Unreachable(message) => io::Error::new(io::ErrorKind::HostUnreachable, message),
            e => io::Error::other(e.to_string()),
        })?;
        if part.is_empty() {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        self.at += part.len() as u64;
        self.part = Cursor::new(part);
        self.part.read(out)
    }
}
