//! Cache of fetched blobs: small ones in memory, and all of them in a folder if one is configured.
//!
//! Files are named by their digest and verified at every opening. So workers may share a folder, a crash may truncate
//! its files, and it may be emptied at any time. Above the folder's limit, the least recently read files are deleted
//! first. Without a folder, a large blob is in an unnamed temporary file, which disappears after its last reader.

use std::collections::{HashMap, VecDeque};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;

use bytes::Bytes;
use checkpoint::{Blob, BlobError};
use protocol::Digest;
use protocol::digest::Hasher;

use crate::event_count::lock;
use crate::mapped;

/// Limits, in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds {
    /// Total size of the blobs in memory.
    pub(crate) memory: usize,
    /// Largest single blob in memory.
    pub(crate) small: usize,
    /// Total size of the files.
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

/// A cache of blobs; see the module.
#[derive(Debug)]
pub(crate) struct Cache {
    bounds: Bounds,
    memory: Mutex<Memory>,
    /// Prefetched blobs in unnamed files.
    ahead: Mutex<HashMap<Digest, Cached>>,
    folder: Option<PathBuf>,
    /// Folder of the coordinator's store, if it is on this machine. Its blobs are read in place.
    store: Option<PathBuf>,
    /// Bytes in the folder by this process's count.
    disk: Mutex<u64>,
}

impl Cache {
    pub(crate) fn new(folder: Option<PathBuf>, store: Option<PathBuf>, bounds: Bounds) -> std::io::Result<Self> {
        let mut bytes = 0;
        if let Some(folder) = &folder {
            fs::create_dir_all(folder)?;
            bytes = files(folder).iter().map(|(_, bytes, _)| bytes).sum();
        }
        Ok(Self { bounds, memory: Mutex::default(), ahead: Mutex::default(), folder, store, disk: Mutex::new(bytes) })
    }

    /// Returns a cached blob after verifying it again.
    pub(crate) fn get(&self, digest: Digest) -> Option<Cached> {
        if let Some(blob) = lock(&self.memory).blobs.get(&digest) {
            return Some(Cached::Memory(blob.clone()));
        }
        if let Some(blob) = lock(&self.ahead).get(&digest) {
            return Some(blob.clone());
        }
        if let Some(file) = self.in_store(digest) {
            return self.keep_small(digest, Cached::File(file)).ok();
        }
        let path = self.path(digest)?;
        let mut file = File::open(&path).ok()?;
        if file.metadata().is_ok_and(|data| !data.is_file())
            || !Digest::of_all(&mut file).is_ok_and(|(found, _)| found == digest)
        {
            tracing::warn!("a cached blob does not hash to its name and is fetched again: {}", path.display());
            remove(&path);
            return None;
        }
        // Only the order of eviction depends on this time.
        let _ = file.set_modified(SystemTime::now());
        let blob = Cached::File(CachedFile::new(digest, file).ok()?);
        self.keep_small(digest, blob).ok()
    }

    /// Opens a blob of the store on this machine. `None` if it is missing or damaged; the coordinator reports that.
    fn in_store(&self, digest: Digest) -> Option<CachedFile> {
        let mut file = File::open(checkpoint::blob_path(self.store.as_ref()?, digest)).ok()?;
        if file.metadata().is_ok_and(|data| !data.is_file())
            || !Digest::of_all(&mut file).is_ok_and(|(found, _)| found == digest)
        {
            return None;
        }
        CachedFile::new(digest, file).ok()
    }

    /// Keeps a blob in an unnamed file until [`forget_ahead`](Self::forget_ahead), because a task will read it soon.
    pub(crate) fn keep_ahead(&self, digest: Digest, blob: &Cached) {
        if self.folder.is_none() && matches!(blob, Cached::File(_)) {
            lock(&self.ahead).insert(digest, blob.clone());
        }
    }

    /// Releases the prefetched blobs that are not among `wanted`.
    pub(crate) fn forget_ahead(&self, wanted: &[Digest]) {
        lock(&self.ahead).retain(|digest, _| wanted.contains(digest));
    }

    /// Prepares the destination of a blob that is being fetched; `length` is its size if known.
    pub(crate) fn arriving(&self, digest: Digest, length: Option<u64>) -> io::Result<Arriving> {
        let small = length.is_some_and(|length| length <= self.bounds.small as u64);
        let place = if small {
            Place::Memory(Vec::new())
        } else {
            match self.path(digest) {
                Some(path) => Place::named(path)?,
                None => Place::nameless(&std::env::temp_dir())?,
            }
        };
        Ok(Arriving { digest, place, hasher: Hasher::default(), written: 0 })
    }

    /// Copies bytes that come in pieces: small ones in memory, others to an unnamed file.
    pub(crate) fn copy(&self, pieces: &[&[u8]]) -> io::Result<Box<dyn Blob>> {
        let bytes: u64 = pieces.iter().map(|piece| piece.len() as u64).sum();
        if bytes <= self.bounds.small as u64 {
            return Ok(Box::new(Arc::<[u8]>::from(pieces.concat())));
        }
        let mut place = Place::nameless(self.folder.as_deref().unwrap_or(&std::env::temp_dir()))?;
        pieces.iter().try_for_each(|piece| place.write(piece))?;
        Ok(Box::new(Copied { file: place.publish()?, bytes }))
    }

    /// Keeps a verified blob. A cache that cannot be written makes reads slower but is no error.
    fn insert(&self, digest: Digest, blob: &Arc<[u8]>) {
        self.remember(digest, blob);
        let Some(path) = self.path(digest) else { return };
        match Place::named(path.clone()).and_then(|mut place| {
            place.write(blob)?;
            place.publish()
        }) {
            Ok(_) => self.grew(blob.len() as u64),
            Err(error) => tracing::warn!("a blob is not cached: {}: {error}", path.display()),
        }
    }

    fn grew(&self, by: u64) {
        let mut bytes = lock(&self.disk);
        *bytes += by;
        if *bytes > self.bounds.disk {
            *bytes = self.evict();
        }
    }

    /// Moves a blob into memory if it is small enough.
    fn keep_small(&self, digest: Digest, blob: Cached) -> Result<Cached, BlobError> {
        if blob.bytes() > self.bounds.small as u64 {
            return Ok(blob);
        }
        let blob = blob.into_memory()?;
        self.remember(digest, &blob);
        Ok(Cached::Memory(blob))
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

    /// Deletes the least recently read files until a tenth of the limit is free. Returns the bytes that remain.
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

/// A verified blob in memory or in a file.
#[derive(Debug, Clone)]
pub(crate) enum Cached {
    Memory(Arc<[u8]>),
    File(CachedFile),
}

/// A verified blob in an open file. Files are replaced and removed, but their content never changes.
#[derive(Debug, Clone)]
pub(crate) struct CachedFile {
    digest: Digest,
    file: Arc<File>,
    bytes: u64,
}

impl CachedFile {
    fn new(digest: Digest, file: File) -> io::Result<Self> {
        let bytes = file.metadata()?.len();
        Ok(Self { digest, file: Arc::new(file), bytes })
    }
}

impl Cached {
    /// Reads the whole blob into memory.
    pub(crate) fn into_memory(self) -> Result<Arc<[u8]>, BlobError> {
        match self {
            Self::Memory(bytes) => Ok(bytes),
            Self::File(file) => {
                let length = usize::try_from(file.bytes).unwrap_or(usize::MAX);
                let mut bytes: Arc<[u8]> = std::iter::repeat_n(0, length).collect();
                let out = Arc::get_mut(&mut bytes).expect("the buffer is new and not shared");
                Self::File(file).read_at(0, out)?;
                Ok(bytes)
            }
        }
    }

    /// Returns the whole blob. A blob in a file is mapped and uses no memory of this process.
    pub(crate) fn into_bytes(self) -> Result<Bytes, BlobError> {
        match self {
            Self::Memory(bytes) => Ok(Bytes::from_owner(bytes)),
            Self::File(file) => mapped::file(&file.file)
                .map_err(|e| BlobError::Unavailable(format!("mapping the cached blob {}: {e}", file.digest))),
        }
    }
}

impl Blob for Cached {
    fn bytes(&self) -> u64 {
        match self {
            Self::Memory(bytes) => bytes.len() as u64,
            Self::File(file) => file.bytes,
        }
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        match self {
            Self::Memory(bytes) => bytes.read_at(offset, out),
            Self::File(file) => file
                .file
                .read_exact_at(out, offset)
                .map_err(|e| BlobError::Unavailable(format!("reading the cached blob {}: {e}", file.digest))),
        }
    }
}

/// A copy in a file without a name.
#[derive(Debug)]
struct Copied {
    file: File,
    bytes: u64,
}

impl Blob for Copied {
    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        let failed = |e| BlobError::Storage(format!("reading the copy of a checkpoint: {e}"));
        self.file.read_exact_at(out, offset).map_err(failed)
    }
}

/// A blob on its way into the cache, hashed while it arrives.
#[derive(Debug)]
pub(crate) struct Arriving {
    digest: Digest,
    place: Place,
    hasher: Hasher,
    written: u64,
}

impl Arriving {
    pub(crate) fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.place.write(bytes)?;
        self.hasher.update(bytes);
        self.written += bytes.len() as u64;
        Ok(())
    }

    /// Number of bytes that have arrived.
    pub(crate) fn written(&self) -> u64 {
        self.written
    }

    /// Verifies and returns the blob. If its digest differs from its name, returns the digest found.
    pub(crate) fn finish(self, cache: &Cache) -> Result<Result<Cached, Digest>, BlobError> {
        let found = self.hasher.finish();
        if found != self.digest {
            return Ok(Err(found));
        }
        let local = |e: io::Error| BlobError::Storage(format!("blob {} cannot be kept here: {e}", self.digest));
        match self.place {
            Place::Memory(bytes) => {
                let blob: Arc<[u8]> = bytes.into();
                cache.insert(self.digest, &blob);
                Ok(Ok(Cached::Memory(blob)))
            }
            place => {
                let is_named = matches!(place, Place::Named { .. });
                let file = place.publish().map_err(local)?;
                if is_named {
                    cache.grew(self.written);
                }
                let blob = Cached::File(CachedFile::new(self.digest, file).map_err(local)?);
                cache.keep_small(self.digest, blob).map(Ok)
            }
        }
    }
}

/// Destination of an arriving blob.
#[derive(Debug)]
enum Place {
    Memory(Vec<u8>),
    Named { file: File, staged: Staged, path: PathBuf },
    Nameless(File),
}

/// A file that is deleted unless it is renamed to its final name.
#[derive(Debug)]
struct Staged(PathBuf);

impl Drop for Staged {
    fn drop(&mut self) {
        remove(&self.0);
    }
}

impl Place {
    fn named(path: PathBuf) -> io::Result<Self> {
        fs::create_dir_all(path.parent().unwrap_or(&path))?;
        let staged = Staged(path.with_extension(unique()));
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(&staged.0)?;
        Ok(Self::Named { file, staged, path })
    }

    /// An unnamed file in `folder`.
    fn nameless(folder: &Path) -> io::Result<Self> {
        let path = folder.join(format!("stride-{}", unique()));
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(&path)?;
        fs::remove_file(&path)?;
        Ok(Self::Nameless(file))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Self::Memory(memory) => {
                memory.extend_from_slice(bytes);
                Ok(())
            }
            Self::Named { file, .. } | Self::Nameless(file) => file.write_all(bytes),
        }
    }

    /// Returns the file of the whole blob, after renaming a named one. Without fsync: the digest reveals a file that a
    /// crash truncates.
    fn publish(self) -> io::Result<File> {
        match self {
            Self::Memory(_) => Err(io::Error::other("a blob in memory has no file")),
            Self::Nameless(file) => Ok(file),
            Self::Named { file, staged, path } => {
                fs::rename(&staged.0, path)?;
                Ok(file)
            }
        }
    }
}

/// A unique part of a file name.
fn unique() -> String {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    format!("{}.{}.part", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed))
}

fn remove(path: &Path) {
    if let Err(error) = fs::remove_file(path)
        && error.kind() != std::io::ErrorKind::NotFound
    {
        tracing::debug!("{}: {error}", path.display());
    }
}

/// Path, length and last read of all files two levels down. Skips files that disappear during the listing.
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
        let cache = Cache::new(Some(folder.path().to_owned()), None, bounds).expect("writable");
        cache.insert(digest, &bytes);
        let found = cache.get(digest).expect("kept").into_memory().expect("read");
        assert_eq!(found, bytes);
        fs::write(cache.path(digest).expect("a folder"), b"something else").expect("writable");
        assert!(cache.get(digest).is_none());
        assert!(!cache.path(digest).expect("a folder").exists());
    }

    #[test]
    fn blobs_of_a_store_on_this_machine_are_read_in_place_and_verified() {
        let store = tempfile::tempdir().expect("a folder");
        let folder = tempfile::tempdir().expect("a folder");
        let (digest, bytes) = blob(1, 100);
        let path = checkpoint::blob_path(store.path(), digest);
        fs::create_dir_all(path.parent().expect("a shelf")).expect("writable");
        fs::write(&path, &bytes).expect("writable");
        let bounds = Bounds { small: 0, ..Bounds::default() };
        let places = (Some(folder.path().to_owned()), Some(store.path().to_owned()));
        let cache = Cache::new(places.0, places.1, bounds).expect("writable");
        let found = cache.get(digest).expect("it is there").into_bytes().expect("mapped");
        fs::remove_file(&path).expect("it is there");
        assert_eq!(*found, *bytes, "what is mapped stays");
        assert!(cache.get(digest).is_none() && files(folder.path()).is_empty(), "there is no second copy");
        fs::write(&path, b"something else").expect("writable");
        assert!(cache.get(digest).is_none());
        assert!(path.exists(), "the store's files are the coordinator's");
    }

    #[test]
    fn bounds_hold() {
        let folder = tempfile::tempdir().expect("a folder");
        let bounds = Bounds { memory: 250, small: 100, disk: 1000 };
        let cache = Cache::new(Some(folder.path().to_owned()), None, bounds).expect("writable");
        for byte in 0..30 {
            let (digest, bytes) = blob(byte, 100);
            cache.insert(digest, &bytes);
        }
        assert!(lock(&cache.memory).bytes <= 250);
        let on_disk: u64 = files(folder.path()).iter().map(|(_, bytes, _)| bytes).sum();
        assert!(on_disk <= 1000, "{on_disk}");
        assert_eq!(on_disk, *lock(&cache.disk));
    }

    #[test]
    fn a_large_blob_arrives_in_a_file_with_and_without_a_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        for place in [Some(folder.path().to_owned()), None] {
            let bounds = Bounds { small: 10, ..Bounds::default() };
            let cache = Cache::new(place.clone(), None, bounds).expect("writable");
            let (digest, bytes) = blob(1, 1000);
            let mut arriving = cache.arriving(digest, Some(1000)).expect("writable");
            arriving.write(&bytes[..600]).expect("written");
            assert_eq!(arriving.written(), 600);
            arriving.write(&bytes[600..]).expect("written");
            let blob = arriving.finish(&cache).expect("kept").expect("whole");
            assert!(matches!(blob, Cached::File(_)));
            let mut read = [0; 10];
            blob.read_at(990, &mut read).expect("read");
            assert_eq!(read, [1; 10]);
            assert!(blob.read_at(991, &mut read).is_err());
            assert!(lock(&cache.memory).blobs.is_empty());
            assert_eq!(cache.get(digest).is_some(), place.is_some());

            let mut damaged = cache.arriving(digest, Some(1000)).expect("writable");
            damaged.write(&bytes[1..]).expect("written");
            assert!(damaged.finish(&cache).expect("no error of the disk").is_err());
        }
        assert_eq!(files(folder.path()).len(), 1, "no part is left");
    }

    #[test]
    fn a_copy_of_pieces_is_in_memory_or_in_a_file_that_has_no_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let bounds = Bounds { small: 10, ..Bounds::default() };
        let cache = Cache::new(Some(folder.path().to_owned()), None, bounds).expect("writable");
        let mut bytes = vec![3; 1000];
        let [none, small, large] = [&[][..], &[&bytes[..4]], &[&bytes[..600], &bytes[600..]]].map(|p| cache.copy(p));
        bytes.fill(0);
        for (copy, expected) in [(none, 0), (small, 4), (large, 1000)] {
            let copy = copy.expect("copied");
            assert_eq!(copy.bytes(), expected);
            let mut read = vec![0; copy.bytes() as usize];
            copy.read_at(0, &mut read).expect("read");
            assert!(read.iter().all(|byte| *byte == 3));
            assert!(copy.read_at(1, &mut read).is_err() || read.is_empty());
        }
        assert_eq!(fs::read_dir(folder.path()).expect("readable").count(), 0);
    }
}
