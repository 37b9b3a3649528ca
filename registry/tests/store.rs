//! Tests of fences, exactly-once, group commit, and the artifacts that a row may name.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeMap;

use common::{artifact, fence, grant, metrics, open, result, rows};
use proptest::prelude::*;
use protocol::message::MetricRow;
use protocol::{ArtifactKind, Digest, Fence, RunId, StageName, TaskId};
use registry::{Page, Write, WriteError};
use serde_json::json;

#[tokio::test]
async fn an_old_fence_refuses_the_whole_call_and_not_its_neighbours() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let task = "r/vae";
    store.write(vec![fence(task, 1)]).await.unwrap();
    store.write(vec![fence(task, 2)]).await.unwrap();
    let stale = Write::Metrics { grant: grant(task, 1), rows: rows(0..3, 1.0) };
    let (refused, stored) = tokio::join!(
        store.write(vec![common::note(json!("from the refused")), stale]),
        store.write(vec![common::note(json!("from the neighbour"))])
    );
    match refused.unwrap_err() {
        WriteError::StaleFence { task, current, carried } => {
            assert_eq!((task.as_str(), current, carried), ("r/vae", Fence(2), Fence(1)));
        }
        e => panic!("{e}"),
    }
    stored.unwrap();
    assert_eq!(common::notes(&store).await, [json!("from the neighbour")]);
    assert!(store.points(&"r".into(), &"vae".into(), None, Page::ALL).await.unwrap().is_empty());
}

/// Every kind of write with a grant, under the newest fence, an older one, and one that was never granted.
#[tokio::test]
async fn p2_every_kind_of_write_is_refused_under_an_old_fence() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let output = artifact(store.blobs(), ArtifactKind::Vae, "vae");
    let checkpoint = artifact(store.blobs(), ArtifactKind::Checkpoint, "checkpoint");
    store.write(vec![fence("r/s", 5)]).await.unwrap();
    let writes = |fence: u64| {
        let grant = || grant("r/s", fence);
        let mut result = result("key", output);
        if let Write::StageResult { grant: carried, .. } = &mut result {
            *carried = Some(grant());
        }
        vec![
            Write::Metrics { grant: grant(), rows: rows(0..3, 1.0) },
            Write::Logs { grant: grant(), first: 0, lines: vec!["line".to_owned()] },
            Write::Checkpoint { grant: grant(), step: 3, manifest: checkpoint, metrics: BTreeMap::new() },
            Write::Shard { grant: grant(), output },
            result,
        ]
    };
    let mut taken = Vec::new();
    for stale in [4, 6] {
        for write in writes(stale) {
            let what = format!("{write:?}");
            if store.write(vec![write]).await.is_ok() {
                taken.push(format!("under fence {stale}: {what}"));
            }
        }
    }
    assert!(taken.is_empty(), "{taken:#?}");
    let (run, stage) = (RunId::new("r"), StageName::new("s"));
    assert!(store.points(&run, &stage, None, Page::ALL).await.unwrap().is_empty());
    assert!(store.logs(&run, None, 0, 10).await.unwrap().is_empty());
    assert!(store.checkpoints(&TaskId::new("r/s")).await.unwrap().is_empty());
    assert!(store.shards(&run).await.unwrap().is_empty());
    assert!(store.stage_result(Digest::of(b"key")).await.unwrap().is_none());
    for write in writes(5) {
        store.write(vec![write]).await.unwrap();
    }
}

#[tokio::test]
async fn a_fence_that_was_never_granted_and_one_that_does_not_grow_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let write = |f| vec![Write::Metrics { grant: grant("r/s", f), rows: rows(0..1, 0.0) }];
    assert!(matches!(store.write(write(1)).await, Err(WriteError::Conflict(_))));
    store.write(vec![fence("r/s", 5)]).await.unwrap();
    assert!(matches!(store.write(write(6)).await, Err(WriteError::Conflict(_))));
    for old in [4, 5] {
        assert!(matches!(store.write(vec![fence("r/s", old)]).await, Err(WriteError::StaleFence { .. })), "{old}");
    }
    store.write(write(5)).await.unwrap();
}

#[derive(Debug, Clone)]
enum Step {
    Grant,
    Write { back: u64 },
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// For any interleaving of grants and late writes, a stored write has the fence that was the newest at its place in
    /// the store's order. Sampled: 24 random interleavings of up to 40 grants and writes.
    #[test]
    fn p2_an_old_fence_never_gets_in(steps in prop::collection::vec(
        prop_oneof![Just(Step::Grant), (0_u64..3).prop_map(|back| Step::Write { back })], 1..40
    )) {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        runtime.block_on(async {
            let dir = tempfile::tempdir().unwrap();
            let store = open(dir.path()).await;
            let mut newest = 0;
            let mut pending = Vec::new();
            for (i, step) in steps.iter().enumerate() {
                let write = match step {
                    Step::Grant => { newest += 1; vec![fence("r/s", newest), common::note(json!({"granted": newest}))] }
                    Step::Write { back } => {
                        let carried = newest.saturating_sub(*back);
                        let row = MetricRow { step: i as u64, key: "k".into(), value: 0.0 };
                        vec![
                            Write::Metrics { grant: grant("r/s", carried), rows: vec![row] },
                            common::note(json!({"written": carried})),
                        ]
                    }
                };
                let store = store.clone();
                pending.push(tokio::spawn(async move { store.write(write).await }));
                if i % 3 == 0 { tokio::task::yield_now().await; }
            }
            for write in pending { let _ = write.await.unwrap(); }
            // The facts record that order; a grant may have come late and been refused.
            let mut current = 0;
            for event in common::notes(&store).await {
                if let Some(granted) = event["granted"].as_u64() {
                    assert!(granted > current);
                    current = granted;
                } else {
                    assert_eq!(event["written"].as_u64().unwrap(), current);
                }
            }
        });
    }
}

#[tokio::test]
async fn p9_metrics_and_logs_that_are_sent_twice_are_stored_once_and_a_later_attempt_supersedes() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/vae", 1)]).await.unwrap();
    for _ in 0..2 {
        store.write(vec![Write::Metrics { grant: grant("r/vae", 1), rows: rows(0..10, 1.0) }]).await.unwrap();
        let lines = vec!["a".to_owned(), "b".to_owned()];
        store.write(vec![Write::Logs { grant: grant("r/vae", 1), first: 0, lines }]).await.unwrap();
    }
    store.write(vec![fence("r/vae", 2)]).await.unwrap();
    store.write(vec![Write::Metrics { grant: grant("r/vae", 2), rows: rows(5..7, 2.0) }]).await.unwrap();

    let (run, stage) = (RunId::new("r"), StageName::new("vae"));
    let curves = store.points(&run, &stage, Some(&["loss".into()]), Page::ALL).await.unwrap();
    let seen: Vec<_> = curves["loss"].points.iter().map(|p| (p.step, p.value)).collect();
    assert_eq!(seen, [(0, 1.0), (1, 1.0), (2, 1.0), (3, 1.0), (4, 1.0), (5, 2.0), (6, 2.0)]);
    let lines = store.logs(&run, Some(&stage), 0, 100).await.unwrap();
    assert_eq!(lines.iter().map(|l| l.text.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    assert!(store.logs(&run, None, lines[1].id, 100).await.unwrap().is_empty());
}

#[tokio::test]
async fn a_row_may_not_name_what_is_not_there() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    let checkpoint = |manifest| Write::Checkpoint { grant: grant("r/s", 1), step: 1, manifest, metrics: metrics(&[]) };
    let missing = store.write(vec![checkpoint(Digest::of(b"nothing"))]).await;
    assert!(matches!(missing, Err(WriteError::NotFound(_))), "{missing:?}");

    let whole = artifact(store.blobs(), ArtifactKind::Checkpoint, "content");
    let content = Digest::of(b"content").hex();
    std::fs::remove_file(dir.path().join("blobs/sha256").join(&content[..2]).join(&content[2..])).unwrap();
    // By another process, which has not just stored it itself.
    drop(store);
    let store = open(dir.path()).await;
    let incomplete = store.write(vec![checkpoint(whole)]).await.unwrap_err();
    assert!(incomplete.to_string().contains("lists `content`"), "{incomplete}");

    let not_a_manifest = store.blobs().put(b"plain bytes").unwrap();
    assert!(matches!(store.write(vec![checkpoint(not_a_manifest)]).await, Err(WriteError::Conflict(_))));
    assert!(store.latest_checkpoint(&"r/s".into()).await.unwrap().is_none());
}

#[tokio::test]
async fn the_first_value_of_a_key_wins() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let (one, other) =
        (artifact(store.blobs(), ArtifactKind::Vae, "one"), artifact(store.blobs(), ArtifactKind::Vae, "other"));
    store.write(vec![result("k", one)]).await.unwrap();
    store.write(vec![result("k", one)]).await.unwrap();
    assert!(matches!(store.write(vec![result("k", other)]).await, Err(WriteError::Conflict(_))));
    let key = Digest::of(b"k");
    let stored = store.stage_result(key).await.unwrap().unwrap();
    assert_eq!((stored.outputs["vae"], stored.wall_s, stored.metrics["loss"]), (one, 1.5, 0.5));
    assert!(stored.metrics["bad"].is_nan());
    assert_eq!(store.stage_results(&[key, Digest::of(b"?")]).await.unwrap().len(), 1);
    let lineage = store.lineage(one).await.unwrap();
    assert_eq!((lineage.len(), lineage[0].stage.as_deref()), (2, Some("s")));
    assert_eq!(lineage[0].inputs["dataset"], lineage[1].digest);
}

#[tokio::test]
async fn an_idempotency_key_belongs_to_one_run() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let run = |run: &str, state: &str| Write::Run {
        run: run.into(),
        pipeline: json!({"name": "p"}),
        source: "name: p".into(),
        state: state.into(),
        idempotency_key: Some("k".into()),
    };
    store.write(vec![run("a", "running")]).await.unwrap();
    store.write(vec![run("a", "finished")]).await.unwrap();
    assert!(matches!(store.write(vec![run("b", "running")]).await, Err(WriteError::Conflict(_))));
    assert_eq!(store.run_by_key("k").await.unwrap().unwrap().state, "finished");
    assert_eq!(store.runs().await.unwrap().len(), 1);
}

#[tokio::test]
async fn a_check_finds_rot_and_loss() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let output = artifact(store.blobs(), ArtifactKind::Vae, "weights");
    store.write(vec![result("k", output)]).await.unwrap();
    let hex = Digest::of(b"weights").hex();
    let path = dir.path().join("blobs/sha256").join(&hex[..2]).join(&hex[2..]);
    std::fs::write(&path, b"weightz").unwrap();
    assert_eq!(store.fsck().await.unwrap().problems.len(), 1);
    std::fs::remove_file(&path).unwrap();
    let problems = store.fsck().await.unwrap().problems;
    assert!(problems[0].contains("output `vae` of `r/s`"), "{problems:?}");
}
