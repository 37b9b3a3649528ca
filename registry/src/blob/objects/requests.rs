//! Requests on a bucket that several calls of the backend make.

use std::collections::HashMap;
use std::io::{Cursor, Read};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::{Error, ObjectMeta, ObjectStoreExt as _, PutMode, PutOptions, PutPayload, UpdateVersion};
use protocol::Digest;
use tokio::sync::Semaphore;

use super::multipart::{Multipart, PART_BYTES, kib, local, read_part};
use super::remote::{Bucket, Remote};
use crate::blob::Stat;
use crate::blob::staging::Staging;
use crate::clock;

/// Number of parts under way at once, over all blobs, or as many bytes of small ones. Bounds the memory for sending.
pub(super) const PARTS: usize = 4;

/// Time after which a blob that a worker has sent is no longer expected to be used.
const ABANDONED_MS: i64 = 24 * 3600 * 1000;

#[derive(Debug)]
pub(super) struct Inner {
    pub(super) remote: Arc<Remote>,
    pub(super) staging: Staging,
    /// Times of this process's puts, in milliseconds since 1970.
    pub(super) puts: Mutex<HashMap<Digest, i64>>,
    pub(super) multipart: Multipart,
    /// Free room for requests under way, in KiB.
    pub(super) parts: Arc<Semaphore>,
}

impl Inner {
    pub(super) fn store(&self) -> Arc<dyn Bucket> {
        Arc::clone(&self.remote.store)
    }

    pub(super) fn head(&self, digest: Digest) -> Result<Option<ObjectMeta>, BlobError> {
        let store = self.store();
        let path = self.remote.blob(digest);
        let wanted = path.clone();
        match self.remote.wait(async move { store.head(&wanted).await }) {
            Ok(meta) => Ok(Some(meta)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(e) => Err(self.remote.error("read the metadata of", &path, &e)),
        }
    }

    pub(super) fn stat(&self, digest: Digest, meta: &ObjectMeta) -> Stat {
        let tag = meta.e_tag.as_deref().unwrap_or("-").replace(char::is_whitespace, "_");
        let stamp = format!("{}-{tag}-{}", meta.size, meta.last_modified.timestamp());
        Stat { bytes: meta.size, put_ms: self.put_ms(digest, meta), stamp }
    }

    pub(super) fn put_ms(&self, digest: Digest, meta: &ObjectMeta) -> i64 {
        self.puts().get(&digest).copied().unwrap_or_else(|| meta.last_modified.timestamp_millis())
    }

    pub(super) fn puts(&self) -> MutexGuard<'_, HashMap<Digest, i64>> {
        self.puts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn note(&self, digest: Digest) {
        self.puts().insert(digest, clock::now_ms());
    }

    pub(super) fn list(&self, folder: &str) -> Result<Vec<ObjectMeta>, BlobError> {
        let store = self.store();
        let path = self.remote.path(folder);
        let wanted = path.clone();
        let listed = self.remote.wait(async move { store.list(Some(&wanted)).try_collect().await });
        listed.map_err(|e| self.remote.error("list", &path, &e))
    }

    /// Lists the blobs that were sent by a signed request and not used within [`ABANDONED_MS`].
    pub(super) fn abandoned(&self) -> Result<Vec<Path>, BlobError> {
        let before = clock::now_ms() - ABANDONED_MS;
        let sent = self.list("arriving")?.into_iter();
        Ok(sent.filter(|meta| meta.last_modified.timestamp_millis() < before).map(|meta| meta.location).collect())
    }

    /// Sends `bytes` bytes, in one request if they are few. Returns `false` if the name was taken.
    pub(super) fn send(&self, path: &Path, bytes: u64, mut source: impl Read + Send + 'static) -> Result<bool, Error> {
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
    pub(super) fn create_marker(&self, marker: &str) -> Result<bool, BlobError> {
        let path = self.remote.path("IDENTITY");
        self.send(&path, 0, Cursor::new(marker.to_owned())).map_err(|e| self.remote.error("write", &path, &e))
    }

    /// Reads the current marker with its version.
    pub(super) fn read_marker(&self) -> Result<Option<(String, UpdateVersion)>, BlobError> {
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
