//! Blobs in an object store: S3 and compatible servers, Google Cloud Storage, Azure.
//!
//! ```text
//! PREFIX/IDENTITY           the store that the blobs belong to
//! PREFIX/sha256/ab/cdef...  a blob
//! PREFIX/quarantine/...     damaged blobs that were put aside
//! PREFIX/uploads/...        uploads in parts that have not ended
//! ```
//!
//! The store's folder keeps the database, the lock and arriving blobs. A blob is sent when all of it has arrived and
//! hashes to its name. A small blob is sent by a put that fails if the name is taken; a large one in parts
//! (`multipart`). The time of an object cannot be set, so this process remembers the times of its own puts. For older
//! objects the server's time counts; the blobs of a held task are protected by rows, not by their age.

mod health;
mod multipart;
mod remote;

use std::collections::{BTreeSet, HashMap};
use std::fs::OpenOptions;
use std::io::{self, Cursor, Read};
use std::path::Path as FilePath;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use checkpoint::BlobError;
use fail::fail_point;
use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::{Error, ObjectMeta, ObjectStoreExt as _, PutMode, PutOptions, PutPayload, UpdateVersion};
use protocol::Digest;
use tokio::sync::Semaphore;

pub(super) use self::remote::check_url;
pub use self::remote::{Bucket, Remote};

use self::multipart::{Multipart, PART_BYTES, kib, local, read_part};
use super::disk::{Os, regular};
use super::staging::{Part, Staging};
use super::{Backend, Entry, Problem, Staged, Stat};
use crate::clock;

/// Number of parts under way at once, over all blobs, or as many bytes of small ones. Bounds the memory for sending.
const PARTS: usize = 4;
/// Bytes of the first request of a read, or more if the reader asks for more. Each further request doubles, up to
/// [`READ_BYTES`].
const FIRST_READ_BYTES: usize = 64 << 10;
const READ_BYTES: usize = 4 << 20;
/// Time limit of a removal. It starts under a lease and must end before another process can take the lease.
const REMOVAL: Duration = Duration::from_secs(10);

/// Backend that stores blobs in an object store.
#[derive(Debug)]
pub struct Objects(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    remote: Arc<Remote>,
    staging: Staging,
    /// Times of this process's puts, in milliseconds since 1970.
    puts: Mutex<HashMap<Digest, i64>>,
    multipart: Multipart,
    /// Free room for requests under way, in KiB.
    parts: Arc<Semaphore>,
}

impl Objects {
    /// Opens the blobs of the store in `dir`. Only for the holder of the store's lock.
    pub fn open(remote: Arc<Remote>, dir: &FilePath) -> io::Result<Self> {
        std::fs::create_dir_all(dir.join("blobs"))?;
        let staging = Staging::open(dir.join("staging"), Arc::new(Os))?;
        Ok(Self::with(remote, staging))
    }

    /// Opens the blobs read-only: creates and clears nothing.
    pub fn to_read(remote: Arc<Remote>, dir: &FilePath) -> Self {
        let staging = Staging::to_read(dir.join("staging"), Arc::new(Os));
        Self::with(remote, staging)
    }

    fn with(remote: Arc<Remote>, staging: Staging) -> Self {
        let parts = Arc::new(Semaphore::new((PARTS * PART_BYTES) >> 10));
        let multipart = Multipart::new(Arc::clone(&remote), Arc::clone(&parts));
        Self(Arc::new(Inner { remote, staging, puts: Mutex::default(), multipart, parts }))
    }
}

impl Inner {
    fn store(&self) -> Arc<dyn Bucket> {
        Arc::clone(&self.remote.store)
    }

    fn head(&self, digest: Digest) -> Result<Option<ObjectMeta>, BlobError> {
        let store = self.store();
        let path = self.remote.blob(digest);
        let wanted = path.clone();
        match self.remote.wait(async move { store.head(&wanted).await }) {
            Ok(meta) => Ok(Some(meta)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(e) => Err(self.remote.error("read the metadata of", &path, &e)),
        }
    }

    fn stat(&self, digest: Digest, meta: &ObjectMeta) -> Stat {
        let tag = meta.e_tag.as_deref().unwrap_or("-").replace(char::is_whitespace, "_");
        let stamp = format!("{}-{tag}-{}", meta.size, meta.last_modified.timestamp());
        Stat { bytes: meta.size, put_ms: self.put_ms(digest, meta), stamp }
    }

    fn put_ms(&self, digest: Digest, meta: &ObjectMeta) -> i64 {
        self.puts().get(&digest).copied().unwrap_or_else(|| meta.last_modified.timestamp_millis())
    }

    fn puts(&self) -> MutexGuard<'_, HashMap<Digest, i64>> {
        self.puts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn note(&self, digest: Digest) {
        self.puts().insert(digest, clock::now_ms());
    }

    fn list(&self, folder: &str) -> Result<Vec<ObjectMeta>, BlobError> {
        let store = self.store();
        let path = self.remote.path(folder);
        let wanted = path.clone();
        let listed = self.remote.wait(async move { store.list(Some(&wanted)).try_collect().await });
        listed.map_err(|e| self.remote.error("list", &path, &e))
    }

    /// Sends `bytes` bytes, in one request if they are few. Returns `false` if the name was taken.
    fn send(&self, path: &Path, bytes: u64, mut source: impl Read + Send + 'static) -> Result<bool, Error> {
        let store = self.store();
        let path = path.clone();
        let parts = Arc::clone(&self.parts);
        if bytes > PART_BYTES as u64 {
            let multipart = self.multipart.clone();
            return self.remote.wait_long(async move { multipart.send(path, source).await.map(|()| true) });
        }
        let whole = read_part(&mut source).map_err(local)?;
        let put = self.remote.wait_long(async move {
            let _room = parts.acquire_many(kib(whole.len())).await;
            store.put_opts(&path, PutPayload::from(whole), PutOptions::from(PutMode::Create)).await
        });
        match put {
            Ok(_) => Ok(true),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
            Err(e) => Err(e),
        }
    }

    /// Writes the marker unless one exists; returns `false` if one does.
    fn create_marker(&self, marker: &str) -> Result<bool, BlobError> {
        let path = self.remote.path("IDENTITY");
        self.send(&path, 0, Cursor::new(marker.to_owned())).map_err(|e| self.remote.error("write", &path, &e))
    }

    /// Reads the current marker with its version.
    fn read_marker(&self) -> Result<Option<(String, UpdateVersion)>, BlobError> {
        let store = self.store();
        let path = self.remote.path("IDENTITY");
        let wanted = path.clone();
        let got = self.remote.wait(async move {
            let got = store.get(&wanted).await?;
            let version = UpdateVersion { e_tag: got.meta.e_tag.clone(), version: got.meta.version.clone() };
            Ok((got.bytes().await?, version))
        });
        match got {
            Ok((bytes, version)) => Ok(Some((String::from_utf8_lossy(&bytes).into_owned(), version))),
            Err(e @ Error::NotFound { .. }) => match self.remote.error("read", &path, &e) {
                // The bucket does not exist either.
                no_bucket @ BlobError::Storage(_) => Err(no_bucket),
                _ => Ok(None),
            },
            Err(e) => Err(self.remote.error("read", &path, &e)),
        }
    }
}

impl Backend for Objects {
    fn stage(&self, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let part = self.0.staging.create(bytes)?;
        Ok(Box::new(StagedObject { part, objects: Arc::clone(&self.0) }))
    }

    fn stage_as(&self, name: &str, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let part = self.0.staging.create_as(name, bytes)?;
        Ok(Box::new(StagedObject { part, objects: Arc::clone(&self.0) }))
    }

    fn staged_as(&self, name: &str, read: &mut dyn FnMut(&[u8])) -> Result<Option<Box<dyn Staged>>, BlobError> {
        let part = self.0.staging.open_as(name, read)?;
        Ok(part.map(|part| -> Box<dyn Staged> { Box::new(StagedObject { part, objects: Arc::clone(&self.0) }) }))
    }

    fn unstage(&self, name: &str) -> Result<(), BlobError> {
        self.0.staging.remove(name)
    }

    fn unstage_but(&self, names: &BTreeSet<String>) -> Result<(), BlobError> {
        self.0.staging.remove_but(names)
    }

    fn read(&self, digest: Digest, from: u64) -> Result<Box<dyn Read + Send>, BlobError> {
        let end = self.0.head(digest)?.ok_or(BlobError::NotFound(digest))?.size;
        let remote = Arc::clone(&self.0.remote);
        Ok(Box::new(Ranges {
            path: remote.blob(digest),
            remote,
            at: from,
            end,
            next: FIRST_READ_BYTES,
            part: Cursor::default(),
        }))
    }

    fn stat(&self, digest: Digest) -> Result<Option<Stat>, BlobError> {
        Ok(self.0.head(digest)?.map(|meta| self.0.stat(digest, &meta)))
    }

    fn touch(&self, digest: Digest) -> Result<Stat, BlobError> {
        self.0.note(digest);
        self.stat(digest)?.ok_or(BlobError::NotFound(digest))
    }

    fn remove(&self, digest: Digest) -> Result<(), BlobError> {
        let store = self.0.store();
        let path = self.0.remote.blob(digest);
        let wanted = path.clone();
        let removing = async move {
            let late =
                || Error::Generic { store: "blobs", source: "the server did not answer the removal in time".into() };
            tokio::time::timeout(REMOVAL, store.delete(&wanted)).await.unwrap_or_else(|_| Err(late()))
        };
        match self.0.remote.wait(removing) {
            Ok(()) | Err(Error::NotFound { .. }) => drop(self.0.puts().remove(&digest)),
            Err(e) => return Err(self.0.remote.error("remove", &path, &e)),
        }
        Ok(())
    }

    /// Copies the object through this process: not every server can copy large objects itself.
    fn put_aside(&self, digest: Digest) -> Result<(), BlobError> {
        let Some(meta) = self.0.head(digest)? else { return Ok(()) };
        let aside = self.0.remote.path(&format!("quarantine/{}.{}", digest.hex(), clock::now_ms()));
        let source = self.read(digest, 0)?;
        self.0.send(&aside, meta.size, source).map_err(|e| self.0.remote.error("write", &aside, &e))?;
        self.remove(digest)?;
        tracing::warn!("blob {digest} is damaged; it was moved to `{}`", self.0.remote.shown(&aside));
        Ok(())
    }

    fn list(&self) -> Result<Vec<Entry>, BlobError> {
        let entry = |meta: &ObjectMeta| {
            let digest = self.0.remote.digest(&meta.location)?;
            Some(Entry { digest, bytes: meta.size, put_ms: self.0.put_ms(digest, meta) })
        };
        Ok(self.0.list("sha256")?.iter().filter_map(entry).collect())
    }

    fn is_empty(&self) -> Result<bool, BlobError> {
        let store = self.0.store();
        let path = self.0.remote.path("sha256");
        let wanted = path.clone();
        let first = self.0.remote.wait(async move { store.list(Some(&wanted)).try_next().await });
        first.map(|first| first.is_none()).map_err(|e| self.0.remote.error("list", &path, &e))
    }

    fn strays(&self) -> Result<Vec<String>, BlobError> {
        let staging = &self.0.staging;
        let here = staging.strays().map_err(|e| super::fs::error("list", &staging.dir, &e))?;
        let mut strays: Vec<String> = here.iter().map(|path| path.display().to_string()).collect();
        let objects = self.0.list("sha256")?;
        let objects = objects.iter().filter(|meta| self.0.remote.digest(&meta.location).is_none());
        strays.extend(objects.map(|meta| self.0.remote.shown(&meta.location)));
        Ok(strays)
    }

    fn aside(&self) -> Result<Vec<String>, BlobError> {
        Ok(self.0.list("quarantine")?.iter().map(|meta| self.0.remote.shown(&meta.location)).collect())
    }

    fn unfinished(&self) -> Result<Vec<String>, BlobError> {
        self.0.multipart.unfinished()
    }

    fn give_up_unfinished(&self) -> Result<u64, BlobError> {
        self.0.multipart.give_up()
    }

    fn problem(&self) -> Option<Problem> {
        self.0.remote.problem()
    }

    fn marker_place(&self) -> String {
        self.0.remote.shown(&self.0.remote.path("IDENTITY"))
    }

    fn marker(&self) -> Result<Option<String>, BlobError> {
        Ok(self.0.read_marker()?.map(|(text, _)| text))
    }

    /// Creates and replaces by conditional puts. Each call also tests that the server refuses a put over an existing
    /// object.
    fn set_marker(&self, old: Option<&str>, marker: &str) -> Result<bool, BlobError> {
        let path = self.0.remote.path("IDENTITY");
        let Some(old) = old else {
            if !self.0.create_marker(marker)? {
                return Ok(false);
            }
            return if self.0.create_marker(marker)? { Err(self.0.remote.no_conditions(&path)) } else { Ok(true) };
        };
        let Some((text, version)) = self.0.read_marker()?.filter(|(text, _)| text == old) else { return Ok(false) };
        if self.0.create_marker(&text)? {
            return Err(self.0.remote.no_conditions(&path));
        }
        let store = self.0.store();
        let wanted = path.clone();
        let marker = marker.to_owned();
        let put = self.0.remote.wait(async move {
            store.put_opts(&wanted, marker.into_bytes().into(), PutOptions::from(PutMode::Update(version))).await
        });
        match put {
            Ok(_) => Ok(true),
            Err(Error::Precondition { .. } | Error::AlreadyExists { .. }) => Ok(false),
            Err(e) => Err(self.0.remote.error("write", &path, &e)),
        }
    }
}

/// A blob being written to the store's folder, sent when it is complete.
#[derive(Debug)]
struct StagedObject {
    part: Part,
    objects: Arc<Inner>,
}

impl Staged for StagedObject {
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        self.part.write(bytes)
    }

    fn commit(mut self: Box<Self>, digest: Digest) -> Result<bool, BlobError> {
        fail_point!("blob::after_write");
        let here = |e: io::Error| super::fs::error("read", &self.part.path, &e);
        io::Write::flush(&mut self.part.file).map_err(here)?;
        let file = regular(OpenOptions::new().read(true), &self.part.path).map_err(here)?;
        let bytes = file.metadata().map_err(here)?.len();
        // A put in one request fails by itself if the name is taken.
        if bytes > PART_BYTES as u64 && self.objects.head(digest)?.is_some() {
            return Ok(false);
        }
        // Recorded first: a collection that sees the object must see that it is young, even if the server's clock
        // differs.
        self.objects.note(digest);
        let path = self.objects.remote.blob(digest);
        let sent = self.objects.send(&path, bytes, file).map_err(|e| self.objects.remote.error("write", &path, &e));
        fail_point!("blob::after_rename");
        sent
    }
}

/// Reads an object in ranges, one request each, so that a slow reader keeps no connection open.
struct Ranges {
    remote: Arc<Remote>,
    path: Path,
    at: u64,
    end: u64,
    /// Bytes of the next request.
    next: usize,
    part: Cursor<bytes::Bytes>,
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
