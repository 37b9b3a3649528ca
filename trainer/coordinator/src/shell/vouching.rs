//! Blobs that a worker may read and name: those of what its task reads, and those that it uploaded for the task itself.
//!
//! What a task reads is a set of manifests. A reader of one comes to the blobs that it lists and to the manifests that it mentions, such as a
//! model's parts; [`Reach`] is the set of all of them. A manifest that a worker hands in may name no more than that and its own
//! uploads, whatever it mentions included: else it would be a way to read another run's blobs, or to give them out as one's own.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use protocol::{Digest, Manifest};
use registry::BlobStore;
use registry::blob::ManifestError;

/// How many artifacts' reaches are remembered.
const REMEMBERED: usize = 1024;

/// Blobs that readers of artifacts come to, by artifact. A blob never changes, so what is known once stays true.
#[derive(Debug, Default)]
pub(crate) struct Reach(Mutex<BTreeMap<Digest, Arc<Known>>>);

#[derive(Debug, Default)]
struct Known {
    blobs: BTreeSet<Digest>,
    /// Something that it may lead to was not there, or damaged.
    has_gaps: bool,
}

impl Reach {
    /// Whether a reader of one of `roots` comes to `wanted`. Blocks.
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
        let (mut found, mut queue) = (Known::default(), vec![root]);
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
            found.blobs.extend(manifest.files.values().map(|file| file.digest));
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

    /// A blob that the manifest `digest` names, itself or through others, and that its maker neither uploaded nor reads. Blocks.
    pub(crate) fn foreign(
        &self,
        blobs: &BlobStore,
        roots: &BTreeSet<Digest>,
        is_uploaded: impl Fn(Digest) -> bool,
        digest: Digest,
    ) -> Result<Option<Digest>, BlobError> {
        let (mut seen, mut queue) = (BTreeSet::from([digest]), vec![digest]);
        while let Some(next) = queue.pop() {
            if !is_uploaded(next) {
                if self.includes(blobs, roots, next)? {
                    continue;
                }
                return Ok(Some(next));
            }
            let Opened::Manifest(manifest) = open(blobs, next)? else { continue };
            for file in manifest.files.values() {
                if !is_uploaded(file.digest) && !self.includes(blobs, roots, file.digest)? {
                    return Ok(Some(file.digest));
                }
            }
            for other in followed(&manifest) {
                // A digest of something else than a blob, such as of the folder that a dataset came from, leads nowhere.
                let leads_somewhere = is_uploaded(other) || blobs.exists(other)?;
                if leads_somewhere && seen.insert(other) {
                    queue.push(other);
                }
            }
        }
        Ok(None)
    }
}

/// Blobs that a reader of `manifest` may take for manifests in their turn.
fn followed(manifest: &Manifest) -> Vec<Digest> {
    let mut followed = manifest.mentions();
    let parts = manifest.files.iter().filter(|(name, _)| name.ends_with("manifest.json"));
    followed.extend(parts.map(|(_, file)| file.digest));
    followed
}

/// A blob as far as it may be a manifest.
enum Opened {
    Manifest(Manifest),
    /// Something else, which leads nowhere.
    Other,
    /// Missing or damaged; it may be made again.
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
