//! Curves out of the tables. What has more values than are asked for is sampled down by the database: of each range of steps the smallest
//! and the largest value come, so that a million values need neither memory nor threads here.

use std::collections::BTreeMap;

use protocol::{RunId, StageName};
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::statement::json;
use crate::QueryError;
use crate::curve::{Curve, Curves};

type Result<T> = std::result::Result<T, QueryError>;

/// Up to so many values of one key and one try are read as they are.
const WHOLE: i64 = 4_000;

/// The values of one key by one try of one task.
struct Series {
    id: i64,
    key: String,
    task: String,
    attempt: i64,
}

/// The current values of a stage by key.
pub(super) async fn read(
    conn: &mut SqliteConnection,
    run: &RunId,
    stage: &StageName,
    keys: Option<&[String]>,
    points: usize,
) -> Result<BTreeMap<String, Curve>> {
    let find = "SELECT id, key, task, attempt FROM series WHERE run = ?1 AND stage = ?2 \
                AND (?3 IS NULL OR key IN (SELECT value FROM json_each(?3))) ORDER BY key, task, attempt DESC";
    let keys = keys.map(|keys| json(&keys));
    let rows = sqlx::query(find).bind(run.as_str()).bind(stage.as_str()).bind(keys).fetch_all(&mut *conn).await?;
    let mut curves = Curves::default();
    for row in &rows {
        let series = Series {
            id: row.try_get("id")?,
            key: row.try_get("key")?,
            task: row.try_get("task")?,
            attempt: row.try_get("attempt")?,
        };
        let superseded_from = curves.begin(&series.key, &series.task, series.attempt);
        add(conn, &series, i64::try_from(superseded_from).unwrap_or(i64::MAX), points, &mut curves).await?;
    }
    Ok(curves.finish(points))
}

/// Adds the values of a series before the step from which a newer try counts.
async fn add(
    conn: &mut SqliteConnection,
    series: &Series,
    before: i64,
    points: usize,
    curves: &mut Curves,
) -> Result<()> {
    let range = "SELECT (SELECT min(step) FROM metrics WHERE series = ?1), \
                 (SELECT max(step) FROM metrics WHERE series = ?1 AND step < ?2), \
                 (SELECT count(*) FROM metrics WHERE series = ?1 AND step < ?2)";
    let row = sqlx::query(range).bind(series.id).bind(before).fetch_one(&mut *conn).await?;
    let (first, last, count): (Option<i64>, Option<i64>, i64) = (row.try_get(0)?, row.try_get(1)?, row.try_get(2)?);
    let Some(first) = first else { return Ok(()) };
    curves.begins_at(first.unsigned_abs());
    let Some(last) = last else { return Ok(()) };
    let most = WHOLE.max(i64::try_from(points).unwrap_or(WHOLE));
    if points == 0 || count <= most {
        let all = "SELECT step, value FROM metrics WHERE series = ?1 AND step < ?2 ORDER BY step";
        for row in sqlx::query(all).bind(series.id).bind(before).fetch_all(&mut *conn).await? {
            push(curves, &row)?;
        }
        return Ok(());
    }
    let width = ((last - first) / (most / 4)).max(1);
    let extremes = sqlx::query(EXTREMES).bind(series.id).bind(before).bind(first).bind(width).bind(last);
    let rows = extremes.fetch_all(&mut *conn).await?;
    for row in &rows {
        push(curves, row)?;
    }
    curves.left_out(count.unsigned_abs() - rows.len() as u64);
    Ok(())
}

/// Selects the smallest and the largest value of each range of `?4` steps, and the first and the last value of the series. A value that is
/// not a number is stored as NULL, and counts as larger than all others.
const EXTREMES: &str = "WITH RECURSIVE range (low) AS (SELECT ?3 UNION ALL SELECT low + ?4 FROM range WHERE low + ?4 <= ?5) \
    SELECT step, value FROM metrics WHERE series = ?1 AND step IN (\
    SELECT (SELECT step FROM metrics WHERE series = ?1 AND step >= low AND step < min(low + ?4, ?2) \
    ORDER BY coalesce(value, 9e999), step LIMIT 1) FROM range UNION ALL \
    SELECT (SELECT step FROM metrics WHERE series = ?1 AND step >= low AND step < min(low + ?4, ?2) \
    ORDER BY coalesce(value, 9e999) DESC, step LIMIT 1) FROM range UNION ALL SELECT ?3 UNION ALL SELECT ?5) ORDER BY step";

fn push(curves: &mut Curves, row: &SqliteRow) -> Result<()> {
    curves.push(row.try_get::<i64, _>(0)?.unsigned_abs(), row.try_get(1)?);
    Ok(())
}
