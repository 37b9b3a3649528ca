//! Fences, exactly-once, group commit, opening.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeMap;

use common::{artifact, fence, grant, metrics, open};
use proptest::prelude::*;
use protocol::message::MetricRow;
use protocol::stage::{Keep, Mode};
use protocol::{ArtifactKind, Digest, Fence, RunId, StageName, TaskId};
use registry::{Holder, OpenError, Store, Write, WriteError};
use serde_json::json;

fn rows(steps: std::ops::Range<u64>, value: f64) -> Vec<MetricRow> {
    steps.map(|step| MetricRow { step, key: "loss".into(), value }).collect()
}

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
    assert!(store.metrics(&"r".into(), &"vae".into(), None, 0).await.unwrap().is_empty());
}

/// Every kind of write that carries a grant, under the newest fence, an older one, and one that was never granted.
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
    assert!(store.metrics(&run, &stage, None, 0).await.unwrap().is_empty());
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

    /// However grants and writes interleave, and whoever writes late: what is stored was written under the fence that was
    /// the newest at that point of the one order in which the store took them. Sampled:
    /// 24 random interleavings of up to 40 grants and writes.
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
            // The facts are that one order; a grant may itself have come late and been refused.
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
    let curves = store.metrics(&run, &stage, Some(&["loss".into()]), 0).await.unwrap();
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
    let incomplete = store.write(vec![checkpoint(whole)]).await.unwrap_err();
    assert!(incomplete.to_string().contains("lists `content`"), "{incomplete}");

    let not_a_manifest = store.blobs().put(b"plain bytes").unwrap();
    assert!(matches!(store.write(vec![checkpoint(not_a_manifest)]).await, Err(WriteError::Conflict(_))));
    assert!(store.latest_checkpoint(&"r/s".into()).await.unwrap().is_none());
}

fn result(key: &str, output: Digest) -> Write {
    Write::StageResult {
        grant: None,
        key: Digest::of(key.as_bytes()),
        run: "r".into(),
        stage: "s".into(),
        kind: "train.vae".into(),
        outputs: [("vae".to_owned(), output)].into(),
        metrics: metrics(&[("loss", 0.5), ("bad", f64::NAN)]),
        inputs: [("dataset".to_owned(), Digest::of(b"data"))].into(),
        wall_s: 1.5,
    }
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
async fn checkpoints_are_pruned_by_policy_and_only_the_unneeded_is_collected() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let task = TaskId::new("r/s");
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    let losses = [0.5, 0.1, f64::NAN, 0.3, 0.4];
    for (step, loss) in (1_u64..).zip(losses) {
        let manifest = artifact(store.blobs(), ArtifactKind::Checkpoint, &format!("step {step}"));
        let metrics = metrics(&[("loss", loss)]);
        store.write(vec![Write::Checkpoint { grant: grant("r/s", 1), step, manifest, metrics }]).await.unwrap();
    }
    let model = artifact(store.blobs(), ArtifactKind::Model, "model");
    store.write(vec![common::version("m", model, 0.1)]).await.unwrap();
    store.blobs().put(b"nobody needs this").unwrap();

    let joint = Keep { latest: 1, best: 1, metric: "joint".into(), ..Keep::default() };
    let refused = store.prune_checkpoints(&task, joint).await.unwrap_err().to_string();
    assert!(refused.contains("`joint`") && refused.contains("there is: loss"), "{refused}");
    assert_eq!(store.checkpoints(&task).await.unwrap().len(), 5, "nothing is lost by a metric that nobody saved");
    let gone = store.prune_checkpoints(&task, Keep { best: 1, ..Keep::default() }).await.unwrap();
    assert_eq!(gone.len(), 2);
    let steps: Vec<_> = store.checkpoints(&task).await.unwrap().iter().map(|c| c.step).collect();
    assert_eq!(steps, [5, 4, 2], "the two newest and the best; what is no number is never best");

    let largest = Keep { latest: 1, best: 1, mode: Mode::Max, ..Keep::default() };
    let other = TaskId::new("r/t");
    store.write(vec![fence("r/t", 1)]).await.unwrap();
    for (step, loss) in (1_u64..).zip(losses) {
        let manifest = store.checkpoints(&task).await.unwrap()[0].manifest;
        let metrics = metrics(&[("loss", loss)]);
        store.write(vec![Write::Checkpoint { grant: grant("r/t", 1), step, manifest, metrics }]).await.unwrap();
    }
    store.prune_checkpoints(&other, largest).await.unwrap();
    let steps: Vec<_> = store.checkpoints(&other).await.unwrap().iter().map(|c| c.step).collect();
    assert_eq!(steps, [5, 1], "the newest and the largest");
    store.prune_checkpoints(&other, Keep { latest: 1, ..Keep::default() }).await.unwrap();

    assert!(store.gc(60_000).await.unwrap().remove.is_empty(), "all is fresh");
    let plan = store.gc_plan(-1000).await.unwrap();
    assert_eq!(plan.remove.len(), 5, "two manifests, their files, and one blob");
    assert_eq!(store.gc(-1000).await.unwrap(), plan);
    assert!(store.gc(-1000).await.unwrap().remove.is_empty());
    let report = store.fsck().await.unwrap();
    assert_eq!((report.problems.as_slice(), report.blobs, report.references), (&[][..], 8, 5));
}

#[tokio::test]
async fn shards_go_once_their_run_is_finished_and_pins_stay() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let run = |state: &str| Write::Run {
        run: "r".into(),
        pipeline: json!({}),
        source: String::new(),
        state: state.into(),
        idempotency_key: None,
    };
    let shard = |content| artifact(store.blobs(), ArtifactKind::Shard, content);
    let (first, second) = (shard("first"), shard("second"));
    store.write(vec![run("failed"), fence("r/s/0", 1), fence("r/s/1", 1)]).await.unwrap();
    for (task, output) in [("r/s/0", first), ("r/s/1", second)] {
        store.write(vec![Write::Shard { grant: grant(task, 1), output }]).await.unwrap();
    }
    store.pin(second, "to look at").await.unwrap();
    for state in ["failed", "cancelled", "paused", "running"] {
        store.write(vec![run(state)]).await.unwrap();
        assert!(store.gc(-1000).await.unwrap().remove.is_empty(), "a {state} run may go on");
        assert_eq!(store.shards(&"r".into()).await.unwrap().len(), 2, "a {state} run may go on");
    }
    store.write(vec![run("finished")]).await.unwrap();
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 2);
    assert!(store.shards(&"r".into()).await.unwrap().is_empty());
    assert!(store.blobs().exists(second).unwrap());
    assert!(store.fsck().await.unwrap().problems.is_empty());
    store.unpin(second).await.unwrap();
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 2);
}

#[tokio::test]
async fn a_root_that_does_not_read_stops_the_collection() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let output = artifact(store.blobs(), ArtifactKind::Vae, "weights");
    store.write(vec![result("k", output)]).await.unwrap();
    store.blobs().put(b"nobody needs this").unwrap();
    let hex = output.hex();
    std::fs::write(dir.path().join("blobs/sha256").join(&hex[..2]).join(&hex[2..]), b"rot").unwrap();
    let error = store.gc(-1000).await.unwrap_err();
    assert!(error.to_string().contains("output `vae` of `r/s`"), "{error}");
    assert_eq!(store.blobs().list().unwrap().len(), 3, "nothing went");
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

/// A folder that the kernel refuses to write to, whoever asks.
#[cfg(target_os = "linux")]
#[tokio::test]
async fn a_read_only_place_is_refused_as_such() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let closed = dir.path().join("closed");
    std::fs::create_dir(&closed).unwrap();
    std::fs::set_permissions(&closed, std::fs::Permissions::from_mode(0o555)).unwrap();
    if std::fs::write(closed.join("probe"), b"").is_ok() {
        eprintln!("SKIPPED in part: this user may write everywhere, so folder permissions say nothing");
        return;
    }
    let error = Store::open(&closed.join("store"), Holder::this_process("t")).await.unwrap_err();
    assert!(matches!(error, OpenError::ReadOnly { .. }), "{error}");
}

fn put_before(dir: &std::path::Path, digest: Digest, minutes: u64) {
    let hex = digest.hex();
    let path = dir.join("blobs/sha256").join(&hex[..2]).join(&hex[2..]);
    let at = std::time::SystemTime::now() - std::time::Duration::from_secs(minutes * 60);
    let file = std::fs::File::options().append(true).open(path).unwrap();
    file.set_times(std::fs::FileTimes::new().set_modified(at)).unwrap();
}

/// A coordinator that was restarted does not know what a worker that still holds its task had uploaded.
#[tokio::test]
async fn no_grace_does_not_reach_behind_a_restart_while_a_run_is_under_way() {
    let dir = tempfile::tempdir().unwrap();
    let run = |state: &str| Write::Run {
        run: "r".into(),
        pipeline: json!({}),
        source: String::new(),
        state: state.into(),
        idempotency_key: None,
    };
    let store = open(dir.path()).await;
    store.write(vec![run("running")]).await.unwrap();
    let uploaded = store.blobs().put(b"its outcome is on its way").unwrap();
    let old = store.blobs().put(b"older than any upload waits").unwrap();
    drop(store);
    put_before(dir.path(), uploaded, 10);
    put_before(dir.path(), old, 90);
    let store = open(dir.path()).await;
    assert_eq!(store.gc(0).await.unwrap().remove, [old]);
    store.write(vec![run("finished")]).await.unwrap();
    assert_eq!(store.gc(0).await.unwrap().remove, [uploaded]);
}

/// Rows that come to name an old blob while it is about to go keep it; the others go, and no write waits for the end.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn writes_go_on_while_garbage_is_collected_and_what_they_name_stays() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let artifacts: Vec<_> =
        (0..300).map(|i| artifact(store.blobs(), ArtifactKind::Vae, &format!("artifact {i}"))).collect();
    let collecting = tokio::spawn({
        let store = store.clone();
        async move { store.gc(-1000).await.unwrap() }
    });
    let mut named = Vec::new();
    for (i, artifact) in artifacts.iter().enumerate() {
        match store.write(vec![result(&format!("key {i}"), *artifact)]).await {
            Ok(()) => named.push(*artifact),
            Err(WriteError::NotFound(_)) => {}
            Err(e) => panic!("{e}"),
        }
    }
    let plan = collecting.await.unwrap();
    assert!(plan.remove.iter().all(|gone| !named.contains(gone)), "nothing that a row names");
    for artifact in named {
        store.blobs().complete_manifest(artifact).unwrap();
    }
    assert!(store.fsck().await.unwrap().problems.is_empty());
}

/// Readers need nobody to let them in, hold nobody up, and leave no trace.
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
    // Reads once more until the writer's last connection has taken its log with it.
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

/// A run with a stage `made` and a stage `spare`, each with a value, a checkpoint, a curve and a log.
async fn finished_run(store: &Store, run: &str, state: &str) -> (Digest, Digest) {
    let stage = |name: &str| {
        let output = artifact(store.blobs(), ArtifactKind::Model, &format!("{run} {name}"));
        let checkpoint = artifact(store.blobs(), ArtifactKind::Checkpoint, &format!("{run} {name} at 1"));
        (name.to_owned(), output, checkpoint, Digest::of(format!("{run}/{name}").as_bytes()))
    };
    let stages = [stage("made"), stage("spare")];
    let pipeline = json!({"stages": [{"name": "made"}, {"name": "spare"}]});
    let (source, idempotency_key) = (String::new(), None);
    store
        .write(vec![Write::Run { run: run.into(), pipeline, source, state: "running".into(), idempotency_key }])
        .await
        .unwrap();
    for (name, output, checkpoint, key) in &stages {
        let task = format!("{run}/{name}");
        let grant = || grant(&task, 1);
        store
            .write(vec![
                fence(&task, 1),
                Write::Metrics { grant: grant(), rows: rows(0..3, 1.0) },
                Write::Logs { grant: grant(), first: 0, lines: vec!["line".into()] },
                Write::Checkpoint { grant: grant(), step: 1, manifest: *checkpoint, metrics: BTreeMap::new() },
                Write::StageResult {
                    grant: Some(grant()),
                    key: *key,
                    run: run.into(),
                    stage: name.as_str().into(),
                    kind: "train.vae".into(),
                    outputs: [("model".to_owned(), *output)].into(),
                    metrics: BTreeMap::new(),
                    inputs: BTreeMap::new(),
                    wall_s: 1.0,
                },
            ])
            .await
            .unwrap();
    }
    if state != "running" {
        let keys: Vec<_> = stages.iter().map(|(name, _, _, key)| json!({"name": name, "key": key})).collect();
        let view = json!({"stages": keys}).to_string();
        store
            .write(vec![Write::RunEnded { run: run.into(), state: state.into(), view, archive: "{}".into() }])
            .await
            .unwrap();
    }
    (stages[0].3, stages[1].3)
}

#[tokio::test]
async fn a_run_is_forgotten_but_not_what_models_are_made_of() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let (made, spare) = finished_run(&store, "old", "finished").await;
    let model = store.stage_result(made).await.unwrap().unwrap().outputs["model"];
    store.write(vec![common::version("m", model, 0.1)]).await.unwrap();
    let gone = store.forget(&"old".into()).await.unwrap();
    assert_eq!((gone.values, gone.lines, gone.checkpoints, gone.results), (3, 1, 1, 1));
    assert_eq!(gone.kept, ["old/made"]);
    assert!(store.runs().await.unwrap().is_empty());
    assert!(store.stage_result(spare).await.unwrap().is_none());
    assert_eq!(store.lineage(model).await.unwrap()[0].stage.as_deref(), Some("made"));
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 4, "the spare stage's model and its checkpoint");
    assert!(store.fsck().await.unwrap().problems.is_empty());
    assert!(matches!(store.forget(&"old".into()).await, Err(WriteError::NotFound(_))));
}

#[tokio::test]
async fn what_other_runs_need_of_a_forgotten_run_stays_until_they_go_too() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let (made, spare) = finished_run(&store, "first", "finished").await;
    // Another run has the first one's value `made`; a third one is under way and has stages of both names.
    let run = |run: &str, stages| Write::Run {
        run: run.into(),
        pipeline: json!({ "stages": stages }),
        source: String::new(),
        state: "running".into(),
        idempotency_key: None,
    };
    let view = json!({"stages": [{"name": "made", "key": made}]}).to_string();
    store.write(vec![run("cached", json!([{"name": "made"}]))]).await.unwrap();
    let ended = |run: &str, view: String| Write::RunEnded {
        run: run.into(),
        state: "finished".into(),
        view,
        archive: "{}".into(),
    };
    store.write(vec![ended("cached", view)]).await.unwrap();
    store.write(vec![run("live", json!([{"name": "spare"}]))]).await.unwrap();
    assert!(matches!(store.forget(&"live".into()).await, Err(WriteError::Conflict(m)) if m.contains("running")));

    let gone = store.forget(&"first".into()).await.unwrap();
    assert_eq!((gone.kept.as_slice(), gone.results), (&["first/made".to_owned(), "first/spare".to_owned()][..], 0));
    store.write(vec![ended("live", json!({"stages": []}).to_string())]).await.unwrap();
    store.forget(&"live".into()).await.unwrap();
    assert!(store.stage_result(made).await.unwrap().is_some() && store.stage_result(spare).await.unwrap().is_none());
    assert_eq!(store.ended_before(i64::MAX).await.unwrap(), ["cached".into()]);
    store.forget(&"cached".into()).await.unwrap();
    assert!(store.stage_result(made).await.unwrap().is_none(), "nobody needs it any more");
    store.gc(-1000).await.unwrap();
    assert!(store.blobs().list().unwrap().is_empty());
}
