//! What every blob backend must do, as plain functions, and the backends that do it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::sync::Arc;

use checkpoint::BlobError;
use protocol::Digest;
use registry::blob::fs::Folder;
use registry::blob::memory::Memory;
use registry::blob::{Backend, BlobStore};

fn what_was_put_is_read(store: &BlobStore) {
    for bytes in [&b""[..], b"a", &vec![7; 3 << 20]] {
        let digest = store.put(bytes).unwrap();
        assert_eq!(digest, Digest::of(bytes));
        assert_eq!(store.get(digest).unwrap(), bytes);
        assert_eq!(store.size(digest).unwrap(), Some(bytes.len() as u64));
    }
}

fn putting_twice_stores_once(store: &BlobStore) {
    let digest = store.put(b"twice").unwrap();
    assert_eq!(store.put(b"twice").unwrap(), digest);
    assert_eq!(store.list().unwrap().len(), 1);
}

fn what_is_not_there_is_not_found(store: &BlobStore) {
    let digest = Digest::of(b"never put");
    assert!(matches!(store.get(digest), Err(BlobError::NotFound(missing)) if missing == digest));
    assert!(!store.exists(digest).unwrap());
}

fn a_wrong_name_is_refused(store: &BlobStore) {
    let named = Digest::of(b"other");
    assert!(matches!(store.put_named(named, b"bytes"), Err(BlobError::Corrupt { expected, .. }) if expected == named));
    assert!(store.list().unwrap().is_empty());
}

fn many_threads_put_the_same_and_others(store: &BlobStore) {
    std::thread::scope(|scope| {
        for thread in 0..8_u8 {
            scope.spawn(move || {
                for i in 0..20_u8 {
                    store.put(&[i; 1000]).unwrap();
                    store.put(&[thread, i]).unwrap();
                }
            });
        }
    });
    let all = store.list().unwrap();
    assert_eq!(all.len(), 20 + 8 * 20);
    assert!(all.keys().all(|digest| store.get(*digest).is_ok()));
}

fn a_backend_moves_the_time_and_removes(backend: &dyn Backend) {
    let digest = Digest::of(b"x");
    backend.write(digest, b"x").unwrap();
    let first = backend.put_ms(digest).unwrap().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(20));
    backend.touch(digest).unwrap();
    assert!(backend.put_ms(digest).unwrap().unwrap() > first);
    backend.remove(digest).unwrap();
    backend.remove(digest).unwrap();
    assert_eq!(backend.size(digest).unwrap(), None);
    assert_eq!(backend.put_ms(digest).unwrap(), None);
    assert!(backend.list().unwrap().is_empty());
}

fn suite(fresh: impl Fn() -> Arc<dyn Backend>) {
    for check in [
        what_was_put_is_read,
        putting_twice_stores_once,
        what_is_not_there_is_not_found,
        a_wrong_name_is_refused,
        many_threads_put_the_same_and_others,
    ] {
        check(&BlobStore::over(fresh()));
    }
    a_backend_moves_the_time_and_removes(&*fresh());
}

#[test]
fn memory() {
    suite(|| Arc::new(Memory::default()));
}

#[test]
fn folder() {
    let dir = tempfile::tempdir().unwrap();
    let next = std::sync::atomic::AtomicU32::new(0);
    suite(|| {
        let path = dir.path().join(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed).to_string());
        std::fs::create_dir(&path).unwrap();
        Arc::new(Folder::open(&path).unwrap())
    });
}

#[test]
fn a_folder_detects_rot_and_mends_a_cut_blob() {
    let dir = tempfile::tempdir().unwrap();
    let store = BlobStore::new(Folder::open(dir.path()).unwrap());
    let digest = store.put(b"some bytes").unwrap();
    let path = dir.path().join("blobs/sha256").join(&digest.hex()[..2]).join(&digest.hex()[2..]);
    std::fs::write(&path, b"some bytez").unwrap();
    assert!(matches!(store.get(digest), Err(BlobError::Corrupt { .. })));
    std::fs::write(&path, b"some").unwrap();
    assert!(matches!(store.get(digest), Err(BlobError::Corrupt { .. })));
    store.put(b"some bytes").unwrap();
    assert_eq!(store.get(digest).unwrap(), b"some bytes");
}

#[test]
fn a_folder_forgets_what_a_dead_process_staged() {
    let dir = tempfile::tempdir().unwrap();
    drop(Folder::open(dir.path()).unwrap());
    std::fs::write(dir.path().join("staging/0"), b"half a bl").unwrap();
    let store = BlobStore::new(Folder::open(dir.path()).unwrap());
    assert!(std::fs::read_dir(dir.path().join("staging")).unwrap().next().is_none());
    assert!(store.list().unwrap().is_empty());
}
