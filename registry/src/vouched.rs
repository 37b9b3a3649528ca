//! The blobs as the writer of rows sees them: a row names only what is whole, and what it names is noted while a collection is
//! under way.

use std::collections::BTreeSet;
use std::ops::Deref;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use protocol::artifact::mentioned;
use protocol::{Digest, Manifest};

use crate::WriteError;
use crate::blob::{BlobStore, ManifestError};

/// Blobs, for the writer: what rows come to name while a collection is under way is noted.
#[derive(Debug, Clone)]
pub(crate) struct Vouched {
    pub(crate) blobs: BlobStore,
    pub(crate) named: Arc<Named>,
}

impl Deref for Vouched {
    type Target = BlobStore;

    fn deref(&self) -> &BlobStore {
        &self.blobs
    }
}

/// What rows have come to name since a collection began; `None` while there is none.
#[derive(Debug, Default)]
pub(crate) struct Named(Mutex<Option<BTreeSet<Digest>>>);

impl Named {
    fn lock(&self) -> MutexGuard<'_, Option<BTreeSet<Digest>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// From here on names are noted.
    pub(crate) fn begin(&self) {
        *self.lock() = Some(BTreeSet::new());
    }

    /// From here on nothing is noted.
    pub(crate) fn end(&self) {
        *self.lock() = None;
    }

    /// Notes what a row is about to name. To be called before it is checked that the blob is there: one who finds it there
    /// keeps it.
    pub(crate) fn note(&self, digests: impl IntoIterator<Item = Digest>) {
        if let Some(named) = &mut *self.lock() {
            named.extend(digests);
        }
    }

    /// Whether a collection is under way, which is when notes are taken.
    pub(crate) fn is_noting(&self) -> bool {
        self.lock().is_some()
    }

    pub(crate) fn noted(&self) -> BTreeSet<Digest> {
        self.lock().clone().unwrap_or_default()
    }

    /// Does `remove` unless the blob has been named; nobody can name it meanwhile.
    pub(crate) fn unless_named<T>(&self, digest: Digest, remove: impl FnOnce() -> T) -> Option<T> {
        let named = self.lock();
        let is_named = named.as_ref().is_some_and(|named| named.contains(&digest));
        (!is_named).then(remove)
    }
}

/// The manifest, once all that it lists is there: before that, no row may name it.
pub(crate) fn complete(blobs: &Vouched, digest: Digest) -> Result<Manifest, WriteError> {
    if blobs.named.is_noting() {
        blobs.named.note([digest]);
        if let Ok(manifest) = blobs.manifest(digest) {
            let mut needs = manifest.files.values().map(|file| file.digest).collect();
            mentioned(&manifest.meta, &mut needs);
            blobs.named.note(needs);
        }
    }
    blobs.complete_manifest(digest).map_err(|e| match e {
        ManifestError::Blob(checkpoint::BlobError::NotFound(digest)) => WriteError::NotFound(format!(
            "blob {digest} is not in the store; upload a manifest and all that it lists before naming it"
        )),
        ManifestError::Blob(checkpoint::BlobError::Storage(message)) => WriteError::Storage(message),
        ManifestError::Blob(e) => WriteError::Internal(e.to_string()),
        ManifestError::Incomplete { .. } => {
            WriteError::NotFound(format!("{e}; upload every blob before the manifest is named"))
        }
        ManifestError::NotAManifest { .. } | ManifestError::Format { .. } => WriteError::Conflict(e.to_string()),
    })
}
