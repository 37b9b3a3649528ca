//! The list of runs: filters, search and pages over many runs.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic, and prints what it measured")]

mod common;

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use common::open;
use protocol::Group;
use protocol::message::{RunState, RunSummary};
use registry::{RunListQuery, RunOrder, Store, Write};
use serde_json::json;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions as _, Connection as _};

const RUNS: usize = 100_000;
/// Time that a page may take on a quiet machine.
const PAGE: Duration = Duration::from_millis(20);

/// Fills the list as submissions would, without their pipelines.
const FILL: &str = "WITH RECURSIVE n (i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i + 1 < 100000)
    INSERT INTO run_list (run, pipeline, owner, token, state, created_ms, changed_ms, done, stages, wall_s, note)
    SELECT 'pipe' || (i % 37) || '-0a1b2c3d-' || (i + 1), 'pipe' || (i % 37),
        CASE i % 3 WHEN 0 THEN '@motion' WHEN 1 THEN 'bob' ELSE 'carol' END, 'anna',
        CASE WHEN i >= 99990 THEN 'running' ELSE CASE i % 7 WHEN 0 THEN 'failed' ELSE 'finished' END END,
        i, i + 60 - i % 50, 6, 6, 12.5,
        CASE WHEN i % 7 = 0 THEN 'vae: the loss is not finite at step ' || i ELSE 'fid: fid 0.' || i END FROM n";

async fn pages(store: &Store, asked: &RunListQuery, at_most: usize) -> (Vec<RunSummary>, Duration) {
    let (mut rows, mut longest, mut asked) = (Vec::new(), Duration::ZERO, asked.clone());
    for _ in 0..at_most {
        // The shortest of three, for the machine has other work.
        let mut took = Duration::MAX;
        let mut page = None;
        for _ in 0..3 {
            let begun = Instant::now();
            page = Some(store.run_list(&asked).await.unwrap());
            took = took.min(begun.elapsed());
        }
        longest = longest.max(took);
        let page = page.unwrap();
        assert!(page.rows.len() <= asked.limit as usize);
        rows.extend(page.rows);
        asked.after = page.next;
        if asked.after.is_none() {
            break;
        }
    }
    (rows, longest)
}

/// Returns true for the rows of the answer.
type Expected = Box<dyn Fn(&RunSummary) -> bool>;

#[tokio::test]
async fn a_page_of_a_hundred_thousand_runs_takes_as_long_as_one_of_ten() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let mut conn = SqliteConnectOptions::new().filename(dir.path().join("stride.db")).connect().await.unwrap();
    sqlx::query(FILL).execute(&mut conn).await.unwrap();
    conn.close().await.unwrap();

    let all = RunListQuery { limit: 50, ..RunListQuery::default() };
    let failed = RunListQuery { states: vec![RunState::Failed], ..all.clone() };
    let words = |words: &str| RunListQuery { words: words.into(), ..all.clone() };
    let cases: Vec<(&str, RunListQuery, Expected)> = vec![
        ("all", all.clone(), Box::new(|_| true)),
        ("the oldest first", RunListQuery { order: RunOrder::Oldest, ..all.clone() }, Box::new(|_| true)),
        ("the newest change first", RunListQuery { order: RunOrder::Changed, ..all.clone() }, Box::new(|_| true)),
        ("failed", failed.clone(), Box::new(|row| row.state == RunState::Failed)),
        ("paused", RunListQuery { states: vec![RunState::Paused], ..all.clone() }, Box::new(|_| false)),
        (
            "failed ones of a pipeline, changes first",
            RunListQuery { pipeline: Some("pipe3".into()), order: RunOrder::Changed, ..failed.clone() },
            Box::new(|row| row.state == RunState::Failed && row.pipeline == "pipe3"),
        ),
        (
            "of a project and a pipeline",
            RunListQuery { pipeline: Some("pipe3".into()), owner: Some(Group::new("@motion")), ..all.clone() },
            Box::new(|row| row.project.as_deref() == Some("motion") && row.pipeline == "pipe3"),
        ),
        ("of another owner", RunListQuery { owner: Some(Group::new("mallory")), ..all.clone() }, Box::new(|_| false)),
        ("a word of many", words("LOSS"), Box::new(|row| row.note.contains("loss"))),
        ("a word of one", words("step 98000"), Box::new(|row| row.run.as_str().ends_with("-98001"))),
        ("a word of none", words("zebra"), Box::new(|_| false)),
        ("a short word of none", words("zq"), Box::new(|_| false)),
        ("words of many, together of none", words("loss bob zz"), Box::new(|_| false)),
        (
            "a word of many, running",
            RunListQuery { states: vec![RunState::Running], ..words("loss") },
            Box::new(|row| row.state == RunState::Running),
        ),
    ];
    for (what, asked, fits) in &cases {
        let (rows, took) = pages(&store, asked, 3).await;
        println!("{what}: {} rows, the longest page took {took:?}", rows.len());
        assert!(rows.iter().all(fits), "{what}");
        let names: BTreeSet<_> = rows.iter().map(|row| row.run.clone()).collect();
        assert_eq!(names.len(), rows.len(), "{what}: no row twice");
        // Debug builds and other work take longer; a scan of the list takes far longer still.
        assert!(took < 5 * PAGE, "{what}: a page took {took:?}");
        let bytes = rows.iter().map(|row| serde_json::to_vec(&row.clone().shortened()).unwrap().len()).max();
        assert!(bytes.unwrap_or_default() <= RunSummary::BYTES, "{what}: a row has {bytes:?} bytes");
    }
    // Counts that follow from the data.
    let count =
        async |asked: &RunListQuery| pages(&store, &RunListQuery { limit: 500, ..asked.clone() }, RUNS).await.0.len();
    assert_eq!(count(&words("step 98000")).await, 1);
    assert_eq!(count(&RunListQuery { states: vec![RunState::Running], ..all.clone() }).await, 10);
    let sorted = pages(&store, &RunListQuery { order: RunOrder::Changed, ..all.clone() }, 3).await.0;
    assert!(sorted.is_sorted_by(|a, b| a.changed_ms >= b.changed_ms));
    for (after, what) in [("x", "of no list"), ("1", "cut off")] {
        assert!(store.run_list(&RunListQuery { after: Some(after.into()), ..all.clone() }).await.is_err(), "{what}");
    }
}

#[tokio::test]
async fn the_list_follows_the_runs() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let asked = RunListQuery { limit: 10, ..RunListQuery::default() };
    let run = Write::Run {
        run: "p-1".into(),
        pipeline: json!({"name": "p"}),
        source: String::new(),
        state: "running".into(),
        idempotency_key: None,
    };
    store
        .write(vec![run, Write::RunOwner { run: "p-1".into(), owner: Group::of("anna", Some("motion")) }])
        .await
        .unwrap();
    let row = store.run_list(&asked).await.unwrap().rows.remove(0);
    assert_eq!((row.pipeline.as_str(), row.state, row.project.as_deref()), ("p", RunState::Running, Some("motion")));
    store.write(vec![Write::RunState { run: "p-1".into(), state: "paused".into() }]).await.unwrap();
    assert_eq!(store.run_list(&asked).await.unwrap().rows[0].state, RunState::Paused);
    let view = json!({
        "owner": {"name": "anna"},
        "note": "vae: ü \"quoted\"",
        "stages": [
            {"name": "data", "state": "cached", "wall_s": 0.5},
            {"name": "vae", "state": "failed", "message": "no", "wall_s": 2},
            {"name": "vae.t0", "state": "ran", "of": "vae", "wall_s": 100},
            {"name": "late", "state": "skipped", "message": "not asked for", "wall_s": 0},
        ],
    });
    let (view, archive) = (view.to_string(), "{}".to_owned());
    store.write(vec![Write::RunEnded { run: "p-1".into(), state: "failed".into(), view, archive }]).await.unwrap();
    let row = store.run_list(&asked).await.unwrap().rows.remove(0);
    assert_eq!(
        (row.owner.as_str(), row.state, row.done, row.stages, row.wall_s),
        ("anna", RunState::Failed, 1, 2, 2.5)
    );
    assert_eq!(row.note, "vae: ü \"quoted\"");
    for (words, found) in
        [("\"quoted\"", 1), ("Ü", 1), ("vae ANNA", 1), ("' OR 1", 0), ("NOT zzz", 0), ("*", 0), ("\0", 0)]
    {
        let asked = RunListQuery { words: words.into(), ..asked.clone() };
        assert_eq!(store.run_list(&asked).await.unwrap().rows.len(), found, "{words}");
    }
    store.forget(&"p-1".into()).await.unwrap();
    assert!(store.run_list(&asked).await.unwrap().rows.is_empty());
    assert!(store.run_list(&RunListQuery { words: "anna".into(), ..asked }).await.unwrap().rows.is_empty());
    assert!(store.fsck().await.unwrap().problems.is_empty());
}
