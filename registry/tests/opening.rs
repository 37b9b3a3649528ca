//! Tests of opening a store: exclusion, refusals and their reasons, and reading beside the holder.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{artifact, open, result};
use protocol::{ArtifactKind, Digest};
use registry::{Holder, OpenError, Store};
use serde_json::json;

#[tokio::test]
async fn a_second_open_says_who_and_works_once_the_first_is_gone() {
    let dir = tempfile::tempdir().unwrap();
    let first = Store::open(dir.path(), Holder::this_process("trainer run quickstart.yaml")).await.unwrap();
    first.set_address("http://127.0.0.1:7070").unwrap();
    let error = Store::open(dir.path(), Holder::this_process("second")).await.unwrap_err();
    let message = error.to_string();
    assert!(matches!(error, OpenError::Busy { .. }));
    for part in ["trainer run quickstart.yaml", &std::process::id().to_string(), "http://127.0.0.1:7070"] {
        assert!(message.contains(part), "{message}");
    }
    first.write(vec![common::note(json!(1))]).await.unwrap();
    drop(first);
    assert_eq!(common::notes(&open(dir.path()).await).await, [json!(1)]);
}

#[tokio::test]
async fn p16_of_many_that_open_at_once_each_gets_it_or_learns_that_it_is_busy() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().to_owned();
    let opens: Vec<_> = (0..16)
        .map(|_| {
            let path = path.clone();
            tokio::spawn(async move {
                loop {
                    match Store::open(&path, Holder::this_process("one of many")).await {
                        Ok(store) => return store.write(vec![common::note(json!(0))]).await.unwrap(),
                        Err(OpenError::Busy { .. }) => tokio::task::yield_now().await,
                        Err(e) => panic!("{e}"),
                    }
                }
            })
        })
        .collect();
    for open in opens {
        open.await.unwrap();
    }
    assert_eq!(common::notes(&open(dir.path()).await).await.len(), 16);
}

#[tokio::test]
async fn what_cannot_be_opened_says_why() {
    let dir = tempfile::tempdir().unwrap();
    let missing = Store::open_existing(dir.path(), Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(missing, OpenError::NotAStore(_)));

    let file = dir.path().join("file");
    std::fs::write(&file, b"").unwrap();
    assert!(matches!(Store::open(&file.join("store"), Holder::this_process("t")).await, Err(OpenError::Other { .. })));

    let garbage = dir.path().join("garbage");
    std::fs::create_dir(&garbage).unwrap();
    std::fs::write(garbage.join("stride.db"), vec![b'x'; 8192]).unwrap();
    let damaged = Store::open(&garbage, Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(damaged, OpenError::Damaged { .. }), "{damaged:?}");
    assert_eq!(std::fs::read(garbage.join("stride.db")).unwrap(), vec![b'x'; 8192], "untouched");
}

#[tokio::test]
async fn p16_a_newer_schema_is_refused() {
    use sqlx::Connection;
    let dir = tempfile::tempdir().unwrap();
    drop(open(dir.path()).await);
    let path = dir.path().join("stride.db");
    let mut conn = sqlx::SqliteConnection::connect(&format!("sqlite:{}", path.display())).await.unwrap();
    let newer = "INSERT INTO _sqlx_migrations SELECT 9999, description, installed_on, success, checksum, execution_time \
                 FROM _sqlx_migrations LIMIT 1";
    sqlx::query(newer).execute(&mut conn).await.unwrap();
    conn.close().await.unwrap();
    let error = Store::open(dir.path(), Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(error, OpenError::NewerSchema { found: 9999, .. }), "{error}");
}

/// A folder that the kernel protects from writing.
#[cfg(target_os = "linux")]
#[tokio::test]
async fn a_read_only_place_is_refused_as_such() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let closed = dir.path().join("closed");
    std::fs::create_dir(&closed).unwrap();
    std::fs::set_permissions(&closed, std::fs::Permissions::from_mode(0o555)).unwrap();
    if std::fs::write(closed.join("probe"), b"").is_ok() {
        fixtures::skip("this user may write everywhere, so folder permissions say nothing");
        return;
    }
    let error = Store::open(&closed.join("store"), Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(error, OpenError::ReadOnly { .. }), "{error}");
}

/// Readers need no holder, block no writer and leave no trace.
#[tokio::test]
async fn a_store_is_read_while_it_is_held_and_without_a_trace_while_it_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let names = || {
        let entries = std::fs::read_dir(dir.path()).unwrap();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    };
    let store = open(dir.path()).await;
    let output = artifact(store.blobs(), ArtifactKind::Vae, "weights");
    store.write(vec![result("k", output)]).await.unwrap();
    let key = Digest::of(b"k");
    let held = registry::ReadStore::open(dir.path()).await.unwrap();
    assert!(held.stage_result(key).await.unwrap().is_some());
    store.write(vec![result("later", output)]).await.unwrap();
    assert!(held.stage_result(Digest::of(b"later")).await.unwrap().is_some(), "what was committed since is seen");
    held.close().await;
    drop(store);
    // Waits until the writer's last connection has removed its log.
    while dir.path().join("stride.db-wal").exists() {
        tokio::task::yield_now().await;
    }
    let before = (names(), std::fs::read(dir.path().join("stride.db")).unwrap());
    let free = registry::ReadStore::open(dir.path()).await.unwrap();
    assert!(free.stage_result(key).await.unwrap().is_some());
    assert!(free.fsck().await.unwrap().problems.is_empty());
    let shared = registry::ReadStore::open(dir.path()).await.unwrap();
    assert!(shared.runs().await.unwrap().is_empty());
    drop((free, shared));
    assert_eq!((names(), std::fs::read(dir.path().join("stride.db")).unwrap()), before);
    open(dir.path()).await.write(vec![result("last", output)]).await.unwrap();
}
