//! Access of workers to blobs: those reachable from the inputs of its task, and its own uploads for the task.
//!
//! The inputs of a task are a set of manifests. A manifest leads to the blobs that it lists and to the manifests that
//! it mentions, such as a model's parts; [`Reach`] is the set of all of them. A manifest that a worker submits may name
//! only blobs of this set and the worker's uploads, directly or through other manifests. Otherwise a worker could read
//! the blobs of another run or present them as its own.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use protocol::{Digest, Manifest};
use registry::BlobStore;
use registry::blob::ManifestError;

/// Maximum number of cached artifacts.
const REMEMBERED: usize = 1024;

/// Reachable blobs by artifact. Blobs are immutable, so a cached entry stays valid.
#[derive(Debug, Default)]
pub(crate) struct Reach(Mutex<BTreeMap<Digest, Arc<Known>>>);

#[derive(Debug, Default)]
struct Known {
    blobs: BTreeSet<Digest>,
    /// Set if a reachable blob was missing or damaged.
    has_gaps: bool,
}

impl Reach {
    /// Returns true if `wanted` is reachable from one of `roots`. Blocks.
    pub(crate) fn includes(
        &self,
        blobs: &BlobStore,
        roots: &BTreeSet<Digest>,
        wanted: Digest,
    ) -> Result<bool, BlobError> {
        if roots.contains(&wanted) {
            return Ok(true);
        }
        for root in roots {
            let known = self.lock().get(root).cloned();
            if known.as_ref().is_some_and(|known| known.blobs.contains(&wanted)) {
                return Ok(true);
            }
            if known.is_none_or(|known| known.has_gaps) && self.explore(blobs, *root)?.blobs.contains(&wanted) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn explore(&self, blobs: &BlobStore, root: Digest) -> Result<Arc<Known>, BlobError> {
        let mut found = Known::default();
        let mut queue = vec![root];
        let mut opened = BTreeSet::from([root]);
        while let Some(digest) = queue.pop() {
            found.blobs.insert(digest);
            let manifest = match open(blobs, digest)? {
                Opened::Manifest(manifest) => manifest,
                Opened::Other => continue,
                Opened::Absent => {
                    found.has_gaps = true;
                    continue;
                }
            };
            found.blobs.extend(manifest.blobs().map(|blob| blob.digest));
            queue.extend(followed(&manifest).into_iter().filter(|next| opened.insert(*next)));
        }
        let found = Arc::new(found);
        let mut known = self.lock();
        if known.len() >= REMEMBERED {
            known.pop_first();
        }
        known.insert(root, Arc::clone(&found));
        Ok(found)
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Digest, Arc<Known>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A blob that the manifest `digest` names, directly or through others, and that its worker neither uploaded nor
    /// may read. Blocks.
    pub(crate) fn foreign(
        &self,
        blobs: &BlobStore,
        roots: &BTreeSet<Digest>,
        is_uploaded: impl Fn(Digest) -> bool,
        digest: Digest,
    ) -> Result<Option<Digest>, BlobError> {
        let mut seen = BTreeSet::from([digest]);
        let mut queue = vec![digest];
        while let Some(next) = queue.pop() {
            if !is_uploaded(next) {
                if self.includes(blobs, roots, next)? {
                    continue;
                }
                return Ok(Some(next));
            }
            let Opened::Manifest(manifest) = open(blobs, next)? else { continue };
            for blob in manifest.blobs() {
                if !is_uploaded(blob.digest) && !self.includes(blobs, roots, blob.digest)? {
                    return Ok(Some(blob.digest));
                }
            }
            for other in followed(&manifest) {
                // A digest that is not a blob's, such as that of a dataset's source folder, leads nowhere.
                let leads_somewhere = is_uploaded(other) || blobs.exists(other)?;
                if leads_somewhere && seen.insert(other) {
                    queue.push(other);
                }
            }
        }
        Ok(None)
    }
}

/// Blobs of `manifest` that may be manifests themselves.
fn followed(manifest: &Manifest) -> Vec<Digest> {
    let mut followed = manifest.mentions();
    let parts = manifest.files.iter().filter(|(name, _)| name.ends_with("manifest.json"));
    followed.extend(parts.map(|(_, file)| file.digest));
    followed
}

/// A blob that may be a manifest.
enum Opened {
    Manifest(Manifest),
    /// A blob that is not a manifest.
    Other,
    /// Missing or damaged; it may be recomputed.
    Absent,
}

fn open(blobs: &BlobStore, digest: Digest) -> Result<Opened, BlobError> {
    match blobs.manifest(digest) {
        Ok(manifest) => Ok(Opened::Manifest(manifest)),
        Err(ManifestError::Blob(error @ (BlobError::Storage(_) | BlobError::Unavailable(_)))) => Err(error),
        Err(ManifestError::Blob(_)) => Ok(Opened::Absent),
        Err(_) => Ok(Opened::Other),
    }
}
