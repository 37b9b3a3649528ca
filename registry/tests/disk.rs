//! A disk that fills up, and one that cannot be written to. They need file systems of their own: `STRIDE_SMALL_DISK` names a
//! folder on one of 20 to 64 MB (`mount -t tmpfs -o size=40m none DIR`), `STRIDE_READ_ONLY_DISK` a store on one that is
//! mounted read-only. Without them these tests say so and pass.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::path::PathBuf;

use checkpoint::BlobError;
use registry::{Holder, OpenError, Store, WriteError};
use serde_json::json;

fn folder(variable: &str) -> Option<PathBuf> {
    let folder = std::env::var_os(variable).map(PathBuf::from);
    if folder.is_none() {
        eprintln!("SKIPPED: {variable} is not set");
    }
    folder
}

#[tokio::test]
async fn a_full_disk_is_a_storage_error_and_loses_nothing() {
    let Some(disk) = folder("STRIDE_SMALL_DISK") else { return };
    let dir = tempfile::tempdir_in(&disk).unwrap();
    let store = common::open(dir.path()).await;
    store.write(vec![common::note(json!("before"))]).await.unwrap();

    let mut stored = Vec::new();
    let error = loop {
        match store.blobs().put(&[vec![stored.len() as u8; 1 << 20], vec![7]].concat()) {
            Ok(digest) => stored.push(digest),
            Err(e) => break e,
        }
    };
    assert!(matches!(&error, BlobError::Storage(m) if m.contains("registry gc")), "{error}");

    // Somebody else fills the rest, so that the database cannot grow either.
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
    let error = Store::open(dir.path(), Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(error, OpenError::Full { .. }), "{error}");
    assert!(error.hint().contains("`registry gc`"));
    // The advice works while the disk is as full as it was.
    let mut gc = std::process::Command::new(env!("CARGO_BIN_EXE_registry"));
    let gc = gc.arg("--store").arg(dir.path()).args(["gc", "--grace", "0"]).output().unwrap();
    assert!(gc.status.success(), "{}", String::from_utf8_lossy(&gc.stderr));
    let left = walk(&dir.path().join("blobs/sha256"));
    assert!(left.is_empty(), "{} blobs that nothing needs are left", left.len());

    std::fs::remove_file(&ballast).unwrap();
    let store = common::open(dir.path()).await;
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
    let Some(disk) = folder("STRIDE_READ_ONLY_DISK") else { return };
    for dir in [disk.clone(), disk.join("new")] {
        let error = Store::open(&dir, Holder::this_process("t")).await.unwrap_err();
        assert!(matches!(error, OpenError::ReadOnly { .. }), "{error:?}");
    }
}
