//! Tests of backups: consistent, complete, made while the store is in use, and restored to the same store.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use common::{artifact, fence, grant, note, open, result, run_in, version};
use protocol::{ArtifactKind, Digest};
use registry::backup::{BackupError, restore};
use registry::{ReadStore, Store, Write};

async fn add(store: &Store, content: &str) -> Digest {
    let model = artifact(store.blobs(), ArtifactKind::Model, content);
    store.write(vec![version("m", model, 0.1)]).await.unwrap();
    model
}

fn blob(dir: &Path, digest: Digest) -> PathBuf {
    let hex = digest.hex();
    dir.join("blobs/sha256").join(&hex[..2]).join(&hex[2..])
}

fn registry(args: &[&str], paths: &[&Path]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_registry"));
    command.args(args).args(paths).env_remove("STRIDE_SERVER").output().unwrap()
}

#[tokio::test]
async fn a_backup_of_a_store_in_use_is_restored_as_it_was_at_that_moment() {
    let root = tempfile::tempdir().unwrap();
    let (dir, backup, back) = (root.path().join("store"), root.path().join("backup"), root.path().join("back"));
    let store = open(&dir).await;
    let first = add(&store, "first").await;
    store.blobs().put(b"nobody needs this").unwrap();

    // The recorded check of a file is valid until its times or link count change.
    let is_as = || {
        let file = fs::metadata(blob(&dir, Digest::of(b"first"))).unwrap();
        (file.nlink(), file.ctime(), file.ctime_nsec())
    };
    let before = is_as();
    // Made by a separate process while this one holds the store.
    let made = registry(&["backup", "--store"], &[&dir, &backup]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    assert_eq!((before.0, is_as()), (1, before));
    let later = add(&store, "later").await;
    let restored = registry(&["restore", "--to"], &[&back, &backup]);
    assert!(restored.status.success(), "{}", String::from_utf8_lossy(&restored.stderr));

    let copy = open(&back).await;
    assert_eq!(copy.id(), store.id());
    assert_eq!(copy.blobs().list().unwrap().len(), 2, "what is needed and no more");
    assert!(copy.fsck().await.unwrap().problems.is_empty());
    let artifacts = |versions: Vec<registry::Version>| versions.iter().map(|v| v.artifact).collect::<Vec<_>>();
    assert_eq!(artifacts(copy.versions(&"m".into()).await.unwrap()), [first]);
    copy.write(vec![note("goes on")]).await.unwrap();

    // A second backup into the same folder adds new blobs.
    store.backup(&backup).await.unwrap();
    let again = root.path().join("again");
    let summary = restore(&backup, &again, None).await.unwrap();
    assert_eq!(summary.blobs, 4);
    let read = ReadStore::open(&again).await.unwrap();
    assert_eq!(artifacts(read.versions(&"m".into()).await.unwrap()), [first, later]);
}

/// Until a collection, the rows of shards remain that the results of a finished run replace. A backup has their rows and
/// not their blobs.
#[tokio::test]
async fn a_backup_between_the_end_of_a_run_and_a_collection_is_restored() {
    let root = tempfile::tempdir().unwrap();
    let (dir, backup, back) = (root.path().join("store"), root.path().join("backup"), root.path().join("back"));
    let store = open(&dir).await;
    let output = artifact(store.blobs(), ArtifactKind::Shard, "a part of the result");
    let whole = artifact(store.blobs(), ArtifactKind::Dataset, "the result");
    store.write(vec![run_in("running"), fence("r/s/0", 1)]).await.unwrap();
    store.write(vec![Write::Shard { grant: grant("r/s/0", 1), output }]).await.unwrap();
    store.write(vec![result("k", whole), run_in("finished")]).await.unwrap();
    assert_eq!(store.shards(&"r".into()).await.unwrap().len(), 1, "nothing was collected yet");

    store.backup(&backup).await.unwrap();
    restore(&backup, &back, None).await.unwrap();
    let copy = open(&back).await;
    assert!(copy.blobs().exists(whole).unwrap() && !copy.blobs().exists(output).unwrap());
    assert!(copy.fsck().await.unwrap().problems.is_empty());
    copy.gc(-1000).await.unwrap();
    assert!(copy.shards(&"r".into()).await.unwrap().is_empty());
    assert!(copy.fsck().await.unwrap().problems.is_empty());
}

#[tokio::test]
async fn nothing_is_restored_of_a_backup_that_is_not_whole() {
    let root = tempfile::tempdir().unwrap();
    let (dir, backup, back) = (root.path().join("store"), root.path().join("backup"), root.path().join("back"));
    let store = open(&dir).await;
    add(&store, "weights").await;
    store.backup(&backup).await.unwrap();
    let whole = |digest: Digest| blob(&backup, digest);
    let rotten = whole(Digest::of(b"weights"));
    for content in [Some(&b"weightz"[..]), None] {
        match content {
            Some(content) => fs::write(&rotten, content).unwrap(),
            None => fs::remove_file(&rotten).unwrap(),
        }
        let refused = restore(&backup, &back, None).await.unwrap_err();
        assert!(matches!(refused, BackupError::Damaged(_) | BackupError::Disk { .. }), "{refused}");
        assert!(!back.exists(), "no store appears before all of it was verified");
    }
    // A repeated backup is whole again.
    store.backup(&backup).await.unwrap();
    restore(&backup, &back, None).await.unwrap();
    assert!(matches!(restore(&backup, &back, None).await, Err(BackupError::Folder(_))), "a store is not overwritten");
    fs::remove_file(backup.join("backup.json")).unwrap();
    let unfinished = restore(&backup, &root.path().join("other"), None).await;
    assert!(matches!(unfinished, Err(BackupError::Folder(_))), "{unfinished:?}");
    store.backup(&backup).await.unwrap();
}

#[tokio::test]
async fn a_backup_goes_into_no_folder_of_anything_else() {
    let root = tempfile::tempdir().unwrap();
    let (dir, other, files) = (root.path().join("store"), root.path().join("other"), root.path().join("files"));
    let store = open(&dir).await;
    drop(open(&other).await);
    fs::create_dir(&files).unwrap();
    fs::write(files.join("thesis.tex"), b"text").unwrap();
    for folder in [&dir, &dir.join("inside"), &other, &files] {
        let refused = store.backup(folder).await.unwrap_err();
        assert!(matches!(refused, BackupError::Folder(_)), "{}: {refused}", folder.display());
    }
    let backup = root.path().join("backup");
    open(&other).await.backup(&backup).await.unwrap();
    assert!(matches!(store.backup(&backup).await, Err(BackupError::Folder(_))), "of another store");
    let remote = registry(&["backup", "--server", "http://127.0.0.1:1"], &[&backup]);
    assert_eq!(remote.status.code(), Some(2), "{}", String::from_utf8_lossy(&remote.stderr));
    assert!(String::from_utf8_lossy(&remote.stderr).contains("on the machine of the store"));
}
