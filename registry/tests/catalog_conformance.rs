//! Conformance tests of catalogs, as functions over [`Catalog`], and the catalogs that must pass them.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::sync::{Arc, Mutex};

use cluster_tests::postgres::Postgres as Server;
use common::{artifact, fence, grant, metrics, result, rows, version};
use futures::future::join_all;
use protocol::stage::Keep;
use protocol::{Alias, ArtifactKind, Digest, FileEntry, Manifest, ModelName, RunId, StageName, TaskId};
use registry::catalog::{Catalog, Done, Order, PromoteOrder, Records, References, RollbackOrder, Which};
use registry::testing::slow::SlowBucket;
use registry::versions::Action;
use registry::{
    BlobStore, Expect, Holder, LeaderTerms, Page, Pick, PostgresCatalog, QueryError, RunListQuery, RunOrder, Store,
    Write, WriteError,
};
use serde_json::json;
use tempfile::TempDir;

/// Place of a catalog, with its way of opening.
trait Place {
    /// Opens the catalog for writing, as a process without knowledge of others does; open handles stay open.
    fn open(&self) -> impl Future<Output = Opened>;
}

struct Opened {
    store: Store,
    bucket: SlowBucket,
}

impl Opened {
    fn catalog(&self) -> &dyn Catalog {
        self.store.catalog()
    }

    fn records(&self) -> Arc<dyn Records> {
        self.catalog().records()
    }

    fn blobs(&self) -> &BlobStore {
        self.store.blobs()
    }

    async fn write(&self, writes: Vec<Write>) -> Result<(), WriteError> {
        self.store.write(writes).await
    }
}

/// SQLite in a store's folder, with blobs in a bucket.
struct Sqlite(TempDir, SlowBucket);

impl Place for Sqlite {
    async fn open(&self) -> Opened {
        // A new file under the lock's name bypasses the operating system's lock, so that only the epoch protects the
        // store.
        let _ = fs::remove_file(self.0.path().join("lock"));
        let blobs = self.1.place("p", self.0.path());
        Opened { store: common::open_over(self.0.path(), blobs).await, bucket: self.1.clone() }
    }
}

/// PostgreSQL in a database of its own, with blobs in a bucket. Every opening has a folder of its own, as on another machine.
struct Postgres {
    server: &'static Server,
    database: String,
    folders: Mutex<Vec<TempDir>>,
    bucket: SlowBucket,
}

impl Postgres {
    /// Returns a new place; `None` where PostgreSQL is not installed.
    fn new() -> Option<Self> {
        let server = Server::shared()?;
        let (folders, bucket) = (Mutex::default(), SlowBucket::default());
        Some(Self { server, database: server.create(), folders, bucket })
    }
}

impl Place for Postgres {
    async fn open(&self) -> Opened {
        // The leader's time is over, but its session is open. Only the epoch protects the store.
        let over = "DO $$ BEGIN IF to_regclass('leader') IS NOT NULL THEN UPDATE leader SET until = '-infinity'; END IF; END $$";
        self.server.sql(&self.database, over);
        let terms = LeaderTerms { terminates: false, ..LeaderTerms::default() };
        let catalog = PostgresCatalog { address: self.server.address(&self.database).parse().unwrap(), terms };
        let dir = tempfile::tempdir().unwrap();
        let blobs = self.bucket.place("p", dir.path());
        let store = Store::open_on_over(&catalog, dir.path(), blobs, Holder::this_process("test")).await.unwrap();
        self.folders.lock().unwrap().push(dir);
        Opened { store, bucket: self.bucket.clone() }
    }
}

macro_rules! conformance {
    ($($name:ident),+ $(,)?) => {
        mod postgres {
            $(#[tokio::test]
            async fn $name() {
                if let Some(place) = super::Postgres::new() {
                    super::$name(&place).await;
                }
            })+
        }

        mod sqlite {
            use super::SlowBucket;

            $(#[tokio::test]
            async fn $name() {
                super::$name(&super::Sqlite(tempfile::tempdir().unwrap(), SlowBucket::default())).await;
            })+
        }
    };
}

conformance![
    a_new_catalog_says_which_store_it_is_and_counts_its_commits,
    an_order_is_all_or_nothing_and_fails_alone,
    the_last_to_open_is_the_only_one_that_writes,
    what_was_acknowledged_is_there_for_who_opens_next,
    facts_are_numbered_and_go_behind_a_snapshot,
    a_snapshot_is_its_parts_as_they_were_last_written,
    a_write_carries_the_newest_fence,
    values_and_lines_that_come_twice_count_once,
    the_newest_attempt_takes_over_from_its_first_step,
    a_row_names_only_what_is_whole,
    a_commit_waits_for_no_place_of_blobs,
    what_a_collection_condemns_is_proven_anew,
    what_a_row_has_named_is_known_to_be_present,
    a_step_has_one_state_and_a_policy_says_which_stay,
    the_first_value_of_a_key_stands,
    a_key_of_a_submission_is_one_runs,
    a_run_that_ended_answers_from_its_view_until_it_is_forgotten,
    versions_are_numbered_and_never_made_twice,
    an_alias_moves_by_compare_and_swap_and_its_log_grows,
    gates_are_judged_on_what_is_stored,
    lineage_goes_back_to_the_beginning,
    needs_name_every_row_that_names_a_blob,
    blobs_are_held_until_their_task_is_let_go,
    a_collection_begins_by_forgetting_the_shards_of_what_is_done,
    a_copy_is_of_one_moment,
];

fn facts(seq: u64) -> Write {
    Write::Facts { seq, facts: json!({"decision": seq}).to_string() }
}

fn run(run: &str, key: Option<&str>) -> Write {
    Write::Run {
        run: run.into(),
        pipeline: json!({"name": run, "stages": []}),
        source: format!("name: {run}\n"),
        state: "running".into(),
        idempotency_key: key.map(str::to_owned),
    }
}

fn ended(run: &str, state: &str) -> Write {
    Write::RunEnded {
        run: run.into(),
        state: state.into(),
        view: json!({"run": run, "stages": []}).to_string(),
        archive: json!({"archived": run}).to_string(),
    }
}

fn promote(to: Pick, expect: Option<Expect>, require: &[&str]) -> Order {
    Order::Promote(PromoteOrder {
        model: "m".into(),
        alias: Alias::new("staging"),
        to: Which::Pick(to),
        expect,
        require: require.iter().map(|gate| (*gate).to_owned()).collect(),
        reason: "a test".into(),
        actor: "tester".into(),
    })
}

fn rollback(to: Option<u64>) -> Order {
    Order::Rollback(RollbackOrder {
        model: "m".into(),
        alias: Alias::new("staging"),
        to,
        expect: None,
        reason: "a test".into(),
        actor: "tester".into(),
    })
}

async fn moved(opened: &Opened, order: Order) -> Result<(Option<u64>, u64), WriteError> {
    match opened.catalog().commit(order).await? {
        Done::Promoted(moved) => Ok((moved.from, moved.to)),
        done => panic!("{done:?}"),
    }
}

async fn a_new_catalog_says_which_store_it_is_and_counts_its_commits(place: &impl Place) {
    let opened = place.open().await;
    let first = opened.records().stored().await.unwrap().unwrap();
    opened.write(vec![facts(1)]).await.unwrap();
    opened.write(vec![facts(2)]).await.unwrap();
    let then = opened.records().stored().await.unwrap().unwrap();
    assert_eq!((&then.id, then.epoch), (&first.id, first.epoch));
    assert_eq!(then.commits, first.commits + 2);
    drop(opened);
    let again = place.open().await.records().stored().await.unwrap().unwrap();
    assert_eq!(again.id, first.id);
    assert!(again.epoch > first.epoch && again.commits > then.commits, "{again:?}");
}

async fn an_order_is_all_or_nothing_and_fails_alone(place: &impl Place) {
    let opened = place.open().await;
    opened.write(vec![fence("r/s", 2)]).await.unwrap();
    let stale = Write::Metrics { grant: grant("r/s", 1), rows: rows(0..3, 1.0) };
    // Concurrent, so that they may share a transaction.
    let (one, refused, other) = tokio::join!(
        opened.write(vec![run("a", None)]),
        opened.write(vec![run("b", None), stale, run("c", None)]),
        opened.write(vec![run("d", None)]),
    );
    one.unwrap();
    other.unwrap();
    assert!(matches!(refused, Err(WriteError::StaleFence { .. })));
    let runs: BTreeSet<_> = opened.records().runs().await.unwrap().into_iter().map(|row| row.run).collect();
    assert_eq!(runs, ["a", "d"].map(RunId::new).into());
}

async fn the_last_to_open_is_the_only_one_that_writes(place: &impl Place) {
    let first = place.open().await;
    first.write(vec![facts(1)]).await.unwrap();
    let second = place.open().await;
    let late = join_all([first.write(vec![facts(2)]), first.write(vec![run("r", None)])]).await;
    for refused in late {
        assert!(matches!(refused, Err(WriteError::Superseded { .. })), "{refused:?}");
    }
    let order = Order::Pin { digest: Digest::of(b"x"), reason: None };
    assert!(matches!(first.catalog().commit(order).await, Err(WriteError::Superseded { .. })), "every order");
    second.write(vec![facts(2)]).await.unwrap();
    assert_eq!(second.records().recovery().await.unwrap().facts.len(), 2);
    assert!(second.records().runs().await.unwrap().is_empty());
}

async fn what_was_acknowledged_is_there_for_who_opens_next(place: &impl Place) {
    let opened = place.open().await;
    let all = join_all((1..=40).map(|i| opened.write(vec![run(&format!("r{i}"), None)]))).await;
    assert!(all.iter().all(Result::is_ok));
    assert_eq!(opened.records().runs().await.unwrap().len(), 40, "an answer is of every commit before the question");
    drop(opened);
    assert_eq!(place.open().await.records().runs().await.unwrap().len(), 40);
}

async fn facts_are_numbered_and_go_behind_a_snapshot(place: &impl Place) {
    let opened = place.open().await;
    opened.write((1..=5).map(facts).collect()).await.unwrap();
    assert!(opened.write(vec![facts(5)]).await.is_err(), "a number that is taken");
    assert!(opened.write(vec![facts(3)]).await.is_err());
    opened.write(vec![Write::Snapshot { seq: 4, state: json!({"as of": 4}).to_string() }]).await.unwrap();
    let recovery = opened.records().recovery().await.unwrap();
    assert_eq!(recovery.snapshot, Some((4, json!({"as of": 4}).to_string())));
    assert_eq!(recovery.facts, [(5, json!({"decision": 5}).to_string())]);
    opened.write(vec![facts(6), Write::Snapshot { seq: 5, state: json!({"as of": 5}).to_string() }]).await.unwrap();
    let recovery = opened.records().recovery().await.unwrap();
    assert_eq!((recovery.snapshot.unwrap().0, recovery.facts.len(), recovery.facts[0].0), (5, 1, 6));
    assert!(opened.write(vec![facts(2)]).await.is_err(), "what a snapshot stands for is taken");
}

async fn a_snapshot_is_its_parts_as_they_were_last_written(place: &impl Place) {
    let opened = place.open().await;
    opened.write((1..=9).map(facts).collect()).await.unwrap();
    let text = |text: &str| Some(json!(text).to_string());
    let parts = |seq, parts: &[(&str, Option<String>)]| {
        let parts = parts.iter().map(|(part, state)| ((*part).to_owned(), state.clone())).collect();
        Write::SnapshotParts { seq, parts }
    };
    let whole = |seq| Write::Snapshot { seq, state: json!(seq).to_string() };
    opened.write(vec![parts(2, &[("a", text("a2")), ("b", text("b2")), ("c", text("c2"))]), whole(2)]).await.unwrap();
    // An incomplete snapshot has no effect.
    opened.write(vec![parts(4, &[("a", text("a4")), ("b", None), ("d", text("d4"))])]).await.unwrap();
    let read = async |opened: &Opened| opened.records().recovery().await.unwrap().parts;
    let known = |parts: &[(&str, &str)]| {
        parts.iter().map(|(part, state)| ((*part).to_owned(), json!(state).to_string())).collect::<BTreeMap<_, _>>()
    };
    assert_eq!(read(&opened).await, known(&[("a", "a2"), ("b", "b2"), ("c", "c2")]));
    // Its parts have no effect later either.
    opened.write(vec![parts(6, &[("c", None), ("e", text("e6"))])]).await.unwrap();
    opened.write(vec![whole(6)]).await.unwrap();
    assert_eq!(read(&opened).await, known(&[("a", "a2"), ("b", "b2"), ("e", "e6")]));
    opened.write(vec![parts(8, &[("a", text("a8"))]), whole(8)]).await.unwrap();
    assert_eq!(read(&opened).await, known(&[("a", "a8"), ("b", "b2"), ("e", "e6")]));
    let recovery = opened.records().recovery().await.unwrap();
    assert_eq!((recovery.snapshot, recovery.facts.len()), (Some((8, "8".to_owned())), 1));
}

async fn a_write_carries_the_newest_fence(place: &impl Place) {
    let opened = place.open().await;
    let write = |f| vec![Write::Metrics { grant: grant("r/s", f), rows: rows(0..1, f as f64) }];
    assert!(matches!(opened.write(write(1)).await, Err(WriteError::Conflict(_))), "never granted");
    // Granted and used in one order.
    opened.write([vec![fence("r/s", 3)], write(3)].concat()).await.unwrap();
    assert!(matches!(opened.write(write(4)).await, Err(WriteError::Conflict(_))));
    assert!(matches!(opened.write(write(2)).await, Err(WriteError::StaleFence { .. })));
    for old in [2, 3] {
        assert!(matches!(opened.write(vec![fence("r/s", old)]).await, Err(WriteError::StaleFence { .. })));
    }
    opened.write(vec![fence("r/s", 7)]).await.unwrap();
    assert!(matches!(opened.write(write(3)).await, Err(WriteError::StaleFence { .. })));
}

async fn values_and_lines_that_come_twice_count_once(place: &impl Place) {
    let opened = place.open().await;
    let lines = |first, lines: &[&str]| Write::Logs {
        grant: grant("r/s", 1),
        first,
        lines: lines.iter().map(|line| (*line).to_owned()).collect(),
    };
    opened.write(vec![fence("r/s", 1)]).await.unwrap();
    for _ in 0..2 {
        let values = Write::Metrics { grant: grant("r/s", 1), rows: rows(0..10, 0.5) };
        opened.write(vec![values, lines(0, &["a", "b"])]).await.unwrap();
    }
    let more = Write::Metrics { grant: grant("r/s", 1), rows: rows(5..12, 0.7) };
    opened.write(vec![more, lines(1, &["b", "c"])]).await.unwrap();
    let (records, run, stage) = (opened.records(), RunId::new("r"), StageName::new("s"));
    let curves = records.points(&run, &stage, None, Page::ALL).await.unwrap();
    let values: Vec<_> = curves["loss"].points.iter().map(|point| (point.step, point.value)).collect();
    let expected: Vec<_> = (0..12).map(|step| (step, if step < 10 { 0.5 } else { 0.7 })).collect();
    assert_eq!(values, expected);
    assert!(records.points(&run, &stage, Some(&["other".into()]), Page::ALL).await.unwrap().is_empty());
    let lines = records.logs(&run, None, 0, 10).await.unwrap();
    assert_eq!(lines.iter().map(|line| line.text.as_str()).collect::<Vec<_>>(), ["a", "b", "c"]);
    for count in 0..=lines.len() {
        let last = records.last_logs(&run, None, u32::try_from(count).unwrap()).await.unwrap();
        assert_eq!(last, lines[lines.len() - count..], "the newest {count}");
    }
    assert!(records.last_logs(&run, Some(&"other".into()), 10).await.unwrap().is_empty());
    let rest = records.logs(&run, Some(&stage), lines[0].id, 1).await.unwrap();
    assert_eq!(rest, lines[1..2]);
    assert!(records.logs(&run, Some(&"other".into()), 0, 10).await.unwrap().is_empty());
}

async fn the_newest_attempt_takes_over_from_its_first_step(place: &impl Place) {
    let opened = place.open().await;
    for (attempt, steps) in [(1, 0..10), (2, 6..8), (3, 7..12)] {
        let values = Write::Metrics { grant: grant("r/s", attempt), rows: rows(steps, attempt as f64) };
        opened.write(vec![fence("r/s", attempt), values]).await.unwrap();
    }
    let curves = opened.records().points(&"r".into(), &"s".into(), Some(&["loss".into()]), Page::ALL).await.unwrap();
    let values: Vec<_> = curves["loss"].points.iter().map(|point| point.value).collect();
    assert_eq!(values, [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0]);
}

async fn a_row_names_only_what_is_whole(place: &impl Place) {
    let opened = place.open().await;
    opened.write(vec![fence("r/s", 1)]).await.unwrap();
    let absent = Digest::of(b"nowhere");
    let plain = opened.blobs().put(b"not a manifest").unwrap();
    for named in [absent, plain] {
        let writes = [
            Write::Checkpoint { grant: grant("r/s", 1), step: 1, manifest: named, metrics: BTreeMap::new() },
            Write::Shard { grant: grant("r/s", 1), output: named },
            result("key", named),
            version("m", named, 0.5),
        ];
        for write in writes {
            let what = format!("{write:?}");
            assert!(opened.write(vec![write]).await.is_err(), "{what}");
        }
        let pin = Order::Pin { digest: named, reason: Some("a test".into()) };
        assert!(opened.catalog().commit(pin).await.is_err());
    }
    assert!(opened.records().needs().await.unwrap().roots.is_empty());
    assert!(opened.records().models().await.unwrap().is_empty());
}

/// A commit that sent a request would wait for the bucket.
async fn a_commit_waits_for_no_place_of_blobs(place: &impl Place) {
    let opened = place.open().await;
    opened.write(vec![fence("r/s", 1)]).await.unwrap();
    let made = artifact(opened.blobs(), ArtifactKind::Model, "made");
    let names = || {
        let grant = || grant("r/s", 1);
        [
            Order::Write(vec![Write::Checkpoint { grant: grant(), step: 1, manifest: made, metrics: BTreeMap::new() }]),
            Order::Write(vec![Write::Shard { grant: grant(), output: made }]),
            Order::Write(vec![result("key", made)]),
            Order::Write(vec![version("m", made, 0.5)]),
            Order::Pin { digest: made, reason: Some("a test".into()) },
        ]
    };
    for order in names() {
        let refused = opened.catalog().commit(order).await;
        assert!(matches!(refused, Err(WriteError::Unproven { artifact }) if artifact == made), "{refused:?}");
    }
    assert!(opened.records().needs().await.unwrap().roots.is_empty());

    let proof = opened.store.prove(made).await.unwrap();
    opened.bucket.silence(true);
    let before = opened.bucket.requests();
    let others = [
        promote(Pick::Number(1), None, &[]),
        Order::Promote(PromoteOrder {
            model: "m".into(),
            alias: Alias::new("staging"),
            to: Which::Artifact(made),
            expect: None,
            require: Vec::new(),
            reason: "a test".into(),
            actor: "tester".into(),
        }),
        Order::BeginCollection,
        Order::Condemn(vec![made, Digest::of(b"other")]),
        Order::PruneCheckpoints { task: "r/s".into(), keep: Keep::default(), at_end: false },
        Order::Pin { digest: made, reason: None },
    ];
    for order in names().into_iter().chain(others) {
        let what = format!("{order:?}");
        let committing = tokio::time::timeout(std::time::Duration::from_secs(20), opened.catalog().commit(order));
        committing.await.unwrap_or_else(|_| panic!("waits for the bucket: {what}")).unwrap();
    }
    assert!(opened.bucket.requests() <= before + 4, "the lease alone asks");
    drop(proof);
    opened.bucket.silence(false);
}

async fn what_a_collection_condemns_is_proven_anew(place: &impl Place) {
    let opened = place.open().await;
    let commit = async |order| opened.catalog().commit(order).await;
    let made = artifact(opened.blobs(), ArtifactKind::Vae, "made");
    let file = Digest::of(b"made");
    let proof = opened.store.prove(made).await.unwrap();
    commit(Order::BeginCollection).await.unwrap();
    match commit(Order::Condemn(vec![file])).await.unwrap() {
        Done::Condemned(taken) => assert_eq!(taken, [file]),
        done => panic!("{done:?}"),
    }
    let named = || Order::Write(vec![result("key", made)]);
    assert!(matches!(commit(named()).await, Err(WriteError::Unproven { .. })), "its file is about to go");
    assert!(opened.records().needs().await.unwrap().roots.is_empty());
    drop(proof);

    // A row that comes first keeps the blobs, the digests in the manifest's `meta` and the inputs.
    let other = artifact(opened.blobs(), ArtifactKind::Vae, "other");
    let _proof = opened.store.prove(other).await.unwrap();
    commit(Order::Write(vec![result("other", other)])).await.unwrap();
    let needed = vec![other, Digest::of(b"other"), Digest::of(b"data")];
    match commit(Order::Condemn(needed)).await.unwrap() {
        Done::Condemned(taken) => assert!(taken.is_empty(), "{taken:?}"),
        done => panic!("{done:?}"),
    }
}

async fn what_a_row_has_named_is_known_to_be_present(place: &impl Place) {
    const FILES: usize = 40;
    let opened = place.open().await;
    let mut manifest = Manifest::new(ArtifactKind::Vae, json!({"teacher": Digest::of(b"teacher")}));
    for i in 0..FILES {
        let digest = opened.blobs().put(format!("file {i}").as_bytes()).unwrap();
        manifest.files.insert(i.to_string(), FileEntry::of_blob(digest, format!("file {i}").len() as u64));
    }
    let made = opened.blobs().put(&manifest.to_bytes()).unwrap();
    let listed: Vec<Digest> = manifest.files.values().map(|file| file.digest).collect();
    let all = [&[made, Digest::of(b"never put")], &listed[..]].concat();
    assert!(opened.records().present(&all).await.unwrap().is_empty());
    opened.write(vec![result("key", made)]).await.unwrap();
    drop(opened);
    let opened = place.open().await;
    let known = opened.records().present(&all).await.unwrap();
    assert_eq!((known.len(), known.get(&Digest::of(b"file 0"))), (FILES + 1, Some(&6)));
    let references = References { blobs: listed, mentioned: vec![Digest::of(b"teacher")] };
    assert_eq!(opened.records().references(&all).await.unwrap(), [(made, references)]);
    // The manifest is read again, but its files are not requested.
    let before = opened.bucket.requests();
    drop(opened.store.prove(made).await.unwrap());
    let asked = opened.bucket.requests() - before;
    assert!(asked < FILES as u64 / 2, "{asked}");
    opened.catalog().commit(Order::Condemn(all.clone())).await.unwrap();
    assert!(opened.records().present(&all).await.unwrap().is_empty(), "nobody relies on it any more");
    assert!(opened.records().references(&all).await.unwrap().is_empty());
}

async fn a_step_has_one_state_and_a_policy_says_which_stay(place: &impl Place) {
    let opened = place.open().await;
    opened.write(vec![fence("r/s", 1)]).await.unwrap();
    let save = |step: u64, content: &str| {
        let manifest = artifact(opened.blobs(), ArtifactKind::Checkpoint, content);
        let metrics = metrics(&[("loss", 10.0 - step as f64)]);
        Write::Checkpoint { grant: grant("r/s", 1), step, manifest, metrics }
    };
    for step in 1..=4 {
        opened.write(vec![save(step, &format!("at {step}"))]).await.unwrap();
    }
    opened.write(vec![save(4, "at 4")]).await.unwrap();
    assert!(matches!(opened.write(vec![save(4, "another")]).await, Err(WriteError::Conflict(_))));
    let (records, task) = (opened.records(), TaskId::new("r/s"));
    let steps = async || -> Vec<u64> {
        records.checkpoints(&task).await.unwrap().iter().map(|checkpoint| checkpoint.step).collect()
    };
    assert_eq!(steps().await, [4, 3, 2, 1]);
    assert_eq!(records.latest_checkpoint(&task).await.unwrap().unwrap().step, 4);
    let keep: Keep = serde_json::from_value(json!({"last": 2})).unwrap();
    match opened.catalog().commit(Order::PruneCheckpoints { task: task.clone(), keep, at_end: false }).await.unwrap() {
        Done::Pruned(gone) => assert_eq!(gone.len(), 2),
        done => panic!("{done:?}"),
    }
    assert_eq!(steps().await, [4, 3]);
}

async fn the_first_value_of_a_key_stands(place: &impl Place) {
    let opened = place.open().await;
    let (one, other) =
        (artifact(opened.blobs(), ArtifactKind::Vae, "one"), artifact(opened.blobs(), ArtifactKind::Vae, "other"));
    opened.write(vec![result("key", one)]).await.unwrap();
    opened.write(vec![result("key", one)]).await.unwrap();
    assert!(matches!(opened.write(vec![result("key", other)]).await, Err(WriteError::Conflict(_))));
    let key = Digest::of(b"key");
    let found = opened.records().stage_results(&[key, Digest::of(b"unknown")]).await.unwrap();
    assert_eq!(found.keys().collect::<Vec<_>>(), [&key]);
    assert_eq!(found[&key].outputs["vae"], one);
    assert!(found[&key].metrics["bad"].is_nan(), "what is no number comes back as such");
    assert_eq!(opened.records().stage_result(key).await.unwrap().unwrap().outputs, found[&key].outputs);
    assert_eq!(opened.records().sources(&[key]).await.unwrap()[&key], ("r".into(), "s".into()));
}

async fn a_key_of_a_submission_is_one_runs(place: &impl Place) {
    let opened = place.open().await;
    opened.write(vec![run("a", Some("once"))]).await.unwrap();
    opened.write(vec![run("a", Some("once"))]).await.unwrap();
    assert!(matches!(opened.write(vec![run("b", Some("once"))]).await, Err(WriteError::Conflict(_))));
    let records = opened.records();
    assert_eq!(records.run_by_key("once").await.unwrap().unwrap().run.as_str(), "a");
    assert_eq!(records.run_by_key("never").await.unwrap(), None);
    assert_eq!(records.run(&"a".into()).await.unwrap().unwrap().source, "name: a\n");
}

async fn a_run_that_ended_answers_from_its_view_until_it_is_forgotten(place: &impl Place) {
    let opened = place.open().await;
    let records = opened.records();
    opened.write(vec![run("a", None), run("b", None), run("c", None)]).await.unwrap();
    assert_eq!(records.ended(&"a".into()).await.unwrap(), None);
    let refused = opened.catalog().commit(Order::Forget("a".into())).await;
    assert!(matches!(refused, Err(WriteError::Conflict(_))), "it is running");
    opened.write(vec![ended("a", "finished"), ended("b", "failed")]).await.unwrap();
    let asked = RunListQuery { limit: 10, order: RunOrder::Oldest, ..RunListQuery::default() };
    let listed = records.run_list(&asked).await.unwrap();
    let states: Vec<_> = listed.rows.iter().map(|row| (row.run.as_str(), row.state.name())).collect();
    assert_eq!(states, [("a", "finished"), ("b", "failed"), ("c", "running")]);
    let asked = RunListQuery { limit: 1, ..RunListQuery::default() };
    let newest = records.run_list(&asked).await.unwrap();
    assert_eq!(newest.rows[0].run.as_str(), "c");
    let before = records.run_list(&RunListQuery { after: newest.next, ..asked }).await.unwrap();
    assert_eq!((before.rows[0].run.as_str(), before.next.is_some()), ("b", true));
    assert!(records.ended(&"a".into()).await.unwrap().unwrap().archive.contains("archived"));
    assert_eq!(records.ended_before(i64::MAX).await.unwrap().len(), 2);
    assert!(records.ended_before(0).await.unwrap().is_empty());
    assert!(matches!(opened.catalog().commit(Order::Forget("a".into())).await.unwrap(), Done::Forgotten(_)));
    assert_eq!(records.run(&"a".into()).await.unwrap(), None);
    let refused = opened.catalog().commit(Order::Forget("a".into())).await;
    assert!(matches!(refused, Err(WriteError::NotFound(_))));
}

async fn registered(opened: &Opened, fids: &[f64]) {
    for (i, fid) in fids.iter().enumerate() {
        let model = artifact(opened.blobs(), ArtifactKind::Model, &format!("model {i}"));
        opened.write(vec![version("m", model, *fid)]).await.unwrap();
    }
}

async fn versions_are_numbered_and_never_made_twice(place: &impl Place) {
    let opened = place.open().await;
    registered(&opened, &[0.5, 0.2, f64::NAN]).await;
    let again = artifact(opened.blobs(), ArtifactKind::Model, "model 1");
    let more = Write::Version {
        model: "m".into(),
        artifact: again,
        metrics: metrics(&[("fid", 0.1)]),
        source: json!({"metric": "latent_fid", "mode": "min"}),
    };
    opened.write(vec![more]).await.unwrap();
    let vae = artifact(opened.blobs(), ArtifactKind::Vae, "vae");
    assert!(opened.write(vec![version("m", vae, 0.1)]).await.is_err(), "it is not a model");
    let (records, name) = (opened.records(), ModelName::new("m"));
    let versions = records.versions(&name).await.unwrap();
    assert_eq!(versions.iter().map(|v| v.version).collect::<Vec<_>>(), [1, 2, 3]);
    assert_eq!(versions[1].metrics, metrics(&[("latent_fid", 0.2), ("fid", 0.1)]), "metrics are added");
    assert_eq!(records.version_of(&name, again).await.unwrap().as_ref(), versions.get(1));
    assert_eq!(records.version_of(&name, vae).await.unwrap(), None);
    assert!(records.has_model(&name).await.unwrap());
    assert!(!records.has_model(&ModelName::new("none")).await.unwrap());
    let (model, _) = records.model(&name).await.unwrap().unwrap();
    assert_eq!((model.versions, model.best), (3, Some(2)));
    for (reference, version) in [("m@best", 2), ("m@latest", 3), ("m:1", 1)] {
        assert_eq!(records.resolve(reference).await.unwrap().version, version, "{reference}");
    }
    for reference in ["m:9", "m@prod", "other:1"] {
        assert!(matches!(records.resolve(reference).await, Err(QueryError::NotFound(_))), "{reference}");
    }
    assert!(matches!(records.resolve("m").await, Err(QueryError::Invalid(_))));
}

async fn an_alias_moves_by_compare_and_swap_and_its_log_grows(place: &impl Place) {
    let opened = place.open().await;
    registered(&opened, &[0.5, 0.2, 0.9]).await;
    assert_eq!(moved(&opened, promote(Pick::Number(1), Some(Expect::None), &[])).await.unwrap(), (None, 1));
    let late = moved(&opened, promote(Pick::Number(2), Some(Expect::None), &[])).await;
    assert!(matches!(late, Err(WriteError::Conflict(_))));
    // Of many moves with the same expectation, one succeeds.
    let all = join_all((0..8).map(|i| moved(&opened, promote(Pick::Number(2 + i % 2), Some(Expect::Version(1)), &[]))));
    let winners = all.await.into_iter().filter(|result| result.as_ref().is_ok_and(|m| m.0 == Some(1))).count();
    assert_eq!(winners, 1);
    let records = opened.records();
    let at = records.resolve("m@staging").await.unwrap().version;
    moved(&opened, promote(Pick::Number(at), None, &[])).await.unwrap();
    assert_eq!(records.history(&"m".into(), None).await.unwrap().len(), 2, "no move, no entry");
    assert_eq!(moved(&opened, rollback(None)).await.unwrap(), (Some(at), 1));
    assert!(matches!(moved(&opened, rollback(None)).await, Err(WriteError::NotFound(_))), "nothing before");
    assert_eq!(moved(&opened, rollback(Some(3))).await.unwrap(), (Some(1), 3));
    let log = records.history(&"m".into(), Some(&Alias::new("staging"))).await.unwrap();
    let actions: Vec<_> = log.iter().map(|entry| (entry.action, entry.to)).collect();
    assert_eq!(actions, [(Action::Promote, 1), (Action::Promote, at), (Action::Rollback, 1), (Action::Rollback, 3)]);
    assert!(log.iter().all(|entry| entry.actor == "tester" && entry.reason == "a test"));
    assert!(records.history(&"m".into(), Some(&Alias::new("prod"))).await.unwrap().is_empty());
}

async fn gates_are_judged_on_what_is_stored(place: &impl Place) {
    let opened = place.open().await;
    registered(&opened, &[0.5, 0.2]).await;
    let first = promote(Pick::Number(1), None, &["latent_fid <= 0.6", "latent_fid <= staging + 0"]);
    moved(&opened, first).await.unwrap();
    let worse = moved(&opened, promote(Pick::Number(2), None, &["latent_fid <= 0.1"])).await;
    assert!(matches!(worse, Err(WriteError::Gate(_))), "{worse:?}");
    let unknown = moved(&opened, promote(Pick::Number(2), None, &["latent_fid <= prod"])).await;
    assert!(matches!(unknown, Err(WriteError::NotFound(_))), "{unknown:?}");
    assert!(moved(&opened, promote(Pick::Number(2), None, &["no gate"])).await.is_err());
    assert_eq!(opened.records().resolve("m@staging").await.unwrap().version, 1, "nothing moved");
    let better = promote(Pick::Best, None, &["latent_fid <= staging - 0.2"]);
    assert_eq!(moved(&opened, better).await.unwrap(), (Some(1), 2));
    let log = opened.records().history(&"m".into(), None).await.unwrap();
    assert_eq!(log[1].gates[0].value, Some(0.2));
}

async fn lineage_goes_back_to_the_beginning(place: &impl Place) {
    let opened = place.open().await;
    let (vae, denoiser) =
        (artifact(opened.blobs(), ArtifactKind::Vae, "vae"), artifact(opened.blobs(), ArtifactKind::Denoiser, "mld"));
    opened.write(vec![result("vae", vae)]).await.unwrap();
    let Write::StageResult { run, stage, kind, metrics, wall_s, .. } = result("mld", denoiser) else { unreachable!() };
    let made = Write::StageResult {
        grant: None,
        key: Digest::of(b"mld"),
        run,
        stage,
        kind,
        outputs: [("denoiser".to_owned(), denoiser)].into(),
        metrics,
        inputs: [("vae".to_owned(), vae)].into(),
        wall_s,
    };
    opened.write(vec![made]).await.unwrap();
    let nodes = opened.records().lineage(denoiser).await.unwrap();
    let shape: Vec<_> = nodes.iter().map(|node| (node.digest, node.depth, node.kind.as_deref())).collect();
    let data = Digest::of(b"data");
    assert_eq!(shape, [(denoiser, 0, Some("denoiser")), (vae, 1, Some("vae")), (data, 2, None)]);
    assert_eq!(nodes[0].inputs["vae"], vae);
}

async fn needs_name_every_row_that_names_a_blob(place: &impl Place) {
    let opened = place.open().await;
    let of = |kind, content: &str| artifact(opened.blobs(), kind, content);
    let checkpoint = of(ArtifactKind::Checkpoint, "checkpoint");
    let (shard, value, model, pinned) = (
        of(ArtifactKind::Latents, "shard"),
        of(ArtifactKind::Vae, "value"),
        of(ArtifactKind::Model, "model"),
        of(ArtifactKind::Vae, "pinned"),
    );
    opened
        .write(vec![
            run("r", None),
            fence("r/s", 1),
            Write::Checkpoint { grant: grant("r/s", 1), step: 1, manifest: checkpoint, metrics: BTreeMap::new() },
            Write::Shard { grant: grant("r/s", 1), output: shard },
            result("key", value),
            version("m", model, 0.5),
        ])
        .await
        .unwrap();
    opened.store.pin(pinned, "kept").await.unwrap();
    let needs = opened.records().needs().await.unwrap();
    let found: BTreeSet<_> = needs.roots.iter().copied().collect();
    assert_eq!(found, [checkpoint, shard, value, model, pinned].into());
    assert!(needs.roots.is_sorted() && needs.roots.len() == 5, "{:?}", needs.roots);
    assert_eq!(needs.parents[&value], [Digest::of(b"data")]);
    assert!(!needs.parents.contains_key(&model), "a root is marked anyway");
    for (artifact, name) in [
        (checkpoint, "checkpoint of"),
        (shard, "shard `"),
        (value, "output `"),
        (model, "version m:1"),
        (pinned, "pin (kept)"),
    ] {
        let described = opened.records().named_by(artifact).await.unwrap();
        assert!(described.contains(name), "{described}");
    }
    assert!(needs.live && needs.done_shards.is_empty());
    opened.catalog().commit(Order::Pin { digest: pinned, reason: None }).await.unwrap();
    assert_eq!(opened.records().needs().await.unwrap().roots.len(), 4);
    assert!(opened.records().problems().await.unwrap().is_empty());
}

async fn blobs_are_held_until_their_task_is_let_go(place: &impl Place) {
    let opened = place.open().await;
    let [one, other] = ["one", "other"].map(|text| Digest::of(text.as_bytes()));
    let [first, second] = ["r/a", "r/b"].map(TaskId::new);
    for (task, digest) in [(&first, one), (&first, other), (&second, one), (&second, one)] {
        opened.catalog().commit(Order::Hold { task: task.clone(), digest }).await.unwrap();
    }
    drop(opened);
    let opened = place.open().await;
    let both = BTreeSet::from([one, other]);
    let all = BTreeMap::from([(first.clone(), both), (second.clone(), BTreeSet::from([one]))]);
    assert_eq!(opened.records().held().await.unwrap(), all);
    opened.catalog().commit(Order::LetGo(vec![first, TaskId::new("r/none")])).await.unwrap();
    assert_eq!(opened.records().held().await.unwrap(), BTreeMap::from([(second, BTreeSet::from([one]))]));
}

async fn a_collection_begins_by_forgetting_the_shards_of_what_is_done(place: &impl Place) {
    let opened = place.open().await;
    for name in ["done", "going"] {
        let task = format!("{name}/encode/0");
        let output = artifact(opened.blobs(), ArtifactKind::Latents, name);
        let shard = Write::Shard { grant: grant(&task, 1), output };
        opened.write(vec![run(name, None), fence(&task, 1), shard.clone()]).await.unwrap();
        opened.write(vec![shard]).await.unwrap();
    }
    opened.write(vec![ended("done", "finished")]).await.unwrap();
    let records = opened.records();
    assert_eq!(records.needs().await.unwrap().done_shards, [TaskId::new("done/encode/0")]);
    match opened.catalog().commit(Order::BeginCollection).await.unwrap() {
        Done::Begun(tasks) => assert_eq!(tasks, [TaskId::new("done/encode/0")]),
        done => panic!("{done:?}"),
    }
    assert!(records.shards(&"done".into()).await.unwrap().is_empty());
    assert_eq!(records.shards(&"going".into()).await.unwrap().len(), 1);
}

async fn a_copy_is_of_one_moment(place: &impl Place) {
    let opened = place.open().await;
    let value = artifact(opened.blobs(), ArtifactKind::Vae, "value");
    opened.write(vec![result("key", value)]).await.unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("copy");
    let needs = opened.records().copy_to(&path).await.unwrap();
    assert_eq!(needs, opened.records().needs().await.unwrap());
    assert!(path.exists());
    assert!(opened.records().copy_to(&path).await.is_err(), "nothing is written over");
}
