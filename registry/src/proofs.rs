//! Artifacts that were found whole, for the writer of rows. A row names only such, and the writer asks no place for blobs: that is
//! done before its transaction ([`Store::prove`](crate::Store::prove)), however long the place takes to answer.
//!
//! A proof holds until a collection condemns one of the artifact's blobs. Both happen in the writer, one after the other:
//!
//! | first | then | so |
//! |---|---|---|
//! | a row names the artifact | the collection wants one of its blobs | the blob stays, for the name is noted |
//! | the collection condemns a blob | a row wants to name the artifact | the row is refused as unproven, and proven anew |
//!
//! A blob counts as condemned for every proof that began before its removal had ended.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use protocol::artifact::mentioned;
use protocol::{ArtifactKind, Digest, Manifest};

use crate::WriteError;
use crate::lease::{LeaseCheck, NoLease};

/// An artifact as rows need to know it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Artifact {
    pub(crate) kind: ArtifactKind,
    /// Its blobs with their lengths, the manifest among them.
    pub(crate) blobs: BTreeMap<Digest, u64>,
    /// Bytes of its files.
    pub(crate) bytes: u64,
    /// Digests in the manifest's own words.
    pub(crate) mentioned: Vec<Digest>,
}

impl Artifact {
    /// What `manifest`, which is called `digest` and has `own` bytes, lists.
    pub(crate) fn of(digest: Digest, own: u64, manifest: &Manifest) -> Self {
        let mut found = Vec::new();
        mentioned(&manifest.meta, &mut found);
        let files = manifest.files.values().map(|file| (file.digest, file.bytes));
        Self {
            kind: manifest.kind,
            bytes: files.clone().map(|(_, bytes)| bytes).sum(),
            blobs: files.chain([(digest, own)]).collect(),
            mentioned: found,
        }
    }
}

/// What is proven, what a collection has condemned, and what rows have come to name since it began.
#[derive(Debug, Default)]
pub(crate) struct Proofs {
    inner: Mutex<Inner>,
    /// Without it nothing may be named.
    lease: Option<LeaseCheck>,
}

#[derive(Debug, Default)]
struct Inner {
    /// Removals that have ended.
    removals: u64,
    proven: HashMap<Digest, Proven>,
    /// How many proofs began after each number of removals.
    begun: BTreeMap<u64, usize>,
    /// Condemned blobs: how many removals had ended with theirs, `None` while it goes on.
    condemned: HashMap<Digest, Option<u64>>,
    /// `None` while there is no collection.
    named: Option<Names>,
}

#[derive(Debug)]
struct Proven {
    artifact: Arc<Artifact>,
    since: u64,
    proofs: usize,
}

/// What rows have come to name since a collection began.
#[derive(Debug, Default)]
struct Names {
    blobs: BTreeSet<Digest>,
    /// Those of them whose own needs a collection has yet to follow.
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

    /// Nothing is proven; what is may be named under a lease, if there is one to have.
    pub(crate) fn new(lease: Option<LeaseCheck>) -> Self {
        Self { lease, ..Self::default() }
    }

    /// A proof begins: what is found from here on counts unless it is condemned.
    pub(crate) fn begin(self: &Arc<Self>) -> Begun {
        let mut inner = self.lock();
        let since = inner.removals;
        *inner.begun.entry(since).or_default() += 1;
        Begun { proofs: Arc::clone(self), since }
    }

    /// The artifact that a row is about to name, which is kept from a collection under way.
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
            names.blobs.extend(artifact.blobs.keys().chain(&artifact.mentioned));
            names.to_follow.extend(&artifact.mentioned);
        }
        Ok(artifact)
    }

    /// Keeps what a row is about to name from a collection under way, whether or not it is there.
    pub(crate) fn note(&self, digests: impl IntoIterator<Item = Digest>) {
        if let Some(names) = &mut self.lock().named {
            for digest in digests {
                names.blobs.insert(digest);
                names.to_follow.push(digest);
            }
        }
    }

    /// A collection begins: from here on names are noted.
    pub(crate) fn begin_collection(&self) {
        self.lock().named = Some(Names::default());
    }

    /// From here on nothing is noted.
    pub(crate) fn end_collection(&self) {
        self.lock().named = None;
    }

    /// What rows have come to name whose own needs were not followed yet.
    pub(crate) fn to_follow(&self) -> Vec<Digest> {
        self.lock().named.as_mut().map(|names| std::mem::take(&mut names.to_follow)).unwrap_or_default()
    }

    /// Condemns those of `digests` that no row has come to name; returns them. Each is [`removed`](Self::removed) in the end.
    pub(crate) fn condemn(&self, digests: &[Digest]) -> Vec<Digest> {
        let mut inner = self.lock();
        let is_named = |digest: &Digest| inner.named.as_ref().is_some_and(|names| names.blobs.contains(digest));
        let taken: Vec<Digest> = digests.iter().filter(|digest| !is_named(digest)).copied().collect();
        inner.condemned.extend(taken.iter().map(|digest| (*digest, None)));
        taken
    }

    /// The removal of condemned blobs has ended, whether or not it succeeded: what is found from here on counts.
    pub(crate) fn removed(&self, digests: &[Digest]) {
        let mut inner = self.lock();
        inner.removals += 1;
        let now = inner.removals;
        inner.condemned.extend(digests.iter().map(|digest| (*digest, Some(now))));
        let oldest = inner.begun.keys().next().copied().unwrap_or(now);
        inner.condemned.retain(|_, ended| ended.is_none_or(|ended| ended > oldest));
    }
}

/// A proof under way.
#[derive(Debug)]
pub(crate) struct Begun {
    proofs: Arc<Proofs>,
    since: u64,
}

impl Begun {
    /// It was found whole.
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

/// An artifact was found whole: as long as this lives, a row may name it.
#[derive(Debug)]
#[must_use = "a row may name the artifact only as long as this lives"]
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
        Artifact { kind: ArtifactKind::Vae, blobs, bytes: 2, mentioned: Vec::new() }
    }

    fn is_unproven(proofs: &Proofs, digest: Digest) -> bool {
        matches!(proofs.name(digest), Err(WriteError::Unproven { artifact }) if artifact == digest)
    }

    /// The table of the header, and a proof that began before the end of a removal.
    #[test]
    fn a_name_keeps_a_blob_and_a_condemned_blob_takes_the_proof() {
        let proofs = Arc::new(Proofs::default());
        let (digest, file) = (Digest::of(b"manifest"), Digest::of(b"file"));
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
