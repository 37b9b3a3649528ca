//! Proofs that artifacts are whole. A row names only proven artifacts. The writer sends no request to the blobs'
//! backend: proving happens before its transaction ([`Store::prove`](crate::Store::prove)), however slow the backend
//! is.
//!
//! A proof holds until a collection condemns one of the artifact's blobs. Naming and condemning both happen in the
//! writer, one after the other:
//!
//! | first | then | result |
//! |---|---|---|
//! | a row names the artifact | the collection wants one of its blobs | the blob stays, because its name is recorded |
//! | the collection condemns a blob | a row wants to name the artifact | the row is refused and the artifact proven again |
//!
//! A blob counts as condemned for every proof that began before its removal had ended.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use protocol::{ArtifactKind, Digest, Manifest};

use crate::WriteError;
use crate::catalog::References;
use crate::lease::{LeaseCheck, NoLease};

/// Facts about an artifact that rows need.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Artifact {
    pub(crate) kind: ArtifactKind,
    /// Its blobs with their lengths, the manifest included.
    pub(crate) blobs: BTreeMap<Digest, u64>,
    /// Total bytes of its files.
    pub(crate) bytes: u64,
    pub(crate) references: References,
}

impl Artifact {
    /// Reads the facts from a manifest with digest `digest` and length `own`.
    pub(crate) fn of(digest: Digest, own: u64, manifest: &Manifest) -> Self {
        let files = manifest.blobs().map(|blob| (blob.digest, blob.bytes));
        Self {
            kind: manifest.kind,
            bytes: manifest.files.values().map(|file| file.bytes).sum(),
            blobs: files.chain([(digest, own)]).collect(),
            references: References::of(manifest),
        }
    }
}

/// Proven artifacts, condemned blobs, and names that rows have used since a collection began.
#[derive(Debug, Default)]
pub(crate) struct Proofs {
    inner: Mutex<Inner>,
    /// The lease, if the blobs need one; without a valid lease no artifact may be named.
    lease: Option<LeaseCheck>,
}

#[derive(Debug, Default)]
struct Inner {
    /// Number of removals that have ended.
    removals: u64,
    proven: HashMap<Digest, Proven>,
    /// Number of running proofs by the removals that had ended at their start.
    begun: BTreeMap<u64, usize>,
    /// Condemned blobs with the number of removals that had ended with theirs; `None` while it runs.
    condemned: HashMap<Digest, Option<u64>>,
    /// `None` while no collection runs.
    named: Option<Names>,
}

#[derive(Debug)]
struct Proven {
    artifact: Arc<Artifact>,
    since: u64,
    proofs: usize,
}

/// Names that rows have used since a collection began.
#[derive(Debug, Default)]
struct Names {
    blobs: BTreeSet<Digest>,
    /// Names whose references the collection has not followed yet.
    to_follow: Vec<Digest>,
}

impl Inner {
    fn is_condemned(&self, artifact: &Artifact, since: u64) -> bool {
        let condemned = |digest: &Digest| self.condemned.get(digest);
        artifact.blobs.keys().filter_map(condemned).any(|ended| ended.is_none_or(|ended| ended > since))
    }
}

impl Proofs {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts without proofs. Naming needs a valid lease if one is given.
    pub(crate) fn new(lease: Option<LeaseCheck>) -> Self {
        Self { lease, ..Self::default() }
    }

    /// Starts a proof. Blobs found after it count unless they are condemned.
    pub(crate) fn begin(self: &Arc<Self>) -> Begun {
        let mut inner = self.lock();
        let since = inner.removals;
        *inner.begun.entry(since).or_default() += 1;
        Begun { proofs: Arc::clone(self), since }
    }

    /// Returns the proven artifact that a row is about to name, and protects it from a running collection.
    pub(crate) fn name(&self, digest: Digest) -> Result<Arc<Artifact>, WriteError> {
        if let Some(lease) = &self.lease {
            lease.check().map_err(|e| match e {
                NoLease::RunOut { .. } => WriteError::Unreachable(e.to_string()),
                NoLease::Taken { .. } => WriteError::Storage(e.to_string()),
            })?;
        }
        let mut inner = self.lock();
        let proven = inner.proven.get(&digest).ok_or(WriteError::Unproven { artifact: digest })?;
        let artifact = Arc::clone(&proven.artifact);
        if inner.is_condemned(&artifact, proven.since) {
            return Err(WriteError::Unproven { artifact: digest });
        }
        if let Some(names) = &mut inner.named {
            names.blobs.extend(artifact.blobs.keys().chain(&artifact.references.mentioned));
            names.to_follow.extend(&artifact.references.mentioned);
        }
        Ok(artifact)
    }

    /// Protects digests that a row is about to name from a running collection, even if their blobs are missing.
    pub(crate) fn note(&self, digests: impl IntoIterator<Item = Digest>) {
        if let Some(names) = &mut self.lock().named {
            for digest in digests {
                names.blobs.insert(digest);
                names.to_follow.push(digest);
            }
        }
    }

    /// Starts to record names for a collection.
    pub(crate) fn begin_collection(&self) {
        self.lock().named = Some(Names::default());
    }

    /// Ends the recording.
    pub(crate) fn end_collection(&self) {
        self.lock().named = None;
    }

    /// Takes the recorded names whose references were not followed yet.
    pub(crate) fn to_follow(&self) -> Vec<Digest> {
        self.lock().named.as_mut().map(|names| std::mem::take(&mut names.to_follow)).unwrap_or_default()
    }

    /// Condemns those of `digests` that no row has named, and returns them. The caller must report each as
    /// [`removed`](Self::removed).
    pub(crate) fn condemn(&self, digests: &[Digest]) -> Vec<Digest> {
        let mut inner = self.lock();
        let is_named = |digest: &Digest| inner.named.as_ref().is_some_and(|names| names.blobs.contains(digest));
        let taken: Vec<Digest> = digests.iter().filter(|digest| !is_named(digest)).copied().collect();
        inner.condemned.extend(taken.iter().map(|digest| (*digest, None)));
        taken
    }

    /// Ends the removal of condemned blobs, even if it failed. Proofs that start later count again.
    pub(crate) fn removed(&self, digests: &[Digest]) {
        let mut inner = self.lock();
        inner.removals += 1;
        let now = inner.removals;
        inner.condemned.extend(digests.iter().map(|digest| (*digest, Some(now))));
        let oldest = inner.begun.keys().next().copied().unwrap_or(now);
        inner.condemned.retain(|_, ended| ended.is_none_or(|ended| ended > oldest));
    }
}

/// A running proof.
#[derive(Debug)]
pub(crate) struct Begun {
    proofs: Arc<Proofs>,
    since: u64,
}

impl Begun {
    /// Completes the proof of a whole artifact.
    pub(crate) fn found(self, digest: Digest, artifact: Artifact) -> Proof {
        let artifact = Arc::new(artifact);
        {
            let mut inner = self.proofs.lock();
            let fresh = || Proven { artifact: Arc::clone(&artifact), since: self.since, proofs: 0 };
            let proven = inner.proven.entry(digest).or_insert_with(fresh);
            proven.proofs += 1;
            proven.since = proven.since.max(self.since);
        }
        Proof { digest, begun: self }
    }
}

impl Drop for Begun {
    fn drop(&mut self) {
        let mut inner = self.proofs.lock();
        if let Some(count) = inner.begun.get_mut(&self.since) {
            *count -= 1;
            if *count == 0 {
                inner.begun.remove(&self.since);
            }
        }
    }
}

/// Proof that an artifact is whole. A row may name it while this value lives.
#[derive(Debug)]
#[must_use = "a row may name the artifact only while this value lives"]
pub struct Proof {
    digest: Digest,
    begun: Begun,
}

impl Drop for Proof {
    fn drop(&mut self) {
        let mut inner = self.begun.proofs.lock();
        if let Some(proven) = inner.proven.get_mut(&self.digest) {
            proven.proofs -= 1;
            if proven.proofs == 0 {
                inner.proven.remove(&self.digest);
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    fn artifact(digest: Digest, file: Digest) -> Artifact {
        let blobs = [(digest, 1), (file, 2)].into();
        Artifact { kind: ArtifactKind::Vae, blobs, bytes: 2, references: References::default() }
    }

    fn is_unproven(proofs: &Proofs, digest: Digest) -> bool {
        matches!(proofs.name(digest), Err(WriteError::Unproven { artifact }) if artifact == digest)
    }

    /// Tests the table of the header, and a proof that began before the end of a removal.
    #[test]
    fn a_name_keeps_a_blob_and_a_condemned_blob_takes_the_proof() {
        let proofs = Arc::new(Proofs::default());
        let digest = Digest::of(b"manifest");
        let file = Digest::of(b"file");
        assert!(is_unproven(&proofs, digest));
        let proof = proofs.begin().found(digest, artifact(digest, file));
        proofs.begin_collection();
        assert_eq!(proofs.name(digest).unwrap().bytes, 2);
        assert!(proofs.condemn(&[file, digest]).is_empty(), "a row names them");
        proofs.end_collection();

        proofs.begin_collection();
        assert_eq!(proofs.condemn(&[file]), [file]);
        assert!(is_unproven(&proofs, digest));
        let during = proofs.begin().found(digest, artifact(digest, file));
        assert!(is_unproven(&proofs, digest), "the removal goes on");
        let cut = proofs.begin();
        proofs.removed(&[file]);
        assert!(is_unproven(&proofs, digest), "both began before its end");
        drop((proof, during));
        let late = cut.found(digest, artifact(digest, file));
        assert!(is_unproven(&proofs, digest), "it may have looked before the removal");
        let after = proofs.begin().found(digest, artifact(digest, file));
        assert!(proofs.name(digest).is_ok());
        drop((late, after));
        assert!(is_unproven(&proofs, digest));
        proofs.removed(&[]);
        assert!(proofs.lock().condemned.is_empty() && proofs.lock().begun.is_empty(), "nothing is kept for nobody");
    }
}
