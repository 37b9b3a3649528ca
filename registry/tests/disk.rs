//! Tests on a full disk and on a read-only one. The test mounts them; where mounting is not allowed, it reports that
//! and passes.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::path::PathBuf;

use checkpoint::BlobError;
use cluster_tests::mounted::Mounted;
use registry::{Holder, OpenError, Store, WriteError};
use serde_json::json;

#[tokio::test]
async fn p7_a_full_disk_is_a_storage_error_loses_nothing_and_can_be_collected() {
    let disk = tempfile::tempdir().unwrap();
    let Some(_mounted) = Mounted::tmpfs(disk.path(), "size=40m") else { return };
    let (disk, dir) = (disk.path(), disk.path().join("store"));
    let store = common::open(&dir).await;
    store.write(vec![common::note(json!("before"))]).await.unwrap();

    let mut stored = Vec::new();
    let error = loop {
        match store.blobs().put(&[vec![stored.len() as u8; 1 << 20], vec![7]].concat()) {
            Ok(digest) => stored.push(digest),
            Err(e) => break e,
        }
    };
    assert!(matches!(&error, BlobError::Storage(m) if m.contains("registry gc")), "{error}");

    // Other data fills the rest, so that the database cannot grow either.
    let ballast = disk.join("ballast");
    let mut size = 1 << 20;
    let mut file = std::fs::File::create(&ballast).unwrap();
    while size > 0 {
        if std::io::Write::write_all(&mut file, &vec![0; size]).is_err() {
            size /= 2;
        }
    }
    let event = json!("x".repeat(8 << 20));
    let error = store.write(vec![common::note(event)]).await.unwrap_err();
    assert!(matches!(&error, WriteError::Storage(m) if m.contains("full")), "{error:?}");
    drop(store);
    assert_eq!(nix::sys::statvfs::statvfs(disk).unwrap().blocks_available(), 0, "nothing at all is free");
    let error = Store::open(&dir, Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(error, OpenError::Full { .. }), "{error}");
    assert!(error.hint().contains("`registry gc`"));
    // The advice works on the full disk.
    let mut gc = std::process::Command::new(env!("CARGO_BIN_EXE_registry"));
    let gc = gc.arg("--store").arg(&dir).args(["gc", "--grace", "0"]).output().unwrap();
    assert!(gc.status.success(), "{}", String::from_utf8_lossy(&gc.stderr));
    let left = walk(&dir.join("blobs/sha256"));
    assert!(left.is_empty(), "{} blobs that nothing needs are left", left.len());

    std::fs::remove_file(&ballast).unwrap();
    let store = common::open(&dir).await;
    assert_eq!(common::notes(&store).await, [json!("before")]);
    store.write(vec![common::note(json!("after"))]).await.unwrap();
    assert!(store.fsck().await.unwrap().problems.is_empty());
}

fn walk(dir: &std::path::Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] }).collect()
}

#[tokio::test]
async fn a_read_only_disk_is_refused_as_such() {
    let disk = tempfile::tempdir().unwrap();
    let Some(mounted) = Mounted::tmpfs(disk.path(), "size=40m") else { return };
    let store = disk.path().join("store");
    drop(common::open(&store).await);
    mounted.remount("ro");
    for dir in [store, disk.path().join("new")] {
        let error = Store::open(&dir, Holder::this_process("t")).await.unwrap_err();
        assert!(matches!(error, OpenError::ReadOnly { .. }), "{error:?}");
    }
}
