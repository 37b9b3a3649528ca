//! Curves out of the tables: every point of them, or buckets of them, which the database adds up from roll-ups.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use protocol::{RunId, StageName};

use super::recording::bucket;
use super::statement::{Conn, int, json, query};
use super::times;
use crate::QueryError;
use crate::curve::{Axis, Buckets, Curve, Page, Point, Window};
use crate::rollup::Bucket;

type Result<T> = std::result::Result<T, QueryError>;

/// The values of one key by one try of one task that count: those of steps from `low` to `high`.
#[derive(Debug, Clone, Copy)]
struct Segment {
    series: i64,
    recorder: i64,
    low: i64,
    high: i64,
}

/// An attempt that recorded values.
struct Recorder {
    id: i64,
    resumed: Option<i64>,
}

/// The segments of a stage's curves by key.
async fn segments(
    conn: &mut Conn<'_>,
    run: &RunId,
    stage: &StageName,
    keys: Option<&[String]>,
) -> Result<BTreeMap<String, Vec<Segment>>> {
    let find = query("SELECT id, task, attempt, resumed FROM recorders WHERE run = ? AND stage = ?");
    let mut recorders: BTreeMap<(String, i64), Recorder> = BTreeMap::new();
    for row in find.bind(run.as_str()).bind(stage.as_str()).fetch_all(&mut *conn).await? {
        let recorder = Recorder { id: row.try_get("id")?, resumed: row.try_get("resumed")? };
        recorders.insert((row.try_get("task")?, row.try_get("attempt")?), recorder);
    }
    let find = "SELECT id, key, task, attempt, (SELECT min(step) FROM metrics WHERE series = id) AS first FROM series \
                WHERE run = ?1 AND stage = ?2 AND (?3 IS NULL OR key IN {texts ?3}) \
                ORDER BY key, task, attempt DESC";
    let keys = keys.map(|keys| json(&keys));
    let rows = query(find).bind(run.as_str()).bind(stage.as_str()).bind(keys).fetch_all(&mut *conn).await?;
    let mut all: BTreeMap<String, Vec<Segment>> = BTreeMap::new();
    // The key and the task of the series before, and the first step of its newer tries.
    let mut newer: Option<(String, String, i64)> = None;
    for row in &rows {
        let (key, task, attempt): (String, String, i64) =
            (row.try_get("key")?, row.try_get("task")?, row.try_get("attempt")?);
        let Some(first) = row.try_get::<Option<i64>, _>("first")? else { continue };
        let begins = newer.filter(|(k, t, _)| (k, t) == (&key, &task)).map_or(i64::MAX, |(_, _, first)| first);
        let later = recorders.range((task.clone(), attempt + 1)..=(task.clone(), i64::MAX));
        let resumed = later.filter_map(|(_, recorder)| recorder.resumed).min().unwrap_or(i64::MAX - 1);
        let high = begins.saturating_sub(1).min(resumed);
        let recorder = recorders.get(&(task.clone(), attempt)).map_or(-1, |recorder| recorder.id);
        if first <= high {
            let segment = Segment { series: row.try_get("id")?, recorder, low: first, high };
            all.entry(key.clone()).or_default().push(segment);
        }
        newer = Some((key, task, begins.min(first)));
    }
    Ok(all)
}

/// The points of a stage's curves by key.
pub(super) async fn points(
    conn: &mut Conn<'_>,
    run: &RunId,
    stage: &StageName,
    keys: Option<&[String]>,
    page: Page,
) -> Result<BTreeMap<String, Curve>> {
    let after = page.after.map_or(-1, int);
    let limit = i64::try_from(page.limit).unwrap_or(i64::MAX);
    let mut curves = BTreeMap::new();
    for (key, segments) in segments(conn, run, stage, keys).await? {
        let mut points = Vec::new();
        for segment in segments {
            let find =
                "SELECT step, value FROM metrics WHERE series = ? AND step > ? AND step <= ? ORDER BY step LIMIT ?";
            let find = query(find).bind(segment.series).bind(after.max(segment.low - 1)).bind(segment.high);
            for row in find.bind(limit).fetch_all(&mut *conn).await? {
                let value = finite(row.try_get::<Option<f64>, _>(1)?.unwrap_or(f64::NAN));
                points.push(Point { step: row.try_get::<i64, _>(0)?.unsigned_abs(), value });
            }
        }
        points.sort_by_key(|point| point.step);
        points.truncate(page.limit);
        curves.insert(key, Curve { points });
    }
    Ok(curves)
}

/// The buckets of a stage's curves by key. A key without a value in the window has no bucket.
pub(super) async fn buckets(
    conn: &mut Conn<'_>,
    run: &RunId,
    stage: &StageName,
    keys: Option<&[String]>,
    window: &Window,
) -> Result<BTreeMap<String, Buckets>> {
    let origin = match window.axis {
        Axis::Hours => times::first(conn, run, stage).await?,
        Axis::Step | Axis::Time => 0,
    };
    let mut curves = BTreeMap::new();
    for (key, mut segments) in segments(conn, run, stage, keys).await? {
        for segment in &mut segments {
            narrow(conn, segment, window, origin).await?;
        }
        segments.retain(|segment| segment.low <= segment.high);
        let found = gather(conn, &segments, window.buckets.max(1)).await?;
        curves.insert(key, columns(conn, &segments, found, window, origin).await?);
    }
    Ok(curves)
}

/// Takes from a segment what lies outside the window, and then the steps at its ends that have no value.
async fn narrow(conn: &mut Conn<'_>, segment: &mut Segment, window: &Window, origin: i64) -> Result<()> {
    match window.axis {
        Axis::Step => {
            // The cast saturates.
            segment.low = window.from.map_or(segment.low, |from| segment.low.max(from.ceil() as i64));
            segment.high = window.to.map_or(segment.high, |to| segment.high.min(to.floor() as i64));
        }
        Axis::Time | Axis::Hours => {
            if let Some(from) = window.from {
                let step = times::step_at(conn, segment.recorder, ms(window.axis, from, origin), false).await?;
                segment.low = segment.low.max(step.map_or(i64::MAX, |step| step.ceil() as i64));
            }
            if let Some(to) = window.to {
                let step = times::step_at(conn, segment.recorder, ms(window.axis, to, origin), true).await?;
                segment.high = segment.high.min(step.map_or(i64::MAX, |step| step.floor() as i64));
            }
        }
    }
    let ends = "SELECT (SELECT min(step) FROM metrics WHERE series = ?1 AND step >= ?2 AND step <= ?3), \
                (SELECT max(step) FROM metrics WHERE series = ?1 AND step >= ?2 AND step <= ?3)";
    let ends = query(ends).bind(segment.series).bind(segment.low).bind(segment.high).fetch_one(&mut *conn).await?;
    // One without a value is empty.
    segment.low = ends.try_get::<Option<i64>, _>(0)?.unwrap_or(i64::MAX);
    segment.high = ends.try_get::<Option<i64>, _>(1)?.unwrap_or(i64::MIN);
    Ok(())
}

/// The time of a place on an axis of time.
fn ms(axis: Axis, place: f64, origin: i64) -> f64 {
    if axis == Axis::Hours { place * 3_600_000.0 + origin as f64 } else { place }
}

/// A bucket, and the number of the segment that its last value is of.
type Found = (usize, Bucket);

/// Adds up segments in about `most` ranges of steps, and no more than that.
async fn gather(conn: &mut Conn<'_>, segments: &[Segment], most: usize) -> Result<Vec<Found>> {
    let (Some(low), Some(high)) = (segments.iter().map(|s| s.low).min(), segments.iter().map(|s| s.high).max()) else {
        return Ok(Vec::new());
    };
    let level = level(conn, segments, most).await?;
    let few = level == 0 && count(conn, segments, 0).await? <= most as u64;
    let width = if few { 1 } else { (high - low) / int(most as u64) + 1 };
    let mut found: BTreeMap<i64, Found> = BTreeMap::new();
    for (number, segment) in segments.iter().enumerate() {
        // Ranges that are still to be read, each by the buckets of a level.
        let mut ranges = vec![(level, segment.low, segment.high)];
        while let Some((level, from, to)) = ranges.pop() {
            let Some((from, to)) = whole(conn, segment.series, level, from, to, &mut ranges).await? else { continue };
            let sums = if level == 0 { VALUES } else { ROLLUPS };
            let sums = query(sums).bind(segment.series).bind(level as i64).bind(from).bind(to);
            for row in sums.bind(low).bind(width).fetch_all(&mut *conn).await? {
                let bucket = bucket(&row)?;
                match found.entry((bucket.last_step - low) / width) {
                    Entry::Vacant(place) => {
                        place.insert((number, bucket));
                    }
                    Entry::Occupied(mut place) => {
                        let (of, sum) = place.get_mut();
                        if bucket.last_step >= sum.last_step {
                            *of = number;
                        }
                        sum.merge(&bucket);
                    }
                }
            }
        }
    }
    Ok(found.into_values().collect())
}

/// Sums of a series' buckets of level `?2` by ranges of `?6` steps.
const ROLLUPS: &str = "SELECT *, (SELECT last FROM rollups WHERE series = ?1 AND level = ?2 AND last_step = sums.last_step) AS last \
    FROM (SELECT min(first_step) AS first_step, max(last_step) AS last_step, CAST(sum(count) AS BIGINT) AS count, \
    CAST(sum(odd) AS BIGINT) AS odd, \
    min(low) AS low, max(high) AS high, sum(sum) AS sum FROM rollups \
    WHERE series = ?1 AND level = ?2 AND last_step >= ?3 AND last_step <= ?4 GROUP BY (last_step - ?5) / ?6) AS sums";

/// The same of its values; `?2` is 0.
const VALUES: &str = "SELECT *, (SELECT CASE WHEN abs(value) <= 1.7976931348623157e308 THEN value END FROM metrics WHERE series = ?1 AND step = last_step) AS last \
    FROM (SELECT min(step) AS first_step, max(step) AS last_step, count(*) AS count, count(*) - count(finite) AS odd, \
    min(finite) AS low, max(finite) AS high, sum(finite) AS sum FROM (SELECT step, CASE WHEN abs(value) <= 1.7976931348623157e308 THEN value END AS finite \
    FROM metrics WHERE series = ?1 AND step >= ?3 AND step <= ?4 AND ?2 = 0) AS of_series GROUP BY (step - ?5) / ?6) AS sums";

/// The coarsest level that has enough buckets. Fewer buckets than pixels are drawn exactly, too.
async fn level(conn: &mut Conn<'_>, segments: &[Segment], most: usize) -> Result<usize> {
    for (level, enough) in [(3, most as u64), (2, most as u64), (1, most as u64 / 2)] {
        if count(conn, segments, level).await? >= enough.max(1) {
            return Ok(level);
        }
    }
    Ok(0)
}

/// Number of buckets of a level, or of values, in segments.
async fn count(conn: &mut Conn<'_>, segments: &[Segment], level: usize) -> Result<u64> {
    let mut sum = 0;
    for segment in segments {
        let count = match level {
            0 => "SELECT count(*) FROM metrics WHERE series = ?1 AND step >= ?3 AND step <= ?4 AND ?2 = 0",
            _ => {
                "SELECT count(*) FROM rollups WHERE series = ?1 AND level = ?2 AND last_step >= ?3 AND last_step <= ?4"
            }
        };
        let count = query(count).bind(segment.series).bind(level as i64).bind(segment.low).bind(segment.high);
        sum += count.fetch_one(&mut *conn).await?.try_get::<i64, _>(0)?.unsigned_abs();
    }
    Ok(sum)
}

/// The part of a range of steps that buckets of a level make up; what is left at its ends goes to `ranges`, for the level below.
async fn whole(
    conn: &mut Conn<'_>,
    series: i64,
    level: usize,
    from: i64,
    to: i64,
    ranges: &mut Vec<(usize, i64, i64)>,
) -> Result<Option<(i64, i64)>> {
    if level == 0 || from > to {
        return Ok(Some((from, to)).filter(|_| from <= to));
    }
    let first = "SELECT first_step, last_step FROM rollups WHERE series = ? AND level = ? AND last_step >= ? ORDER BY last_step LIMIT 1";
    let first = query(first).bind(series).bind(level as i64).bind(from).fetch_optional(&mut *conn).await?;
    let Some(first) = first else {
        ranges.push((level - 1, from, to));
        return Ok(None);
    };
    let (first_step, first_last): (i64, i64) = (first.try_get(0)?, first.try_get(1)?);
    let begin = if first_step >= from { from } else { first_last.saturating_add(1) };
    let last =
        "SELECT max(last_step) FROM rollups WHERE series = ? AND level = ? AND last_step >= ? AND last_step <= ?";
    let last = query(last).bind(series).bind(level as i64).bind(begin).bind(to).fetch_one(&mut *conn).await?;
    let Some(last) = last.try_get::<Option<i64>, _>(0)? else {
        ranges.push((level - 1, from, to));
        return Ok(None);
    };
    ranges.push((level - 1, from, begin - 1));
    ranges.push((level - 1, last + 1, to));
    Ok(Some((begin, last)))
}

/// The value, or NaN in the place of an infinite one: JSON has neither, and all forms of a curve say the same.
fn finite(value: f64) -> f64 {
    if value.is_finite() { value } else { f64::NAN }
}

async fn columns(
    conn: &mut Conn<'_>,
    segments: &[Segment],
    found: Vec<Found>,
    window: &Window,
    origin: i64,
) -> Result<Buckets> {
    let mut places: Vec<(f64, Bucket)> = Vec::with_capacity(found.len());
    match window.axis {
        Axis::Step => places.extend(found.into_iter().map(|(_, bucket)| (bucket.last_step as f64, bucket))),
        Axis::Time | Axis::Hours => {
            for (number, segment) in segments.iter().enumerate() {
                let of: Vec<&Bucket> = found.iter().filter(|(of, _)| *of == number).map(|(_, bucket)| bucket).collect();
                let steps: Vec<i64> = of.iter().map(|bucket| bucket.last_step).collect();
                let times = times::of_steps(conn, segment.recorder, &steps).await?;
                let hours = |at: f64| (at - origin as f64) / 3_600_000.0;
                let place = |at: f64| if window.axis == Axis::Hours { hours(at) } else { at };
                places.extend(times.into_iter().map(place).zip(of.into_iter().copied()));
            }
            places.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        }
    }
    let mut columns = Buckets::default();
    for (x, bucket) in places {
        columns.x.push(x);
        columns.min.push(finite(bucket.low));
        columns.max.push(finite(bucket.high));
        columns.mean.push(finite(bucket.mean()));
        columns.last.push(finite(bucket.last.unwrap_or(f64::NAN)));
        columns.count.push(bucket.count);
        columns.nan.push(bucket.odd);
    }
    Ok(columns)
}
