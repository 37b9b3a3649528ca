//! Blobs that were read before: small ones in memory, all of them in a folder if there is one.
//!
//! Files are named by their digest and verified on every read, so a folder may be shared by workers, cut short by a crash
//! or emptied at any time. The least recently read go first once it is over its bound.

use std::collections::{HashMap, VecDeque};
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;

use protocol::Digest;

use crate::event_count::lock;

/// Bounds, in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds {
    /// Of all blobs in memory.
    pub(crate) memory: usize,
    /// Of one blob in memory.
    pub(crate) small: usize,
    /// Of all files.
    pub(crate) disk: u64,
}

impl Default for Bounds {
    fn default() -> Self {
        Self { memory: 256 << 20, small: 16 << 20, disk: 32 << 30 }
    }
}

#[derive(Debug, Default)]
struct Memory {
    blobs: HashMap<Digest, Arc<[u8]>>,
    order: VecDeque<Digest>,
    bytes: usize,
}

/// A cache of blobs.
#[derive(Debug)]
pub(crate) struct Cache {
    bounds: Bounds,
    memory: Mutex<Memory>,
    folder: Option<PathBuf>,
    /// Bytes in the folder, as far as this process knows.
    disk: Mutex<u64>,
}

impl Cache {
    pub(crate) fn new(folder: Option<PathBuf>, bounds: Bounds) -> std::io::Result<Self> {
        let mut bytes = 0;
        if let Some(folder) = &folder {
            fs::create_dir_all(folder)?;
            bytes = files(folder).iter().map(|(_, bytes, _)| bytes).sum();
        }
        Ok(Self { bounds, memory: Mutex::default(), folder, disk: Mutex::new(bytes) })
    }

    pub(crate) fn get(&self, digest: Digest) -> Option<Arc<[u8]>> {
        if let Some(blob) = lock(&self.memory).blobs.get(&digest) {
            return Some(blob.clone());
        }
        let path = self.path(digest)?;
        let bytes = fs::read(&path).ok()?;
        if Digest::of(&bytes) != digest {
            tracing::warn!("a cached blob does not hash to its name and is fetched again: {}", path.display());
            remove(&path);
            return None;
        }
        // Only the order of eviction hangs on it.
        let _ = File::open(&path).and_then(|file| file.set_modified(SystemTime::now()));
        let blob: Arc<[u8]> = bytes.into();
        self.remember(digest, &blob);
        Some(blob)
    }

    /// Keeps a verified blob. A cache that cannot be written is a slow one, not an error.
    pub(crate) fn insert(&self, digest: Digest, blob: &Arc<[u8]>) {
        self.remember(digest, blob);
        let Some(path) = self.path(digest) else { return };
        match self.write(&path, blob) {
            Ok(()) => {
                let mut bytes = lock(&self.disk);
                *bytes += blob.len() as u64;
                if *bytes > self.bounds.disk {
                    *bytes = self.evict();
                }
            }
            Err(error) => tracing::warn!("a blob is not cached: {}: {error}", path.display()),
        }
    }

    fn remember(&self, digest: Digest, blob: &Arc<[u8]>) {
        if blob.len() > self.bounds.small {
            return;
        }
        let mut memory = lock(&self.memory);
        if memory.blobs.insert(digest, blob.clone()).is_some() {
            return;
        }
        memory.order.push_back(digest);
        memory.bytes += blob.len();
        while memory.bytes > self.bounds.memory {
            let Some(oldest) = memory.order.pop_front() else { break };
            if let Some(blob) = memory.blobs.remove(&oldest) {
                memory.bytes -= blob.len();
            }
        }
    }

    fn path(&self, digest: Digest) -> Option<PathBuf> {
        let hex = digest.hex();
        self.folder.as_ref().map(|folder| folder.join(&hex[..2]).join(&hex[2..]))
    }

    fn write(&self, path: &Path, blob: &[u8]) -> std::io::Result<()> {
        let parent = path.parent().unwrap_or(path);
        fs::create_dir_all(parent)?;
        // No fsync: what a crash cuts short is found out by its digest.
        let staged = path.with_extension(format!("{}.part", std::process::id()));
        let written =
            File::create(&staged).and_then(|mut file| file.write_all(blob)).and_then(|()| fs::rename(&staged, path));
        if written.is_err() {
            remove(&staged);
        }
        written
    }

    /// Deletes the least recently read files until a tenth of the bound is free; returns what is left.
    fn evict(&self) -> u64 {
        let Some(folder) = &self.folder else { return 0 };
        let mut all = files(folder);
        all.sort_by_key(|(_, _, read)| *read);
        let mut bytes: u64 = all.iter().map(|(_, bytes, _)| bytes).sum();
        for (path, size, _) in all {
            if bytes <= self.bounds.disk / 10 * 9 {
                break;
            }
            remove(&path);
            bytes -= size;
        }
        bytes
    }
}

fn remove(path: &Path) {
    if let Err(error) = fs::remove_file(path)
        && error.kind() != std::io::ErrorKind::NotFound
    {
        tracing::debug!("{}: {error}", path.display());
    }
}

/// Path, length and time of the last read of all files two levels down. What vanishes meanwhile is left out.
fn files(folder: &Path) -> Vec<(PathBuf, u64, SystemTime)> {
    let list = |path: &Path| fs::read_dir(path).into_iter().flatten().flatten();
    list(folder)
        .flat_map(|shelf| list(&shelf.path()).collect::<Vec<_>>())
        .filter_map(|file| {
            let data = file.metadata().ok().filter(fs::Metadata::is_file)?;
            Some((file.path(), data.len(), data.modified().ok()?))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blob(byte: u8, length: usize) -> (Digest, Arc<[u8]>) {
        let bytes = vec![byte; length];
        (Digest::of(&bytes), bytes.into())
    }

    #[test]
    fn a_changed_file_is_not_handed_out() {
        let folder = tempfile::tempdir().expect("a folder");
        let (digest, bytes) = blob(1, 100);
        let bounds = Bounds { small: 0, ..Bounds::default() };
        let cache = Cache::new(Some(folder.path().to_owned()), bounds).expect("writable");
        cache.insert(digest, &bytes);
        assert_eq!(cache.get(digest).as_deref(), Some(&*bytes));
        fs::write(cache.path(digest).expect("a folder"), b"something else").expect("writable");
        assert_eq!(cache.get(digest), None);
        assert!(!cache.path(digest).expect("a folder").exists());
    }

    #[test]
    fn bounds_hold() {
        let folder = tempfile::tempdir().expect("a folder");
        let bounds = Bounds { memory: 250, small: 100, disk: 1000 };
        let cache = Cache::new(Some(folder.path().to_owned()), bounds).expect("writable");
        for byte in 0..30 {
            let (digest, bytes) = blob(byte, 100);
            cache.insert(digest, &bytes);
        }
        assert!(lock(&cache.memory).bytes <= 250);
        let on_disk: u64 = files(folder.path()).iter().map(|(_, bytes, _)| bytes).sum();
        assert!(on_disk <= 1000, "{on_disk}");
        assert_eq!(on_disk, *lock(&cache.disk));
    }
}
