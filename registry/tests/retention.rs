//! Tests of pruning, collection and deletion, and of the data that stays.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::{BTreeMap, BTreeSet};

use common::{artifact, fence, grant, metrics, open, result, rows, run_in};
use protocol::artifact::FileEntry;
use protocol::stage::{Keep, Mode};
use protocol::{ArtifactKind, Digest, Manifest, TaskId};
use registry::testing::slow::SlowBucket;
use registry::{BlobStore, Store, Write, WriteError};
use serde_json::json;

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
    let refused = store.prune_checkpoints(&task, joint, false).await.unwrap_err().to_string();
    assert!(refused.contains("`joint`") && refused.contains("they record loss"), "{refused}");
    assert_eq!(store.checkpoints(&task).await.unwrap().len(), 5, "nothing is lost by a metric that nobody saved");
    let gone = store.prune_checkpoints(&task, Keep { best: 1, ..Keep::default() }, false).await.unwrap();
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
    store.prune_checkpoints(&other, largest, false).await.unwrap();
    let steps: Vec<_> = store.checkpoints(&other).await.unwrap().iter().map(|c| c.step).collect();
    assert_eq!(steps, [5, 1], "the newest and the largest");
    store.prune_checkpoints(&other, Keep { latest: 1, ..Keep::default() }, false).await.unwrap();

    let ended = TaskId::new("r/u");
    store.write(vec![fence("r/u", 1)]).await.unwrap();
    for step in 1..=3 {
        let manifest = store.checkpoints(&task).await.unwrap()[0].manifest;
        store
            .write(vec![Write::Checkpoint { grant: grant("r/u", 1), step, manifest, metrics: metrics(&[]) }])
            .await
            .unwrap();
    }
    let two = Keep { ended: 2, ..Keep::default() };
    assert_eq!(store.prune_checkpoints(&ended, two, true).await.unwrap().len(), 1, "two were asked for");
    assert_eq!(
        store.prune_checkpoints(&ended, Keep::default(), true).await.unwrap().len(),
        2,
        "none is kept by default"
    );

    assert!(store.gc(60_000).await.unwrap().remove.is_empty(), "all is fresh");
    let plan = store.gc_plan(-1000).await.unwrap();
    assert_eq!(plan.remove.len(), 5, "two manifests, their files, and one blob");
    assert_eq!(store.gc(-1000).await.unwrap(), plan);
    assert!(store.gc(-1000).await.unwrap().remove.is_empty());
    let report = store.fsck().await.unwrap();
    assert_eq!((report.problems.as_slice(), report.blobs, report.references), (&[][..], 8, 4));
}

#[tokio::test]
async fn shards_go_once_their_run_is_finished_and_pins_stay() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let shard = |content| artifact(store.blobs(), ArtifactKind::Shard, content);
    let (first, second) = (shard("first"), shard("second"));
    store.write(vec![run_in("failed"), fence("r/s/0", 1), fence("r/s/1", 1)]).await.unwrap();
    for (task, output) in [("r/s/0", first), ("r/s/1", second)] {
        store.write(vec![Write::Shard { grant: grant(task, 1), output }]).await.unwrap();
    }
    store.pin(second, "to look at").await.unwrap();
    for state in ["failed", "cancelled", "paused", "running"] {
        store.write(vec![run_in(state)]).await.unwrap();
        assert!(store.gc(-1000).await.unwrap().remove.is_empty(), "a {state} run may go on");
        assert_eq!(store.shards(&"r".into()).await.unwrap().len(), 2, "a {state} run may go on");
    }
    store.write(vec![run_in("finished")]).await.unwrap();
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 2);
    assert!(store.shards(&"r".into()).await.unwrap().is_empty());
    assert!(store.blobs().exists(second).unwrap());
    assert!(store.fsck().await.unwrap().problems.is_empty());
    store.unpin(second).await.unwrap();
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 2);
}

/// The second damaged artifact has too many files for its references to be recorded.
#[tokio::test]
async fn a_damaged_root_stops_the_collection_unless_its_references_are_recorded() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let rot = |artifact: Digest| {
        let hex = artifact.hex();
        std::fs::write(dir.path().join("blobs/sha256").join(&hex[..2]).join(&hex[2..]), b"rot").unwrap();
    };
    let output = artifact(store.blobs(), ArtifactKind::Vae, "weights");
    store.write(vec![result("k", output)]).await.unwrap();
    let garbage = store.blobs().put(b"nobody needs this").unwrap();
    rot(output);
    assert_eq!(store.gc(-1000).await.unwrap().remove, [garbage]);
    assert!(store.blobs().exists(Digest::of(b"weights")).unwrap());

    let mut manifest = Manifest::new(ArtifactKind::Dataset, json!({}));
    let clip = FileEntry::of_blob(store.blobs().put(b"clip").unwrap(), 4);
    manifest.files = (0..1000).map(|i| (i.to_string(), clip.clone())).collect();
    let large = store.blobs().put(&manifest.to_bytes()).unwrap();
    store.pin(large, "to look at").await.unwrap();
    store.blobs().put(b"nobody needs this").unwrap();
    rot(large);
    let error = store.gc(-1000).await.unwrap_err();
    assert!(error.to_string().contains("pin (to look at)"), "{error}");
    assert_eq!(store.blobs().list().unwrap().len(), 5, "nothing went");
}

fn put_before(dir: &std::path::Path, digest: Digest, minutes: u64) {
    let hex = digest.hex();
    let path = dir.join("blobs/sha256").join(&hex[..2]).join(&hex[2..]);
    let at = std::time::SystemTime::now() - std::time::Duration::from_secs(minutes * 60);
    let file = std::fs::File::options().append(true).open(path).unwrap();
    file.set_times(std::fs::FileTimes::new().set_modified(at)).unwrap();
}

/// A restarted coordinator does not know the uploads of a worker that still holds its task.
#[tokio::test]
async fn no_grace_does_not_reach_behind_a_restart_while_a_run_is_under_way() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![run_in("running")]).await.unwrap();
    let uploaded = store.blobs().put(b"its outcome is on its way").unwrap();
    let old = store.blobs().put(b"older than any upload waits").unwrap();
    drop(store);
    put_before(dir.path(), uploaded, 10);
    put_before(dir.path(), old, 90);
    let store = open(dir.path()).await;
    assert_eq!(store.gc(0).await.unwrap().remove, [old]);
    store.write(vec![run_in("finished")]).await.unwrap();
    assert_eq!(store.gc(0).await.unwrap().remove, [uploaded]);
}

/// Uploads of a held task and blobs about to be named stay without any grace period, in the plan and in the collection.
/// Another process's plan keeps the ones it knows of.
#[tokio::test]
async fn what_no_row_names_yet_stays_as_long_as_somebody_may_name_it() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let uploaded = artifact(store.blobs(), ArtifactKind::Vae, "uploaded");
    let garbage = store.blobs().put(b"garbage").unwrap();
    let bundle = Manifest::new(ArtifactKind::Model, json!({"vae": uploaded})).to_bytes();
    // Only the manifest is held; the blobs that it lists are needed as well.
    store.hold(&"r/s".into(), uploaded).await.unwrap();
    let protected = store.blobs().protect(Digest::of(&bundle));
    let again = store.blobs().protect(Digest::of(&bundle));
    let bundle = store.blobs().put(&bundle).unwrap();
    drop(again);
    assert_eq!(store.gc_plan(-1000).await.unwrap().remove, [garbage]);
    let other = registry::ReadStore::open(dir.path()).await.unwrap();
    let seen = other.gc_plan(-1000).await.unwrap().remove;
    assert!(!seen.contains(&uploaded), "{seen:?}");
    assert_eq!(store.gc(-1000).await.unwrap().remove, [garbage]);
    assert!(store.blobs().complete_manifest(uploaded).is_ok() && store.blobs().exists(bundle).unwrap());

    store.let_go(registry::blob::IDLE, |_| false).await.unwrap();
    assert!(store.gc(-1000).await.unwrap().remove.is_empty(), "the bundle needs it");
    drop(protected);
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 3);
}

/// Rows name the uploads of held tasks, so that a process with nothing but the catalog and the blobs knows them.
#[tokio::test]
async fn uploads_of_held_tasks_are_known_to_the_next_process() {
    let (dir, bucket) = (tempfile::tempdir().unwrap(), SlowBucket::default());
    let store = common::open_over(dir.path(), bucket.place("p", dir.path())).await;
    let [uploaded, other] = ["uploaded", "of another task"].map(|text| store.blobs().put(text.as_bytes()).unwrap());
    store.hold(&"r/s".into(), uploaded).await.unwrap();
    store.hold(&"r/t".into(), other).await.unwrap();
    drop(store);
    let others = std::fs::read_dir(dir.path().join("blobs")).into_iter().flatten().flatten();
    let others: Vec<_> = others.map(|file| file.file_name()).filter(|name| name != "verified").collect();
    assert!(others.is_empty(), "files of this folder alone: {others:?}");

    let store = common::open_over(dir.path(), bucket.place("p", dir.path())).await;
    assert!(store.blobs().has_stored(&"r/s".into(), uploaded));
    store.let_go(registry::blob::IDLE, |task| task.as_str() == "r/s").await.unwrap();
    assert_eq!(store.gc(-1000).await.unwrap().remove, [other]);
    assert_eq!(store.held().await.unwrap(), BTreeMap::from([(TaskId::new("r/s"), BTreeSet::from([uploaded]))]));
}

/// A collection ends the uploads in parts of processes that are gone, a plan counts them, and a check lists them.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collection_ends_the_uploads_that_a_killed_process_left() {
    let (dir, bucket) = (tempfile::tempdir().unwrap(), SlowBucket::default());
    let store = common::open_over(dir.path(), bucket.place("p", dir.path())).await;
    // Another process's upload. Its requests are slow until its record is there, and then wait for this test.
    let (elsewhere, line) = (tempfile::tempdir().unwrap(), bucket.of_another());
    let blobs = BlobStore::over(line.place("p", elsewhere.path()));
    line.delay(std::time::Duration::from_millis(500));
    let sending = std::thread::spawn(move || blobs.put(&vec![7; 9 << 20]));
    let listed = async || store.fsck().await.unwrap().notes;
    while listed().await.is_empty() {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    line.silence(true);
    assert!(listed().await[0].contains("an upload in parts to `s3://slow/p/sha256/"), "{:?}", listed().await);
    assert_eq!(store.gc_plan(0).await.unwrap().uploads, 1);
    assert_eq!(store.gc(0).await.unwrap().uploads, 1);
    assert!(listed().await.is_empty() && store.gc(0).await.unwrap().uploads == 0);
    // It finds its upload ended, like a process that lost the lease.
    line.silence(false);
    assert!(sending.join().unwrap().is_err());
}

/// The writer of a blob has time to name it, even if collections run in between.
#[tokio::test]
async fn a_fresh_blob_outlives_a_collection_with_the_usual_grace() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let fresh = store.blobs().put(b"its row is on its way").unwrap();
    let used_again = store.blobs().put(b"put long ago, and again").unwrap();
    put_before(dir.path(), fresh, 1);
    put_before(dir.path(), used_again, 600);
    assert_eq!(store.gc_plan(registry::retention::GRACE_MS).await.unwrap().remove, [used_again]);
    store.blobs().put(b"put long ago, and again").unwrap();
    assert!(store.gc(registry::retention::GRACE_MS).await.unwrap().remove.is_empty());
}

/// Rows that name an old blob during a collection keep it; other blobs are removed, and no write waits for the end.
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

/// Makes a run with stages `made` and `spare`, each with a value, a checkpoint, a curve and a log.
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
    // Another run has the value of `made`; a third one is running and has stages of both names.
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

/// A sweep's trials other than the best, and work without a value, can be deleted while their run stays.
#[tokio::test]
async fn leftovers_of_ended_runs_go_and_what_their_stages_gave_stays() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let run = |run: &str| Write::Run {
        run: run.into(),
        pipeline: json!({"stages": [{"name": "pcm"}, {"name": "late"}]}),
        source: String::new(),
        state: "running".into(),
        idempotency_key: None,
    };
    store.write(vec![run("r")]).await.unwrap();
    let names = ["pcm.t00.r0", "pcm.t01.r0", "pcm.t01.r0.eval"];
    for stage in names {
        let output = artifact(store.blobs(), ArtifactKind::Model, &format!("value of {stage}"));
        let mut made = result(stage, output);
        if let Write::StageResult { stage: of, inputs, .. } = &mut made {
            *of = stage.into();
            inputs.clear();
        }
        store.write(vec![made]).await.unwrap();
    }
    let saved = artifact(store.blobs(), ArtifactKind::Checkpoint, "cancelled at 3");
    let checkpoint =
        Write::Checkpoint { grant: grant("r/late", 1), step: 3, manifest: saved, metrics: BTreeMap::new() };
    store.write(vec![fence("r/late", 1), checkpoint]).await.unwrap();
    // The swept stage has the value and the key of trial 1.
    let key = |name: &str| Digest::of(name.as_bytes());
    let mut stages: Vec<_> = names.iter().map(|name| json!({"name": name, "key": key(name), "of": "pcm"})).collect();
    stages.push(json!({"name": "pcm", "key": key("pcm.t01.r0")}));
    stages.push(json!({"name": "late", "key": key("late")}));
    let view = json!({ "stages": stages }).to_string();
    let ended = Write::RunEnded { run: "r".into(), state: "cancelled".into(), view, archive: "{}".into() };
    store.write(vec![ended]).await.unwrap();

    let none = registry::forget::Forgotten::default();
    assert_eq!(store.forget_leftovers(&"r".into(), 0).await.unwrap(), none, "it ended later than that");
    store.write(vec![run("other")]).await.unwrap();
    assert_eq!(store.forget_leftovers(&"r".into(), i64::MAX).await.unwrap(), none, "a run under way may use it");
    let over =
        Write::RunEnded { run: "other".into(), state: "finished".into(), view: "{}".into(), archive: "{}".into() };
    store.write(vec![over]).await.unwrap();

    let gone = store.forget_leftovers(&"r".into(), i64::MAX).await.unwrap();
    assert_eq!(
        (gone.results, gone.checkpoints),
        (2, 1),
        "the trial that lost, the best one's evaluation, the cancelled work"
    );
    assert_eq!(
        store.stage_results(&names.map(key)).await.unwrap().into_keys().collect::<Vec<_>>(),
        [key("pcm.t01.r0")]
    );
    assert!(store.run(&"r".into()).await.unwrap().is_some() && store.ended(&"r".into()).await.unwrap().is_some());
    assert_eq!(store.gc(-1000).await.unwrap().remove.len(), 6);
    assert!(store.fsck().await.unwrap().problems.is_empty());
}
