//! Receipts of an attempt's uploads, and the selection of those that a manifest needs.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;

use protocol::{Digest, Manifest};

use crate::event_count::lock;

/// Receipts by blob.
#[derive(Debug, Default)]
pub(crate) struct Receipts(Mutex<Held>);

#[derive(Debug, Default)]
struct Held {
    receipts: BTreeMap<Digest, String>,
    /// Digests of the blobs and mentions of each uploaded manifest.
    named: BTreeMap<Digest, Vec<Digest>>,
}

impl Receipts {
    pub(crate) fn of(&self, digest: Digest) -> Option<String> {
        lock(&self.0).receipts.get(&digest).cloned()
    }

    /// Keeps the receipt of an upload. Blobs of inputs have none.
    pub(crate) fn keep(&self, digest: Digest, receipt: Option<String>) {
        if let Some(receipt) = receipt {
            lock(&self.0).receipts.insert(digest, receipt);
        }
    }

    /// Records the digests that a manifest names, for [`for_manifest`](Self::for_manifest).
    pub(crate) fn note(&self, digest: Digest, manifest: &Manifest) {
        let mut named = manifest.mentions();
        named.extend(manifest.blobs().map(|blob| blob.digest));
        lock(&self.0).named.insert(digest, named);
    }

    /// The receipts of a manifest and of everything that it names, directly or through other manifests of this attempt.
    pub(crate) fn for_manifest(&self, digest: Digest) -> BTreeMap<Digest, String> {
        let held = lock(&self.0);
        let mut seen = BTreeSet::new();
        let mut queue = vec![digest];
        while let Some(next) = queue.pop() {
            if seen.insert(next) {
                queue.extend(held.named.get(&next).into_iter().flatten());
            }
        }
        let receipt = |digest: Digest| Some((digest, held.receipts.get(&digest)?.clone()));
        seen.into_iter().filter_map(receipt).collect()
    }
}

#[cfg(test)]
mod tests {
    use protocol::{ArtifactKind, FileEntry};

    use super::*;

    #[test]
    fn a_manifest_takes_along_the_receipts_of_all_that_it_names() {
        let [weights, part, other, input] =
            ["weights", "part", "other", "input"].map(|text| Digest::of(text.as_bytes()));
        let receipts = Receipts::default();
        for digest in [weights, part, other] {
            receipts.keep(digest, Some(digest.short()));
        }
        receipts.keep(input, None);
        let mut manifest = Manifest::new(ArtifactKind::Denoiser, serde_json::json!({"fits": {"vae": input}}));
        manifest.files.insert("model.safetensors".to_owned(), FileEntry::of_blob(weights, 1));
        receipts.note(part, &manifest);
        let model = Manifest::new(ArtifactKind::Model, serde_json::json!({"parts": {"denoiser": part}}));
        receipts.note(model.digest(), &model);
        receipts.keep(model.digest(), Some("model".to_owned()));

        let vouched: Vec<Digest> = receipts.for_manifest(model.digest()).into_keys().collect();
        let mut expected = vec![weights, part, model.digest()];
        expected.sort();
        assert_eq!(vouched, expected);
    }
}
