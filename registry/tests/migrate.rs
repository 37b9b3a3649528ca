//! Moves of a catalog between SQLite and PostgreSQL, and backups of both.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeMap;
use std::path::Path;

use cluster_tests::postgres::Postgres;
use common::{artifact, fence, grant, metrics, open, result, rows, version};
use protocol::ArtifactKind;
use registry::backup::restore;
use registry::catalog::PostgresAddress;
use registry::migrate::{MoveError, to_folder, to_postgres};
use registry::{HistoryEntry, HistoryKind, HistoryQuery, Holder, OpenError, Page, RunListQuery, Store, Write};
use serde_json::json;

fn holder() -> Holder {
    Holder::this_process("test")
}

/// Writes rows of every kind.
async fn fill(store: &Store) {
    let grant = || grant("r/s", 1);
    let checkpoint = artifact(store.blobs(), ArtifactKind::Checkpoint, "checkpoint");
    let (value, model) =
        (artifact(store.blobs(), ArtifactKind::Vae, "value"), artifact(store.blobs(), ArtifactKind::Model, "model"));
    let run = |run: &str| Write::Run {
        run: run.into(),
        pipeline: json!({"name": "lösung", "stages": []}),
        source: "name: lösung\n".into(),
        state: "running".into(),
        idempotency_key: Some(run.to_owned()),
    };
    store
        .write(vec![
            Write::Facts { seq: 1, facts: json!({"text": "a\u{0}b"}).to_string() },
            run("r"),
            run("other"),
            fence("r/s", 1),
            Write::RunOwner { run: "r".into(), owner: registry_group() },
            Write::Metrics { grant: grant(), rows: rows(0..200, f64::INFINITY) },
            Write::Metrics { grant: grant(), rows: rows(200..210, f64::NAN) },
            Write::Logs { grant: grant(), first: 0, lines: vec!["one".into(), "two \u{1F980}".into()] },
            Write::Checkpoint { grant: grant(), step: 3, manifest: checkpoint, metrics: metrics(&[("loss", 0.1)]) },
            result("key", value),
            version("m", model, 0.25),
            Write::History(vec![HistoryEntry::new(HistoryKind::Joined)]),
        ])
        .await
        .unwrap();
}

fn registry_group() -> protocol::Group {
    protocol::Group::new("@lab")
}

/// Answers to questions about every kind of rows.
async fn answers(store: &Store) -> Vec<String> {
    let (run, stage) = ("r".into(), "s".into());
    let asked = RunListQuery { limit: 10, words: "lösung".into(), ..RunListQuery::default() };
    let timeline = HistoryQuery { limit: 10, ..HistoryQuery::default() };
    let shown = [
        format!("{:?}", store.recovery().await.unwrap()),
        format!("{:?}", store.runs().await.unwrap()),
        format!("{:?}", store.run_list(&asked).await.unwrap()),
        format!("{:?}", store.run_owners(&["r".into()]).await.unwrap()),
        format!("{:?}", store.points(&run, &stage, None, Page::ALL).await.unwrap()),
        format!("{:?}", store.logs(&run, None, 0, 10).await.unwrap()),
        format!("{:?}", store.latest_checkpoint(&"r/s".into()).await.unwrap()),
        format!("{:?}", store.models().await.unwrap()),
        format!("{:?}", store.versions(&"m".into()).await.unwrap()),
        format!("{:?}", store.timeline(&timeline).await.unwrap()),
        format!("{:?}", store.history_span().await.unwrap()),
        format!("{:?}", store.usage(&run).await.unwrap()),
    ];
    shown.into()
}

async fn expect_sound(dir: &Path) {
    let store = open(dir).await;
    let problems = store.fsck().await.unwrap().problems;
    assert!(problems.is_empty(), "{problems:?}");
}

#[tokio::test]
async fn a_catalog_moves_there_and_back_and_the_former_one_is_refused() {
    let Some(server) = Postgres::shared() else { return };
    let address: PostgresAddress = server.address(&server.create()).parse().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("store");
    let store = open(&dir).await;
    fill(&store).await;
    let before = answers(&store).await;
    drop(store);

    let rows = to_postgres(&dir, &address, holder()).await.unwrap();
    assert!(rows > 220, "{rows}");
    let store = open(&dir).await;
    assert!(store.leadership().is_some() && !dir.join("stride.db").exists());
    assert_eq!(answers(&store).await, before);
    // New rows continue the numbers of the old ones.
    store.write(vec![Write::History(vec![HistoryEntry::new(HistoryKind::Left)])]).await.unwrap();
    store.write(vec![Write::Logs { grant: grant("r/s", 1), first: 2, lines: vec!["three".into()] }]).await.unwrap();
    let more = answers(&store).await;
    assert_ne!(more, before);
    drop(store);
    expect_sound(&dir).await;
    let again = to_postgres(&dir, &address, holder()).await;
    assert!(matches!(again, Err(MoveError::Refused(_))), "{again:?}");

    // The file that was moved is a former copy.
    let old = folder.path().join("old");
    std::fs::create_dir_all(&old).unwrap();
    std::fs::copy(dir.join("stride.db.moved"), old.join("stride.db")).unwrap();
    let blobs = dir.display().to_string().parse().unwrap();
    let refused = Store::open_with(&old, Some(&blobs), holder()).await;
    assert!(matches!(refused, Err(OpenError::Mismatch { .. } | OpenError::Elsewhere { .. })), "{refused:?}");

    to_folder(&address, &dir, holder()).await.unwrap();
    let store = open(&dir).await;
    assert!(store.leadership().is_none() && dir.join("stride.db").exists());
    assert_eq!(answers(&store).await, more);
    drop(store);
    expect_sound(&dir).await;
    // PostgreSQL has a former copy now.
    let stale = Store::open_on(&address.clone().into(), &folder.path().join("another"), Some(&blobs), holder()).await;
    assert!(matches!(stale, Err(OpenError::Mismatch { .. })), "{stale:?}");
}

#[tokio::test]
async fn a_backup_of_postgresql_restores_to_a_folder() {
    let Some(server) = Postgres::shared() else { return };
    let address: PostgresAddress = server.address(&server.create()).parse().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (dir, backup, restored) =
        (folder.path().join("store"), folder.path().join("backup"), folder.path().join("restored"));
    let store = Store::open_on(&address.into(), &dir, None, holder()).await.unwrap();
    fill(&store).await;
    let summary = store.backup(&backup).await.unwrap();
    assert_eq!(restore(&backup, &restored, None).await.unwrap(), summary);
    let copy = open(&restored).await;
    assert_eq!(answers(&copy).await, answers(&store).await);
    assert_eq!(copy.present(&[]).await.unwrap(), BTreeMap::new());
}
