//! Blobs that this process has stored or used again, so that it need not ask for them when a row names them a moment later.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use protocol::Digest;

/// The longest blob whose bytes are kept: manifests are shorter.
pub(super) const SMALL_BYTES: u64 = 64 << 10;
/// How much is kept at most; then all of it goes, and is asked for again.
const BLOBS: usize = 1 << 16;
const BYTES: usize = 32 << 20;

/// Lengths by digest, and the bytes of short ones.
#[derive(Debug, Default)]
pub(super) struct Seen(Mutex<Inner>);

#[derive(Debug, Default)]
struct Inner {
    blobs: HashMap<Digest, Known>,
    kept: usize,
}

#[derive(Debug)]
struct Known {
    bytes: u64,
    /// The bytes of a short blob.
    content: Option<Arc<[u8]>>,
}

impl Seen {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A blob is in its place; nothing removes it meanwhile.
    pub(super) fn note(&self, digest: Digest, bytes: u64) {
        let mut inner = self.lock();
        if inner.blobs.len() >= BLOBS {
            *inner = Inner::default();
        }
        inner.blobs.entry(digest).or_insert(Known { bytes, content: None });
    }

    /// Adds the bytes of a short blob, if it was not forgotten since it was noted.
    pub(super) fn complete(&self, digest: Digest, content: Option<Vec<u8>>) {
        let mut inner = self.lock();
        let Some(content) = content else { return };
        if inner.kept + content.len() > BYTES {
            inner.blobs.values_mut().for_each(|known| known.content = None);
            inner.kept = 0;
        }
        let more = content.len();
        if let Some(known) = inner.blobs.get_mut(&digest)
            && known.content.is_none()
        {
            known.content = Some(content.into());
            inner.kept += more;
        }
    }

    /// The length of a blob that is in its place.
    pub(super) fn bytes(&self, digest: Digest) -> Option<u64> {
        self.lock().blobs.get(&digest).map(|known| known.bytes)
    }

    /// The bytes of a short blob that is in its place.
    pub(super) fn content(&self, digest: Digest) -> Option<Arc<[u8]>> {
        self.lock().blobs.get(&digest).and_then(|known| known.content.clone())
    }

    /// A blob is about to go, or is not what it should be.
    pub(super) fn forget(&self, digest: Digest) {
        let mut inner = self.lock();
        if let Some(Known { content: Some(content), .. }) = inner.blobs.remove(&digest) {
            inner.kept -= content.len();
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn no_more_is_kept_than_there_is_room_for() {
        let seen = Seen::default();
        let name = |i: usize| Digest::of(&i.to_le_bytes());
        let part = vec![0; 1 << 16];
        for i in 0..2000 {
            seen.note(name(i), 1 << 16);
            seen.complete(name(i), Some(part.clone()));
            let inner = seen.lock();
            let kept: usize = inner.blobs.values().filter_map(|known| Some(known.content.as_ref()?.len())).sum();
            assert!(kept == inner.kept && kept <= BYTES);
        }
        assert_eq!(seen.bytes(name(1999)), Some(1 << 16));
        seen.forget(name(1999));
        assert!(seen.content(name(1999)).is_none() && seen.content(name(1998)).is_some());
    }
}
