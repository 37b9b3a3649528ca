//! The backend over a bucket.

use std::collections::BTreeSet;
use std::io::{self, Read};
use std::path::Path as FilePath;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use checkpoint::BlobError;
use futures::TryStreamExt as _;
use object_store::{Error, ObjectStoreExt as _, PutMode, PutOptions};
use protocol::Digest;
use protocol::proof::SignedRequest;
use tokio::sync::Semaphore;

use super::multipart::{Multipart, PART_BYTES};
use super::ranges::Ranges;
use super::remote::Remote;
use super::requests::{Inner, PARTS};
use super::staged::StagedObject;
use crate::blob::disk::Os;
use crate::blob::staging::Staging;
use crate::blob::{Backend, Entry, Problem, Staged, Stat};
use crate::clock;
use crate::failpoints::fail_point;

/// Time limit of a removal. It starts under a lease and must end before another process can take the lease.
const REMOVAL: Duration = Duration::from_secs(10);

/// Backend that stores blobs in an object store.
#[derive(Debug)]
pub struct Objects(Arc<Inner>);

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
        let path = remote.blob(digest);
        Ok(Box::new(Ranges::new(remote, path, from, end)))
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
            let removed = tokio::time::timeout(REMOVAL, store.delete(&wanted)).await;
            removed.unwrap_or_else(|_| {
                Err(Error::Generic { store: "blobs", source: "the server did not answer the removal in time".into() })
            })
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
        let mut entries = Vec::new();
        for meta in self.0.list("sha256")? {
            let Some(digest) = self.0.remote.digest(&meta.location) else { continue };
            entries.push(Entry { digest, bytes: meta.size, put_ms: self.0.put_ms(digest, &meta) });
        }
        Ok(entries)
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
        let here = staging.strays().map_err(|e| crate::blob::fs::error("list", &staging.dir, &e))?;
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
        let mut found = self.0.multipart.unfinished()?;
        found.extend(
            self.0.abandoned()?.iter().map(|path| format!("`{}` was sent and never used", self.0.remote.shown(path))),
        );
        Ok(found)
    }

    fn give_up_unfinished(&self) -> Result<u64, BlobError> {
        let abandoned = self.0.abandoned()?;
        for path in &abandoned {
            self.0.remote.forget(path)?;
        }
        Ok(self.0.multipart.give_up()? + abandoned.len() as u64)
    }

    fn sign_read(&self, digest: Digest) -> Option<SignedRequest> {
        self.0.remote.sign_read(&self.0.remote.blob(digest))
    }

    fn sign_write(&self, name: &str, digest: Digest) -> Option<SignedRequest> {
        let remote = &self.0.remote;
        if remote.takes_signed_puts() { remote.sign_write(name, digest) } else { None }
    }

    fn has_arrived(&self, name: &str, digest: Digest) -> bool {
        self.0.remote.attests(&self.0.remote.arriving(name), name, digest)
    }

    fn settle(&self, name: &str, digest: Digest) -> Result<Stat, BlobError> {
        let store = self.0.store();
        let (from, to) = (self.0.remote.arriving(name), self.0.remote.blob(digest));
        let path = to.clone();
        let copied = self.0.remote.wait_long(async move { store.copy(&from, &to).await });
        copied.map_err(|e| self.0.remote.error("copy a sent blob to", &path, &e))?;
        fail_point!("blob::after_rename");
        self.touch(digest)
    }

    fn forget_arrived(&self, name: &str) -> Result<(), BlobError> {
        self.0.remote.forget(&self.0.remote.arriving(name))
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
