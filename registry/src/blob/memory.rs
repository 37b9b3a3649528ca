//! Blobs in memory, for tests and as the reference for other backends.

use std::collections::HashMap;
use std::io::{Cursor, Read};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use protocol::Digest;

use super::{Backend, Entry, Staged, Stat};
use crate::clock;

/// Backend that stores blobs in memory.
#[derive(Debug, Default)]
pub struct Memory(Arc<Mutex<Contents>>);

#[derive(Debug, Default)]
struct Contents {
    blobs: HashMap<Digest, Blob>,
    aside: Vec<String>,
    marker: Option<String>,
    /// Number of writes so far; makes every write's stamp different.
    writes: u64,
}

#[derive(Debug)]
struct Blob {
    bytes: Arc<[u8]>,
    put_ms: i64,
    write: u64,
}

impl Blob {
    fn stat(&self) -> Stat {
        Stat { bytes: self.bytes.len() as u64, put_ms: self.put_ms, stamp: self.write.to_string() }
    }
}

impl Memory {
    fn lock(&self) -> MutexGuard<'_, Contents> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes bytes without the store's knowledge, as a failing disk does.
    pub fn damage(&self, digest: Digest, bytes: &[u8]) {
        let mut held = self.lock();
        held.writes += 1;
        let blob = Blob { bytes: bytes.into(), put_ms: clock::now_ms(), write: held.writes };
        held.blobs.insert(digest, blob);
    }
}

impl Backend for Memory {
    fn stage(&self, _bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        Ok(Box::new(StagedBytes { bytes: Vec::new(), memory: Arc::clone(&self.0) }))
    }

    fn read(&self, digest: Digest, from: u64) -> Result<Box<dyn Read + Send>, BlobError> {
        let bytes = self.lock().blobs.get(&digest).map(|blob| Arc::clone(&blob.bytes));
        let mut cursor = Cursor::new(bytes.ok_or(BlobError::NotFound(digest))?);
        cursor.set_position(from);
        Ok(Box::new(cursor))
    }

    fn stat(&self, digest: Digest) -> Result<Option<Stat>, BlobError> {
        Ok(self.lock().blobs.get(&digest).map(Blob::stat))
    }

    fn touch(&self, digest: Digest) -> Result<Stat, BlobError> {
        let mut held = self.lock();
        let blob = held.blobs.get_mut(&digest).ok_or(BlobError::NotFound(digest))?;
        blob.put_ms = clock::now_ms();
        Ok(blob.stat())
    }

    fn remove(&self, digest: Digest) -> Result<(), BlobError> {
        self.lock().blobs.remove(&digest);
        Ok(())
    }

    fn put_aside(&self, digest: Digest) -> Result<(), BlobError> {
        let mut held = self.lock();
        if held.blobs.remove(&digest).is_some() {
            held.aside.push(digest.to_string());
        }
        Ok(())
    }

    fn list(&self) -> Result<Vec<Entry>, BlobError> {
        let mut entries = Vec::new();
        for (digest, blob) in &self.lock().blobs {
            entries.push(Entry { digest: *digest, bytes: blob.bytes.len() as u64, put_ms: blob.put_ms });
        }
        Ok(entries)
    }

    fn is_empty(&self) -> Result<bool, BlobError> {
        Ok(self.lock().blobs.is_empty())
    }

    fn strays(&self) -> Result<Vec<String>, BlobError> {
        Ok(Vec::new())
    }

    fn aside(&self) -> Result<Vec<String>, BlobError> {
        Ok(self.lock().aside.clone())
    }

    fn marker_place(&self) -> String {
        "memory".into()
    }

    fn marker(&self) -> Result<Option<String>, BlobError> {
        Ok(self.lock().marker.clone())
    }

    fn set_marker(&self, old: Option<&str>, marker: &str) -> Result<bool, BlobError> {
        let mut held = self.lock();
        if held.marker.as_deref() != old {
            return Ok(false);
        }
        held.marker = Some(marker.to_owned());
        Ok(true)
    }
}

#[derive(Debug)]
struct StagedBytes {
    bytes: Vec<u8>,
    memory: Arc<Mutex<Contents>>,
}

impl Staged for StagedBytes {
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        self.bytes.extend_from_slice(bytes);
        Ok(())
    }

    fn commit(self: Box<Self>, digest: Digest) -> Result<bool, BlobError> {
        let mut held = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        if held.blobs.contains_key(&digest) {
            return Ok(false);
        }
        held.writes += 1;
        let blob = Blob { bytes: self.bytes.into(), put_ms: clock::now_ms(), write: held.writes };
        held.blobs.insert(digest, blob);
        Ok(true)
    }
}
