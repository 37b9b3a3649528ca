//! Tests of versions, aliases, gates and history.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{artifact, open, version};
use protocol::{Alias, ArtifactKind, ModelName};
use registry::{Expect, ModelRef, QueryError, Store, Write, WriteError};

async fn with_versions(dir: &std::path::Path, fids: &[f64]) -> (Store, ModelName) {
    let store = open(dir).await;
    for (i, fid) in fids.iter().enumerate() {
        let model = artifact(store.blobs(), ArtifactKind::Model, &format!("model {i}"));
        store.write(vec![version("m", model, *fid)]).await.unwrap();
    }
    (store, "m".into())
}

async fn promote(
    store: &Store,
    text: &str,
    to: &str,
    expect: Option<Expect>,
    gates: &[&str],
) -> Result<u64, WriteError> {
    let reference: ModelRef = text.parse().unwrap();
    let gates = gates.iter().map(|gate| (*gate).to_owned()).collect();
    let pick = reference.pick.unwrap();
    store.promote(&reference.model, pick, &to.into(), expect, gates, "because", "tester").await.map(|p| p.to)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn versions_are_contiguous_however_many_register_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let runtime = tokio::runtime::Handle::current();
    tokio::task::block_in_place(|| {
        std::thread::scope(|scope| {
            for thread in 0..64 {
                let (store, runtime) = (&store, &runtime);
                scope.spawn(move || {
                    for i in 0..3 {
                        let model = artifact(store.blobs(), ArtifactKind::Model, &format!("{thread} {i}"));
                        runtime.block_on(store.write(vec![version("m", model, 0.1)])).unwrap();
                        // Again, as after a lost answer: the same version.
                        runtime.block_on(store.write(vec![version("m", model, 0.1)])).unwrap();
                    }
                });
            }
        });
    });
    let numbers: Vec<_> = store.versions(&"m".into()).await.unwrap().iter().map(|v| v.version).collect();
    assert_eq!(numbers, (1..=192).collect::<Vec<_>>());
}

#[tokio::test]
async fn registering_again_adds_metrics_and_makes_no_version() {
    let dir = tempfile::tempdir().unwrap();
    let (store, model) = with_versions(dir.path(), &[0.3]).await;
    let artifact = store.resolve("m:1").await.unwrap().artifact;
    let more = Write::Version {
        model: model.clone(),
        artifact,
        metrics: common::metrics(&[("mpjpe", 50.0)]),
        source: serde_json::Value::Null,
    };
    store.write(vec![more]).await.unwrap();
    let versions = store.versions(&model).await.unwrap();
    assert_eq!(versions.len(), 1);
    assert_eq!(versions[0].metrics, common::metrics(&[("latent_fid", 0.3), ("mpjpe", 50.0)]));
    let not_a_model = common::artifact(store.blobs(), ArtifactKind::Vae, "vae");
    assert!(matches!(store.write(vec![version("m", not_a_model, 0.1)]).await, Err(WriteError::Conflict(_))));
}

#[tokio::test]
async fn best_is_the_best_finite_value_and_the_older_of_equals() {
    let dir = tempfile::tempdir().unwrap();
    let (store, model) = with_versions(dir.path(), &[0.3, f64::NAN, 0.1, 0.1, f64::NEG_INFINITY]).await;
    assert_eq!(store.resolve("m@best").await.unwrap().version, 3);
    assert_eq!(store.resolve("m@latest").await.unwrap().version, 5);
    assert_eq!(store.model(&model).await.unwrap().unwrap().0.best, Some(3));
    for missing in ["m:6", "m@prod", "other@best"] {
        let error = store.resolve(missing).await.unwrap_err();
        assert!(matches!(error, QueryError::NotFound(_)) && error.to_string().contains("there are"), "{error}");
    }
    assert!(matches!(store.resolve("m").await, Err(QueryError::Invalid(_))));
}

#[tokio::test]
async fn a_gate_that_does_not_hold_changes_nothing_and_says_by_how_much() {
    let dir = tempfile::tempdir().unwrap();
    let (store, model) = with_versions(dir.path(), &[0.3, 0.2]).await;
    let error = promote(&store, "m:1", "prod", None, &["latent_fid<=1", "latent_fid <= 0.25"]).await.unwrap_err();
    assert!(matches!(&error, WriteError::Gate(m) if m.contains("misses by 0.05")), "{error}");
    assert!(store.history(&model, None).await.unwrap().is_empty());
    assert!(store.resolve("m@prod").await.is_err());

    assert_eq!(promote(&store, "m@best", "prod", None, &["latent_fid<=0.25", "latent_fid <= prod"]).await.unwrap(), 2);
    let worse = promote(&store, "m:1", "prod", None, &["latent_fid <= prod + 0.05"]).await;
    assert!(matches!(worse, Err(WriteError::Gate(_))));
    let typo = promote(&store, "m:1", "prod", None, &["latent_fid <= prud"]).await;
    assert!(matches!(typo, Err(WriteError::NotFound(_))), "{typo:?}");
    assert!(matches!(promote(&store, "m:1", "best", None, &[]).await, Err(WriteError::Conflict(_))));
    assert_eq!(store.resolve("m@prod").await.unwrap().version, 2);
    let log = store.history(&model, None).await.unwrap();
    assert_eq!((log.len(), log[0].gates.len(), log[0].gates[0].value), (1, 2, Some(0.2)));
}

#[tokio::test]
async fn of_many_who_expect_the_same_one_wins() {
    let dir = tempfile::tempdir().unwrap();
    let (store, model) = with_versions(dir.path(), &[0.3; 20]).await;
    for expect in [Expect::None, Expect::Version(0)] {
        let current = store.resolve("m@prod").await.ok().map(|v| v.version);
        let expect = if expect == Expect::None { expect } else { Expect::Version(current.unwrap()) };
        let tries: Vec<_> = (1..=20)
            .filter(|to| Some(*to) != current)
            .map(|to| {
                let store = store.clone();
                tokio::spawn(async move { promote(&store, &format!("m:{to}"), "prod", Some(expect), &[]).await })
            })
            .collect();
        let mut winners = 0;
        for one in tries {
            match one.await.unwrap() {
                Ok(_) => winners += 1,
                Err(WriteError::Conflict(_)) => {}
                Err(e) => panic!("{e}"),
            }
        }
        assert_eq!(winners, 1);
    }
    assert_eq!(store.history(&model, None).await.unwrap().len(), 2);
}

#[tokio::test]
async fn rolling_back_walks_back_promotion_by_promotion() {
    let dir = tempfile::tempdir().unwrap();
    let (store, model) = with_versions(dir.path(), &[0.4, 0.3, 0.2, 0.1]).await;
    let prod = Alias::new("prod");
    for to in 1..=3 {
        promote(&store, &format!("m:{to}"), "prod", None, &[]).await.unwrap();
    }
    promote(&store, "m:3", "prod", None, &[]).await.unwrap();
    let mut at = Vec::new();
    for _ in 0..2 {
        at.push(store.rollback(&model, &prod, None, None, "bad", "tester").await.unwrap().to);
    }
    assert_eq!(at, [2, 1]);
    assert!(matches!(store.rollback(&model, &prod, None, None, "", "").await, Err(WriteError::NotFound(_))));
    assert_eq!(store.rollback(&model, &prod, Some(4), Some(Expect::Version(1)), "", "").await.unwrap().to, 4);
    assert!(matches!(store.rollback(&model, &prod, Some(9), None, "", "").await, Err(WriteError::NotFound(_))));
    assert!(matches!(store.rollback(&model, &"no".into(), None, None, "", "").await, Err(WriteError::NotFound(_))));
    let log = store.history(&model, Some(&prod)).await.unwrap();
    let moves: Vec<_> = log.iter().map(|p| (p.from.unwrap_or(0), p.to)).collect();
    assert_eq!(moves, [(0, 1), (1, 2), (2, 3), (3, 2), (2, 1), (1, 4)], "a move to where it is leaves no entry");
}

#[tokio::test]
async fn promoting_by_write_is_idempotent() {
    let dir = tempfile::tempdir().unwrap();
    let (store, model) = with_versions(dir.path(), &[0.1]).await;
    let artifact = store.resolve("m:1").await.unwrap().artifact;
    let write = Write::Promote {
        model: model.clone(),
        alias: "staging".into(),
        artifact,
        require: vec!["latent_fid <= 0.3".into()],
        reason: "release".into(),
        actor: "r/release".into(),
    };
    store.write(vec![write.clone()]).await.unwrap();
    store.write(vec![write]).await.unwrap();
    assert_eq!(store.history(&model, None).await.unwrap().len(), 1);
    assert_eq!(store.resolve("m@staging").await.unwrap().aliases, ["staging"]);
}

#[tokio::test]
async fn the_log_and_the_versions_cannot_be_edited_even_by_hand() {
    use sqlx::Connection;
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = with_versions(dir.path(), &[0.1]).await;
    promote(&store, "m:1", "prod", None, &[]).await.unwrap();
    store.write(vec![common::fence("r/s", 1), common::note(serde_json::json!(1))]).await.unwrap();
    drop(store);
    let path = dir.path().join("stride.db");
    let mut conn = sqlx::SqliteConnection::connect(&format!("sqlite:{}", path.display())).await.unwrap();
    for edit in [
        "UPDATE promotions SET actor = 'x'",
        "DELETE FROM promotions",
        "UPDATE versions SET artifact = 'x'",
        "DELETE FROM versions",
        "DELETE FROM facts",
        "UPDATE facts SET facts = '2'",
        "UPDATE fences SET fence = 0",
    ] {
        assert!(sqlx::query(edit).execute(&mut conn).await.is_err(), "{edit}");
    }
}
