//! Storing values: the rows, when they came, and the roll-ups that they fill.
//!
//! Values that no roll-up holds yet are kept in memory between batches, so that a batch costs no questions. They follow from the tables, and are
//! forgotten whenever what they came from was not committed.

use std::collections::{BTreeMap, HashMap};

use protocol::message::{Grant, MetricRow};
use protocol::{Attempt, TaskId};

use super::error::write_error;
use super::statement::{Builder, Conn, ROWS, Row, Values, insert, int, one, query, run, run_and_stage};
use super::usage;
use crate::rollup::{Bucket, LEVELS, Open};
use crate::{WriteError, clock};

type Result<T> = std::result::Result<T, WriteError>;

/// Series in memory. With more than these, all are read anew.
const SERIES: usize = 50_000;

/// State of the series with recent writes.
#[derive(Debug, Default)]
pub(super) struct Recording {
    recorders: HashMap<(TaskId, Attempt), Recorder>,
}

/// A try that records values.
#[derive(Debug)]
struct Recorder {
    id: i64,
    /// The newest step, and when its batch came, in milliseconds since 1970.
    newest: Option<(i64, i64)>,
    series: HashMap<String, Series>,
}

#[derive(Debug)]
struct Series {
    id: i64,
    last_step: Option<i64>,
    open: Open,
}

/// A roll-up to be stored: its series, its level and what it holds.
type Full = (i64, usize, Bucket);

impl Recording {
    /// Forgets everything: what it came from was not committed, or is gone.
    pub(super) fn forget(&mut self) {
        self.recorders.clear();
    }

    /// Adds values; those that are stored already are left as they are.
    pub(super) async fn add(&mut self, conn: &mut Conn<'_>, grant: &Grant, rows: &[MetricRow]) -> Result<()> {
        let Some(last) = rows.iter().map(|row| int(row.step)).max() else { return Ok(()) };
        if self.recorders.values().map(|recorder| recorder.series.len()).sum::<usize>() > SERIES {
            self.forget();
        }
        let recorder = self.recorder(conn, grant).await?;
        let mut by_key: BTreeMap<&str, Vec<(i64, Option<f64>)>> = BTreeMap::new();
        for row in rows {
            let value = (!row.value.is_nan()).then_some(row.value);
            by_key.entry(&row.key).or_default().push((int(row.step), value));
        }
        let mut fresh = Vec::with_capacity(rows.len());
        let mut full = Vec::new();
        for (key, mut values) in by_key {
            values.sort_by_key(|(step, _)| *step);
            values.dedup_by_key(|(step, _)| *step);
            let series = recorder.series(conn, grant, key, &mut full).await?;
            let late = values.partition_point(|(step, _)| Some(*step) <= series.last_step);
            if late > 0 && add_late(conn, series.id, &values[..late]).await? {
                *series = load(conn, series.id, &mut full).await?;
            }
            for (step, value) in &values[late..] {
                series.add(0, Bucket::of(*step, *value), &mut full);
                fresh.push((series.id, *step, *value));
            }
        }
        let values = |row: &mut Values<'_, '_>, (id, step, value): &(i64, i64, Option<f64>)| {
            row.push_bind(*id).push_bind(*step).push_bind(*value);
        };
        insert(conn, "INSERT INTO metrics (series, step, value) ", &fresh, values, "").await?;
        add_rollups(conn, &full).await?;
        recorder.came(conn, last).await?;
        usage::add(conn, run_and_stage(&grant.task).0, 0, rows.len() as u64).await
    }

    async fn recorder(&mut self, conn: &mut Conn<'_>, grant: &Grant) -> Result<&mut Recorder> {
        let known = (grant.task.clone(), grant.attempt);
        if !self.recorders.contains_key(&known) {
            let recorder = find_recorder(conn, grant).await?;
            self.recorders.insert(known.clone(), recorder);
        }
        let gone = || WriteError::Internal("a try that was just found is not there".into());
        self.recorders.get_mut(&known).ok_or_else(gone)
    }
}

async fn find_recorder(conn: &mut Conn<'_>, grant: &Grant) -> Result<Recorder> {
    let task = grant.task.as_str();
    let attempt = int(grant.attempt.0);
    let find = query("SELECT id FROM recorders WHERE task = ? AND attempt = ?").bind(task).bind(attempt);
    let Some(row) = one(conn, find).await? else {
        // Fences keep earlier tries from saving anything now, so the newest of theirs is what this one continued from.
        let (of_run, stage) = run_and_stage(&grant.task);
        let add = "INSERT INTO recorders (run, stage, task, attempt, resumed) SELECT ?1, ?2, ?3, ?4, \
                   (SELECT max(step) FROM checkpoints WHERE task = ?3 AND attempt < ?4) RETURNING id";
        let add = query(add).bind(of_run).bind(stage).bind(task).bind(attempt);
        let id = add.fetch_one(&mut *conn).await.map_err(write_error)?.get(0);
        return Ok(Recorder { id, newest: None, series: HashMap::new() });
    };
    let id: i64 = row.get(0);
    let newest = "SELECT step, at_ms FROM recorded WHERE recorder = ? ORDER BY step DESC LIMIT 1";
    let newest = one(conn, query(newest).bind(id)).await?.map(|row| (row.get(0), row.get(1)));
    Ok(Recorder { id, newest, series: HashMap::new() })
}

impl Recorder {
    async fn series(
        &mut self,
        conn: &mut Conn<'_>,
        grant: &Grant,
        key: &str,
        full: &mut Vec<Full>,
    ) -> Result<&mut Series> {
        if !self.series.contains_key(key) {
            let series = find_series(conn, grant, key, full).await?;
            self.series.insert(key.to_owned(), series);
        }
        self.series.get_mut(key).ok_or_else(|| WriteError::Internal("a series that was just found is not there".into()))
    }

    /// Notes when a batch came whose last step is `last`.
    async fn came(&mut self, conn: &mut Conn<'_>, last: i64) -> Result<()> {
        if self.newest.is_some_and(|(step, _)| step >= last) {
            return Ok(());
        }
        // A clock that was set back does not turn time around.
        let now = clock::now_ms().max(self.newest.map_or(0, |(_, at)| at));
        let add = query("INSERT INTO recorded (recorder, step, at_ms) VALUES (?, ?, ?)");
        run(conn, add.bind(self.id).bind(last).bind(now)).await?;
        self.newest = Some((last, now));
        Ok(())
    }
}

impl Series {
    fn add(&mut self, level: usize, bucket: Bucket, full: &mut Vec<Full>) {
        self.last_step = self.last_step.max(Some(bucket.last_step));
        let mut filled = Vec::new();
        self.open.add(level, bucket, &mut filled);
        full.extend(filled.into_iter().map(|(level, bucket)| (self.id, level, bucket)));
    }
}

async fn find_series(conn: &mut Conn<'_>, grant: &Grant, key: &str, full: &mut Vec<Full>) -> Result<Series> {
    let task = grant.task.as_str();
    let attempt = int(grant.attempt.0);
    let find = "SELECT id FROM series WHERE task = ? AND attempt = ? AND key = ?";
    if let Some(row) = one(conn, query(find).bind(task).bind(attempt).bind(key)).await? {
        return load(conn, row.get(0), full).await;
    }
    let (of_run, stage) = run_and_stage(&grant.task);
    let add = "INSERT INTO series (run, stage, task, attempt, key) VALUES (?, ?, ?, ?, ?) RETURNING id";
    let add = query(add).bind(of_run).bind(stage).bind(task).bind(attempt).bind(key);
    let id = add.fetch_one(&mut *conn).await.map_err(write_error)?.get(0);
    Ok(Series { id, last_step: None, open: Open::default() })
}

/// Takes up what is stored of a series after its newest roll-ups.
async fn load(conn: &mut Conn<'_>, id: i64, full: &mut Vec<Full>) -> Result<Series> {
    let mut series = Series { id, last_step: None, open: Open::default() };
    for level in (1..LEVELS).rev() {
        let rows = "SELECT * FROM rollups WHERE series = ?1 AND level = ?2 AND last_step > coalesce(\
                    (SELECT max(last_step) FROM rollups WHERE series = ?1 AND level = ?2 + 1), -1) ORDER BY last_step";
        let rows = query(rows).bind(id).bind(level as i64).fetch_all(&mut *conn).await.map_err(write_error)?;
        for row in &rows {
            series.add(level, bucket(row).map_err(write_error)?, full);
        }
    }
    let rows = "SELECT step, value FROM metrics WHERE series = ?1 AND step > coalesce(\
                (SELECT max(last_step) FROM rollups WHERE series = ?1 AND level = 1), -1) ORDER BY step";
    for row in query(rows).bind(id).fetch_all(&mut *conn).await.map_err(write_error)? {
        series.add(0, Bucket::of(row.get(0), row.get(1)), full);
    }
    let last = query("SELECT max(step) FROM metrics WHERE series = ?").bind(id);
    series.last_step = one(conn, last).await?.and_then(|row| row.get(0));
    Ok(series)
}

/// Reads a row of the table, or a sum of such rows.
pub(super) fn bucket(row: &Row) -> std::result::Result<Bucket, sqlx::Error> {
    Ok(Bucket {
        first_step: row.try_get("first_step")?,
        last_step: row.try_get("last_step")?,
        count: row.try_get::<i64, _>("count")?.unsigned_abs(),
        odd: row.try_get::<i64, _>("odd")?.unsigned_abs(),
        low: row.try_get::<Option<f64>, _>("low")?.unwrap_or(f64::INFINITY),
        high: row.try_get::<Option<f64>, _>("high")?.unwrap_or(f64::NEG_INFINITY),
        sum: row.try_get::<Option<f64>, _>("sum")?.unwrap_or_default(),
        last: row.try_get("last")?,
    })
}

async fn add_rollups(conn: &mut Conn<'_>, full: &[Full]) -> Result<()> {
    let values = |row: &mut Values<'_, '_>, (series, level, bucket): &Full| {
        row.push_bind(*series).push_bind(*level as i64).push_bind(bucket.last_step).push_bind(bucket.first_step);
        row.push_bind(int(bucket.count)).push_bind(int(bucket.odd));
        row.push_bind(bucket.low.is_finite().then_some(bucket.low));
        row.push_bind(bucket.high.is_finite().then_some(bucket.high));
        // A sum of finite values may be infinite; it is never NaN, which the table would not take.
        row.push_bind(if bucket.sum.is_nan() { 0.0 } else { bucket.sum }).push_bind(bucket.last);
    };
    let begin = "INSERT INTO rollups (series, level, last_step, first_step, count, odd, low, high, sum, last) ";
    insert(conn, begin, full, values, "").await
}

/// Adds values that come after later ones, each to the roll-ups that hold its step. Returns true if any was not stored yet.
async fn add_late(conn: &mut Conn<'_>, series: i64, values: &[(i64, Option<f64>)]) -> Result<bool> {
    let mut any = false;
    for values in values.chunks(ROWS) {
        let mut add = Builder::new("INSERT INTO metrics (series, step, value) ");
        add.push_rows(values, |row, (step, value)| {
            row.push_bind(series).push_bind(*step).push_bind(*value);
        });
        add.push(" ON CONFLICT DO NOTHING RETURNING step, value");
        for row in add.build().fetch_all(&mut *conn).await.map_err(write_error)? {
            any = true;
            let bucket = Bucket::of(row.get(0), row.get(1));
            let to = "UPDATE rollups SET first_step = {least}(first_step, ?3), count = count + 1, \
                      odd = odd + CASE WHEN ?4 IS NULL THEN 1 ELSE 0 END, \
                      low = {least}(coalesce(low, ?4), coalesce(?4, low)), high = {greatest}(coalesce(high, ?4), coalesce(?4, high)), \
                      sum = sum + coalesce(?4, 0.0) WHERE series = ?1 AND level = ?2 AND last_step = (SELECT last_step \
                      FROM rollups WHERE series = ?1 AND level = ?2 AND last_step >= ?3 ORDER BY last_step LIMIT 1)";
            for level in 1..=LEVELS {
                run(conn, query(to).bind(series).bind(level as i64).bind(bucket.first_step).bind(bucket.last)).await?;
            }
        }
    }
    Ok(any)
}
