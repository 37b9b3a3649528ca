//! Blobs in memory: for tests, and the yardstick for every other backend.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use protocol::Digest;

use super::{Backend, Entry};
use crate::clock;

/// Blobs in memory.
#[derive(Debug, Default)]
pub struct Memory(Mutex<HashMap<Digest, (Vec<u8>, i64)>>);

impl Memory {
    fn lock(&self) -> MutexGuard<'_, HashMap<Digest, (Vec<u8>, i64)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Backend for Memory {
    fn read(&self, digest: Digest) -> Result<Vec<u8>, BlobError> {
        self.lock().get(&digest).map(|(bytes, _)| bytes.clone()).ok_or(BlobError::NotFound(digest))
    }

    fn write(&self, digest: Digest, bytes: &[u8]) -> Result<(), BlobError> {
        self.lock().insert(digest, (bytes.to_vec(), clock::now_ms()));
        Ok(())
    }

    fn size(&self, digest: Digest) -> Result<Option<u64>, BlobError> {
        Ok(self.lock().get(&digest).map(|(bytes, _)| bytes.len() as u64))
    }

    fn put_ms(&self, digest: Digest) -> Result<Option<i64>, BlobError> {
        Ok(self.lock().get(&digest).map(|(_, put_ms)| *put_ms))
    }

    fn touch(&self, digest: Digest) -> Result<(), BlobError> {
        let mut blobs = self.lock();
        let entry = blobs.get_mut(&digest).ok_or(BlobError::NotFound(digest))?;
        entry.1 = clock::now_ms();
        Ok(())
    }

    fn remove(&self, digest: Digest) -> Result<(), BlobError> {
        self.lock().remove(&digest);
        Ok(())
    }

    fn list(&self) -> Result<Vec<Entry>, BlobError> {
        let entry = |(digest, (bytes, put_ms)): (&Digest, &(Vec<u8>, i64))| Entry {
            digest: *digest,
            bytes: bytes.len() as u64,
            put_ms: *put_ms,
        };
        Ok(self.lock().iter().map(entry).collect())
    }
}
