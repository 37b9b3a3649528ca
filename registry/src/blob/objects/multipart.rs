//! Uploads in parts, for blobs that are too large for one request.
//!
//! The parts appear as one object at the end of the upload. That end cannot be conditional on every server and need not
//! be, because equal names mean equal bytes. A failed part is sent again by itself.
//!
//! An upload that never ends keeps its parts, which no listing of objects shows and the bucket's owner pays for. So a
//! record beside the blobs (`PREFIX/uploads/...`) names each upload: it is written before the first part and deleted
//! after the end. A record that belongs to no call of this process was left by a process that was killed, on this
//! machine or another one. A collection ends these uploads. It holds the lease, so their processes write no more.

use std::collections::BTreeSet;
use std::io::{self, Read};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use futures::TryStreamExt as _;
use object_store::multipart::PartId;
use object_store::path::Path;
use object_store::{Error, ObjectStoreExt as _, PutPayload};
use protocol::Digest;
use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use super::remote::{Bucket, LOCAL, Remote};
use crate::clock;

/// Bytes sent in one request. With the limit of 10,000 parts an object may have 80 GB.
pub(super) const PART_BYTES: usize = 8 << 20;

/// Content of a record.
#[derive(Debug, Serialize, Deserialize)]
struct Unfinished {
    /// Path of the object in the bucket.
    object: String,
    /// The server's name for the upload.
    upload: String,
    /// Start of the upload, in milliseconds since 1970.
    begun_ms: i64,
}

/// Sender of large objects. Clones share it.
#[derive(Debug, Clone)]
pub(super) struct Multipart {
    remote: Arc<Remote>,
    /// Free room for requests under way, in KiB.
    room: Arc<Semaphore>,
    /// Records of this process's uploads.
    own: Arc<Mutex<BTreeSet<Path>>>,
}

/// A record of this process until it is dropped.
struct Own {
    all: Arc<Mutex<BTreeSet<Path>>>,
    record: Path,
}

impl Drop for Own {
    fn drop(&mut self) {
        lock(&self.all).remove(&self.record);
    }
}

fn lock(own: &Mutex<BTreeSet<Path>>) -> MutexGuard<'_, BTreeSet<Path>> {
    own.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Multipart {
    pub(super) fn new(remote: Arc<Remote>, room: Arc<Semaphore>) -> Self {
        Self { remote, room, own: Arc::default() }
    }

    /// Sends an object in parts of [`PART_BYTES`] bytes.
    pub(super) async fn send(self, object: Path, source: impl Read + Send + 'static) -> Result<(), Error> {
        let store = Arc::clone(&self.remote.store);
        let upload = store.create_multipart(&object).await?;
        let name = Digest::of(format!("{object}\n{upload}").as_bytes()).hex();
        let record = self.remote.path(&format!("uploads/{name}"));
        lock(&self.own).insert(record.clone());
        let own = Own { all: Arc::clone(&self.own), record: record.clone() };
        let content = Unfinished { object: object.to_string(), upload, begun_ms: clock::now_ms() };
        let written = match serde_json::to_vec(&content) {
            Ok(text) => store.put(&record, text.into()).await.map(|_| ()),
            Err(e) => Err(local(io::Error::other(e))),
        };
        let sent = match written {
            Ok(()) => self.send_parts(&object, &content.upload, source).await,
            Err(e) => Err(e),
        };
        let ended = match &sent {
            Ok(()) => store.delete(&record).await,
            Err(_) => end(&*store, &object, &content.upload, &record).await,
        };
        if let Err(error) = ended {
            // The error of the upload matters more.
            let object = self.remote.shown(&object);
            tracing::warn!(%error, "the parts of `{object}` may occupy space until the next collection");
        }
        drop(own);
        sent
    }

    async fn send_parts(
        &self,
        object: &Path,
        upload: &str,
        mut source: impl Read + Send + 'static,
    ) -> Result<(), Error> {
        let mut under_way = JoinSet::new();
        let mut done: Vec<(usize, PartId)> = Vec::new();
        for number in 0.. {
            let room = Arc::clone(&self.room).acquire_many_owned(kib(PART_BYTES)).await;
            let room = room.map_err(|e| local(io::Error::other(e)))?;
            let (read, rest) = tokio::task::spawn_blocking(move || (read_part(&mut source), source)).await?;
            source = rest;
            let part = read.map_err(local)?;
            if part.is_empty() {
                break;
            }
            let store = Arc::clone(&self.remote.store);
            let object = object.clone();
            let upload = upload.to_owned();
            under_way.spawn(async move {
                let put = store.put_part(&object, &upload, number, PutPayload::from(part)).await;
                drop(room);
                put.map(|part| (number, part))
            });
            while let Some(part) = under_way.try_join_next() {
                done.push(part??);
            }
        }
        while let Some(part) = under_way.join_next().await {
            done.push(part??);
        }
        done.sort_by_key(|(number, _)| *number);
        let parts = done.into_iter().map(|(_, part)| part).collect();
        self.remote.store.complete_multipart(object, &upload.to_owned(), parts).await.map(|_| ())
    }

    /// Reads the records that belong to no upload of this process.
    fn left(&self) -> Result<Vec<(Path, Option<Unfinished>)>, BlobError> {
        let store = Arc::clone(&self.remote.store);
        let folder = self.remote.path("uploads");
        let wanted = folder.clone();
        let own = Arc::clone(&self.own);
        let read = self.remote.wait(async move {
            let listed: Vec<_> = store.list(Some(&wanted)).try_collect().await?;
            let mut left = Vec::new();
            for meta in listed {
                if lock(&own).contains(&meta.location) {
                    continue;
                }
                match async { store.get(&meta.location).await?.bytes().await }.await {
                    Ok(text) => left.push((meta.location, serde_json::from_slice(&text).ok())),
                    // The upload ended since the listing.
                    Err(Error::NotFound { .. }) => {}
                    Err(e) => return Err(e),
                }
            }
            Ok(left)
        });
        read.map_err(|e| self.remote.error("list", &folder, &e))
    }

    /// Describes the uploads that have not ended, without this process's own.
    pub(super) fn unfinished(&self) -> Result<Vec<String>, BlobError> {
        let mut described = Vec::new();
        for (record, content) in self.left()? {
            described.push(match content {
                Some(content) => {
                    let object = self.remote.shown(&Path::from(content.object));
                    let begun = clock::format_ms(content.begun_ms);
                    format!("an upload in parts to `{object}` began at {begun} and has not ended")
                }
                None => format!("`{}` is not the record of an upload and is left alone", self.remote.shown(&record)),
            });
        }
        Ok(described)
    }

    /// Ends the uploads of other processes and returns their number.
    pub(super) fn give_up(&self) -> Result<u64, BlobError> {
        let mut ended = 0;
        for (record, content) in self.left()? {
            let Some(Unfinished { object, upload, .. }) = content else { continue };
            let store = Arc::clone(&self.remote.store);
            let object = Path::from(object);
            let of = object.clone();
            let at = record.clone();
            let done = self.remote.wait(async move { end(&*store, &of, &upload, &at).await });
            done.map_err(|e| self.remote.error("end the upload of", &object, &e))?;
            ended += 1;
        }
        Ok(ended)
    }
}

/// Deletes the parts of an upload, then its record. An upload that has ended has no parts.
async fn end(store: &dyn Bucket, object: &Path, upload: &str, record: &Path) -> Result<(), Error> {
    match store.abort_multipart(object, &upload.to_owned()).await {
        Ok(()) | Err(Error::NotFound { .. }) => {}
        Err(e) => return Err(e),
    }
    match store.delete(record).await {
        Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
        Err(e) => Err(e),
    }
}

/// Returns the room that bytes take among those under way, in KiB.
pub(super) fn kib(bytes: usize) -> u32 {
    u32::try_from(bytes.div_ceil(1 << 10).max(1)).unwrap_or(u32::MAX)
}

pub(super) fn local(source: io::Error) -> Error {
    Error::Generic { store: LOCAL, source: source.into() }
}

pub(super) fn read_part(source: &mut impl Read) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    source.take(PART_BYTES as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}
