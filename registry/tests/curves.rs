//! Curves in buckets: every value counts once, whatever attempts, gaps, orders and restarts came between.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeMap;

use common::{artifact, fence, grant, metrics, open};
use protocol::ArtifactKind;
use protocol::message::MetricRow;
use registry::{Axis, Buckets, Page, Store, Window, Write};

const WHOLE: Window = Window { axis: Axis::Step, from: None, to: None, buckets: 800 };

fn row(step: u64, value: f64) -> MetricRow {
    MetricRow { step, key: "loss".into(), value }
}

async fn record(store: &Store, task: &str, attempt: u64, rows: Vec<MetricRow>) {
    store.write(vec![Write::Metrics { grant: grant(task, attempt), rows }]).await.unwrap();
}

async fn drawn(store: &Store, window: Window) -> Buckets {
    let mut all = store.buckets(&"r".into(), &"s".into(), Some(&["loss".into()]), &window).await.unwrap();
    all.remove("loss").unwrap_or_default()
}

/// The buckets that are expected, added up from the points one by one: each bucket reaches from the one before to its place.
async fn check(store: &Store, window: Window) -> Buckets {
    let drawn = drawn(store, window).await;
    assert!(drawn.x.len() <= window.buckets, "{} buckets of {}", drawn.x.len(), window.buckets);
    let curves = store.points(&"r".into(), &"s".into(), None, Page::ALL).await.unwrap();
    let within =
        |step: u64| window.from.is_none_or(|from| step as f64 >= from) && window.to.is_none_or(|to| step as f64 <= to);
    let mut points = curves["loss"].points.iter().filter(|point| within(point.step)).peekable();
    for (i, end) in drawn.x.iter().enumerate() {
        let mut values = Vec::new();
        while let Some(point) = points.next_if(|point| point.step as f64 <= *end) {
            values.push(point.value);
        }
        let finite: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
        assert_eq!((drawn.count[i], drawn.nan[i]), (values.len() as u64, (values.len() - finite.len()) as u64), "{i}");
        let near = |a: f64, b: f64| (a.is_nan() && b.is_nan()) || (a - b).abs() <= 1e-9 * b.abs().max(1.0);
        assert!(near(drawn.min[i], finite.iter().copied().fold(f64::NAN, f64::min)), "{i}");
        assert!(near(drawn.max[i], finite.iter().copied().fold(f64::NAN, f64::max)), "{i}");
        assert!(near(drawn.mean[i], finite.iter().sum::<f64>() / finite.len() as f64), "{i}");
        let last = *values.last().unwrap();
        assert!(near(drawn.last[i], if last.is_finite() { last } else { f64::NAN }), "{i}");
    }
    assert_eq!(points.next(), None, "every value is in a bucket");
    drawn
}

/// A value for each step that is not the same as its neighbours', with some that are no numbers.
fn value(step: u64) -> f64 {
    match step % 1_013 {
        5 => f64::NAN,
        6 => f64::INFINITY,
        _ => ((step.wrapping_mul(2_654_435_761) >> 7) % 10_000) as f64 - 3_000.0,
    }
}

#[tokio::test]
async fn buckets_of_every_fineness_hold_every_value_once() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    // Every seventh step, with a gap in the middle, in batches that fit no bucket.
    let steps: Vec<u64> = (0..30_000).map(|i| if i < 11_111 { i * 7 } else { i * 7 + 500_000 }).collect();
    for steps in steps.chunks(997) {
        record(&store, "r/s", 1, steps.iter().map(|step| row(*step, value(*step))).collect()).await;
    }
    for buckets in [1, 7, 100, 469, 800, 4_000, 40_000] {
        let drawn = check(&store, Window { buckets, ..WHOLE }).await;
        assert_eq!(drawn.count.iter().sum::<u64>(), 30_000, "{buckets}");
    }
    for (from, to) in [(0.0, 700.0), (6_999.5, 77_000.0), (70_000.0, 600_000.0), (12_345.0, 12_345.0), (100.0, 99.0)] {
        for buckets in [3, 50, 800] {
            check(&store, Window { from: Some(from), to: Some(to), buckets, axis: Axis::Step }).await;
        }
    }
}

#[tokio::test]
async fn what_is_no_number_is_marked_and_hides_no_peak() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    let value = |step| match step {
        5_000 => 123.0,
        5_001 => f64::NAN,
        5_002 => f64::NEG_INFINITY,
        _ => 1.0,
    };
    record(&store, "r/s", 1, (0..10_000).map(|step| row(step, value(step))).collect()).await;
    let drawn = check(&store, Window { buckets: 20, ..WHOLE }).await;
    let at = drawn.max.iter().position(|max| *max == 123.0).unwrap();
    assert_eq!((drawn.nan[at], drawn.min[at]), (2, 1.0));
    assert_eq!(drawn.nan.iter().sum::<u64>(), 2);
    let json = serde_json::to_value(&drawn).unwrap();
    assert_eq!(serde_json::from_value::<Buckets>(json).unwrap(), drawn);

    let points = store.points(&"r".into(), &"s".into(), None, Page::ALL).await.unwrap();
    assert!(points["loss"].points[5_002].value.is_nan(), "an infinite value is the same in JSON and packed");

    store.write(vec![fence("r/s", 2)]).await.unwrap();
    record(&store, "r/s", 2, (0..100).map(|step| row(step, f64::NAN)).collect()).await;
    let drawn = check(&store, Window { buckets: 1, ..WHOLE }).await;
    assert!(drawn.max[0].is_nan() && drawn.last[0].is_nan() && drawn.nan[0] == 100);

    store.write(vec![fence("r/s", 3)]).await.unwrap();
    record(&store, "r/s", 3, (0..100).map(|step| row(step, f64::MAX)).collect()).await;
    let drawn = self::drawn(&store, Window { buckets: 1, ..WHOLE }).await;
    assert!(drawn.max[0] == f64::MAX && drawn.mean[0].is_nan(), "a sum beyond all numbers: {drawn:?}");
}

#[tokio::test]
async fn an_attempt_supersedes_from_the_step_that_it_resumed_at() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    record(&store, "r/s", 1, (1..=9_000).map(|step| row(step, 1.0)).collect()).await;
    let manifest = artifact(store.blobs(), ArtifactKind::Checkpoint, "at 5003");
    let saved = Write::Checkpoint { grant: grant("r/s", 1), step: 5_003, manifest, metrics: metrics(&[]) };
    store.write(vec![saved]).await.unwrap();
    store.write(vec![fence("r/s", 2)]).await.unwrap();
    // Its first value of this key is later than its first step.
    record(&store, "r/s", 2, vec![MetricRow { step: 5_004, key: "other".into(), value: 0.0 }]).await;
    let cut = check(&store, Window { buckets: 10, ..WHOLE }).await;
    assert_eq!((cut.x.last(), cut.count.iter().sum::<u64>()), (Some(&5_003.0), 5_003));
    record(&store, "r/s", 2, (501..=1_500).map(|step| row(step * 10, 2.0)).collect()).await;
    let whole = check(&store, Window { buckets: 100, ..WHOLE }).await;
    assert_eq!(whole.count.iter().sum::<u64>(), 5_003 + 1_000);
    assert_eq!((whole.last[0], whole.last.last()), (1.0, Some(&2.0)));
    // From scratch: nothing of the others counts but what lies before its first value.
    store.write(vec![fence("r/s", 3)]).await.unwrap();
    record(&store, "r/s", 3, (1..=70).map(|step| row(step, 3.0)).collect()).await;
    let points = store.points(&"r".into(), &"s".into(), None, Page::ALL).await.unwrap();
    assert_eq!(points["loss"].points.len(), 70);
}

#[tokio::test]
async fn values_that_come_late_or_twice_or_after_a_restart_count_once() {
    let dir = tempfile::tempdir().unwrap();
    let mut store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    let mut sent: BTreeMap<u64, f64> = BTreeMap::new();
    for round in 0..40_u64 {
        // Each third step of a range that overlaps with those before, some of them backwards and twice.
        let mut steps: Vec<u64> = (0..400).map(|i| round * 250 + (i * 3 + round) % 1_200).collect();
        if round % 3 == 0 {
            steps.reverse();
            steps.extend_from_within(..10);
        }
        steps.iter().for_each(|step| {
            sent.entry(*step).or_insert(value(*step));
        });
        record(&store, "r/s", 1, steps.iter().map(|step| row(*step, value(*step))).collect()).await;
        if round % 7 == 0 {
            drop(store);
            store = open(dir.path()).await;
        }
        if round % 10 == 9 {
            for buckets in [5, 60, 800] {
                let drawn = check(&store, Window { buckets, ..WHOLE }).await;
                assert_eq!(drawn.count.iter().sum::<u64>(), sent.len() as u64);
            }
        }
    }
}

/// An order that is refused after its values leaves nothing behind, in memory either.
#[tokio::test]
async fn values_of_a_refused_order_do_not_count() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    record(&store, "r/s", 1, (0..100).map(|step| row(step, value(step))).collect()).await;
    let values = Write::Metrics { grant: grant("r/s", 1), rows: (100..300).map(|step| row(step, 9.0)).collect() };
    let refused = Write::Metrics { grant: grant("r/other", 1), rows: vec![] };
    store.write(vec![values, refused]).await.unwrap_err();
    record(&store, "r/s", 1, (100..300).map(|step| row(step, value(step))).collect()).await;
    let drawn = check(&store, Window { buckets: 4, ..WHOLE }).await;
    assert_eq!(drawn.count.iter().sum::<u64>(), 300);
}

#[tokio::test]
async fn values_of_several_tasks_share_their_buckets() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    for shard in 0..3_u64 {
        let task = format!("r/s/{shard}");
        store.write(vec![fence(&task, 1)]).await.unwrap();
        record(&store, &task, 1, (0..500).map(|step| row(step, shard as f64)).collect()).await;
    }
    let drawn = drawn(&store, Window { buckets: 5, ..WHOLE }).await;
    assert_eq!(drawn.count.iter().sum::<u64>(), 1_500);
    assert!(drawn.min.iter().all(|min| *min == 0.0) && drawn.max.iter().all(|max| *max == 2.0));
}

#[tokio::test]
async fn places_in_time_grow_with_the_steps_and_bound_a_window() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.write(vec![fence("r/s", 1)]).await.unwrap();
    let began = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_millis() as f64;
    for batch in 0..10_u64 {
        record(&store, "r/s", 1, (batch * 100..(batch + 1) * 100).map(|step| row(step, step as f64)).collect()).await;
        std::thread::sleep(std::time::Duration::from_millis(3));
    }
    let ended = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_millis() as f64;
    let time = Window { axis: Axis::Time, ..WHOLE };
    let by_time = drawn(&store, Window { buckets: 1_000, ..time }).await;
    assert_eq!(by_time.x.len(), 1_000);
    assert!(by_time.x.is_sorted() && by_time.last.is_sorted());
    assert!(by_time.x[0] >= began && by_time.x[999] <= ended && by_time.x[999] > by_time.x[0]);
    let part =
        drawn(&store, Window { buckets: 1_000, from: Some(by_time.x[250]), to: Some(by_time.x[749]), ..time }).await;
    assert!(part.x.iter().all(|x| *x >= by_time.x[250] && *x <= by_time.x[749]));
    assert!(part.last.contains(&500.0) && part.x.len() < 700, "{}", part.x.len());
    let by_hours = drawn(&store, Window { axis: Axis::Hours, buckets: 1_000, ..WHOLE }).await;
    assert_eq!(by_hours.x[0], 0.0);
    assert!((by_hours.x[999] * 3_600_000.0 - (by_time.x[999] - by_time.x[0])).abs() < 1e-3);
}
