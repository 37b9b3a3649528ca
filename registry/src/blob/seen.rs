//! Blobs that this process has just stored or reused, which a row can name without another request to the backend.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use protocol::Digest;

/// Limits of the cache. When one is reached, the cache is emptied.
const BLOBS: usize = 1 << 16;
const BYTES: usize = 32 << 20;

/// Cached lengths by digest, with the bytes of short blobs.
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

    /// Records a blob that is stored. The caller prevents its removal meanwhile.
    pub(super) fn note(&self, digest: Digest, bytes: u64) {
        let mut inner = self.lock();
        if inner.blobs.len() >= BLOBS {
            *inner = Inner::default();
        }
        inner.blobs.entry(digest).or_insert(Known { bytes, content: None });
    }

    /// Adds the bytes of a short blob, unless it was forgotten since it was recorded.
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

    /// Returns the length of a recorded blob.
    pub(super) fn bytes(&self, digest: Digest) -> Option<u64> {
        self.lock().blobs.get(&digest).map(|known| known.bytes)
    }

    /// Returns the bytes of a short recorded blob.
    pub(super) fn content(&self, digest: Digest) -> Option<Arc<[u8]>> {
        self.lock().blobs.get(&digest).and_then(|known| known.content.clone())
    }

    /// Forgets a blob that is damaged or about to be removed.
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
