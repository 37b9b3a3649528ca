//! A store with a missing, replaced or outdated database or blobs is detected and named. It is not opened, collected or
//! checked as a new one.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{artifact, note, notes, open, try_open, version};
use protocol::ArtifactKind;
use registry::{Holder, Mismatch, OpenError, Store, WriteError};
use serde_json::json;

fn holder() -> Holder {
    Holder::this_process("test")
}

/// Makes and closes a store with a model of one file.
async fn made(dir: &Path) {
    let store = open(dir).await;
    let model = artifact(store.blobs(), ArtifactKind::Model, "weights");
    store.write(vec![version("m", model, 0.1)]).await.unwrap();
}

fn blobs(dir: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(dir) else { return Vec::new() };
    let paths = entries.map(|entry| entry.unwrap().path());
    let mut all: Vec<_> = paths.flat_map(|path| if path.is_dir() { blobs(&path) } else { vec![path] }).collect();
    all.sort();
    all
}

async fn mismatch(dir: &Path) -> Mismatch {
    let new = try_open(dir).await.unwrap_err();
    let existing = loop {
        match Store::open_existing(dir, holder()).await.unwrap_err() {
            OpenError::Busy { .. } => tokio::task::yield_now().await,
            refused => break refused,
        }
    };
    match (new, existing) {
        (OpenError::Mismatch { mismatch, .. }, OpenError::Mismatch { mismatch: again, .. }) => {
            assert_eq!(mismatch, again);
            mismatch
        }
        (new, existing) => panic!("{new}; {existing}"),
    }
}

/// Runs the binary's `fsck` and `gc`, which must refuse and change nothing.
fn refused_by_the_commands(dir: &Path, says: &str) {
    let before = blobs(dir);
    for args in [&["fsck"][..], &["gc", "--grace", "0"], &["gc", "--dry-run"]] {
        let output = Command::new(env!("CARGO_BIN_EXE_registry")).arg("--store").arg(dir).args(args).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {stderr}");
        assert!(stderr.contains(says) && stderr.contains("hint: nothing was changed"), "{args:?}: {stderr}");
    }
    assert_eq!(blobs(dir), before, "nothing may be added or removed");
}

/// Copies a folder as after a crash, without closing open files.
fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let to = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copied(&entry.path(), &to),
            // A witness that was being written has been renamed meanwhile.
            false => assert!(fs::copy(entry.path(), to).is_ok() || !entry.path().exists()),
        }
    }
}

#[tokio::test]
async fn an_emptied_or_missing_database_beside_blobs_is_no_new_store() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("store");
    made(&dir).await;
    let database = dir.join("stride.db");
    fs::write(&database, b"").unwrap();
    assert!(matches!(mismatch(&dir).await, Mismatch::NoDatabase { .. }));
    refused_by_the_commands(&dir, "the database");
    assert_eq!(fs::read(&database).unwrap(), b"", "left as it was found");
    fs::remove_file(&database).unwrap();
    assert!(matches!(mismatch(&dir).await, Mismatch::NoDatabase { .. }));
    refused_by_the_commands(&dir, "the database");

    // Blobs alone are evidence, without marker and witness.
    fs::remove_file(dir.join("witness")).unwrap();
    fs::remove_file(dir.join("blobs/IDENTITY")).unwrap();
    refused_by_the_commands(&dir, "there are blobs in");
    // A log without its database is not a new store either.
    fs::remove_dir_all(dir.join("blobs")).unwrap();
    fs::write(dir.join("stride.db-wal"), b"frames").unwrap();
    assert!(matches!(mismatch(&dir).await, Mismatch::NoDatabase { .. }));
    assert_eq!(fs::read(dir.join("stride.db-wal")).unwrap(), b"frames", "left as it was found");
}

#[tokio::test]
async fn a_lost_log_is_noticed() {
    let dir = tempfile::tempdir().unwrap();
    let (live, young, grown) = (dir.path().join("live"), dir.path().join("young"), dir.path().join("grown"));
    let store = open(&live).await;
    let model = artifact(store.blobs(), ArtifactKind::Model, "weights");
    store.write(vec![version("m", model, 0.1)]).await.unwrap();
    // All pages except the first are still in the log.
    copied(&live, &young);
    fs::remove_file(young.join("stride.db-wal")).unwrap();
    assert!(matches!(mismatch(&young).await, Mismatch::NoDatabase { .. }));
    refused_by_the_commands(&young, "the database");

    // The log has been checkpointed several times and restarted.
    for i in 0..40 {
        store.write(vec![note("x".repeat(1 << 20)), note(i)]).await.unwrap();
    }
    // The first of these may restart the log; the second is written after the witness knows.
    for last in ["a new log", "known"] {
        store.write(vec![note(last)]).await.unwrap();
    }
    copied(&live, &grown);
    let whole = dir.path().join("whole");
    copied(&live, &whole);
    assert!(open(&whole).await.fsck().await.unwrap().problems.is_empty(), "with its log the copy is whole");
    fs::remove_file(grown.join("stride.db-wal")).unwrap();
    let lost = mismatch(&grown).await;
    assert!(matches!(&lost, Mismatch::WentBack { found, known, .. } if found < known), "{lost}");
    refused_by_the_commands(&grown, "has lost transactions");

    let adopted = loop {
        match Store::adopt(&grown, None, holder()).await {
            Err(OpenError::Busy { .. }) => tokio::task::yield_now().await,
            adopted => break adopted.unwrap(),
        }
    };
    assert_eq!(adopted.id(), store.id());
    drop(adopted);
    open(&grown).await.write(vec![note("goes on")]).await.unwrap();
    drop(open(&grown).await);
}

#[tokio::test]
async fn an_older_database_in_the_place_of_a_newer_one_is_noticed() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("store");
    made(&dir).await;
    let old = fs::read(dir.join("stride.db")).unwrap();
    open(&dir).await.write(vec![note("newer")]).await.unwrap();
    fs::write(dir.join("stride.db"), old).unwrap();
    assert!(matches!(mismatch(&dir).await, Mismatch::WentBack { .. }));
    refused_by_the_commands(&dir, "has lost transactions");
}

#[tokio::test]
async fn a_database_without_its_blobs_is_refused_until_it_is_adopted() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("store");
    made(&dir).await;
    fs::rename(dir.join("blobs"), dir.join("elsewhere")).unwrap();
    assert!(matches!(mismatch(&dir).await, Mismatch::NoBlobs { .. }));
    refused_by_the_commands(&dir, "the blobs of the database");
    assert!(!dir.join("blobs").exists(), "the place stays free for the blobs to come back to");
    fs::rename(dir.join("elsewhere"), dir.join("blobs")).unwrap();
    assert!(open(&dir).await.fsck().await.unwrap().problems.is_empty(), "put back it is whole");

    fs::remove_dir_all(dir.join("blobs")).unwrap();
    let adopt = Command::new(env!("CARGO_BIN_EXE_registry")).arg("--store").arg(&dir).arg("adopt").output().unwrap();
    assert!(adopt.status.success(), "{}", String::from_utf8_lossy(&adopt.stderr));
    let problems = open(&dir).await.fsck().await.unwrap().problems;
    assert!(problems[0].contains("version m:1"), "what is missing is named: {problems:?}");
}

#[tokio::test]
async fn parts_of_two_stores_are_not_opened_together() {
    let dir = tempfile::tempdir().unwrap();
    let (one, other) = (dir.path().join("one"), dir.path().join("other"));
    made(&one).await;
    made(&other).await;
    fs::copy(other.join("stride.db"), one.join("stride.db")).unwrap();
    assert!(matches!(mismatch(&one).await, Mismatch::Mixed { .. }));
    refused_by_the_commands(&one, "belongs to store");
    let refused = Store::adopt(&one, None, holder()).await.unwrap_err();
    assert!(matches!(refused, OpenError::Mismatch { mismatch: Mismatch::Mixed { .. }, .. }), "{refused}");
}

/// A server holds its store for weeks and collects every quarter of an hour.
#[tokio::test]
async fn a_store_that_is_emptied_while_it_is_open_is_not_collected() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("store");
    let store = open(&dir).await;
    store.blobs().put(b"nobody needs this").unwrap();
    let marker = fs::read(dir.join("blobs/IDENTITY")).unwrap();
    for (lost, back) in [("blobs/IDENTITY", marker), ("stride.db", fs::read(dir.join("stride.db")).unwrap())] {
        fs::write(dir.join(lost), b"").unwrap();
        let refused = store.gc(-1000).await.unwrap_err();
        assert!(matches!(&refused, WriteError::Storage(m) if m.contains("nothing was collected")), "{lost}: {refused}");
        assert!(!store.fsck().await.is_ok_and(|report| report.problems.is_empty()), "{lost}");
        fs::write(dir.join(lost), back).unwrap();
    }
    assert_eq!(store.blobs().list().unwrap().len(), 1, "nothing went");
}

#[tokio::test]
async fn no_store_is_made_among_other_files() {
    let dir = tempfile::tempdir().unwrap();
    let home = dir.path().join("home");
    fs::create_dir(&home).unwrap();
    fs::write(home.join("thesis.tex"), b"text").unwrap();
    let refused = Store::open(&home, holder()).await.unwrap_err();
    assert!(matches!(&refused, OpenError::NotEmpty { found, .. } if found == "`thesis.tex`"), "{refused}");
    assert!(refused.hint().contains("empty"));
    assert_eq!(blobs(dir.path()), [home.join("thesis.tex")], "nothing was made");
    // An existing store tolerates other files beside it.
    let store = dir.path().join("store");
    drop(open(&store).await);
    fs::write(store.join("notes.txt"), b"text").unwrap();
    drop(open(&store).await);
}

/// A process that opened a store earlier can no longer write to it, even if the file lock did not exclude the second
/// one.
#[tokio::test]
async fn the_second_to_open_fences_the_first() {
    let dir = tempfile::tempdir().unwrap();
    let first = open(dir.path()).await;
    first.write(vec![note("first")]).await.unwrap();
    // A new file under the lock's name, which the second one locks.
    fs::remove_file(dir.path().join("lock")).unwrap();
    let second = open(dir.path()).await;
    second.write(vec![note("second")]).await.unwrap();
    let refused = first.write(vec![note("late")]).await.unwrap_err();
    assert!(matches!(refused, WriteError::Superseded { .. }), "{refused}");
    assert_eq!(notes(&second).await, [json!("first"), json!("second")]);
}
