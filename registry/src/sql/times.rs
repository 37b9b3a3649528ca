//! When values came. A batch has one time; between two batches of a try, time passes evenly from step to step.

use protocol::{RunId, StageName};

use super::statement::{Conn, Row, json, query};
use crate::QueryError;

type Result<T> = std::result::Result<T, QueryError>;

/// When the first values of a stage came, in milliseconds since 1970; 0 if none have.
pub(super) async fn first(conn: &mut Conn<'_>, run: &RunId, stage: &StageName) -> Result<i64> {
    let find = "SELECT coalesce(min((SELECT at_ms FROM recorded WHERE recorder = recorders.id ORDER BY step LIMIT 1)), 0) \
                FROM recorders WHERE run = ? AND stage = ?";
    let find = query(find).bind(run.as_str()).bind(stage.as_str());
    Ok(find.fetch_one(&mut *conn).await?.try_get(0)?)
}

/// When a try recorded the values of steps, in milliseconds since 1970.
pub(super) async fn of_steps(conn: &mut Conn<'_>, recorder: i64, steps: &[i64]) -> Result<Vec<f64>> {
    let find = "SELECT step.value AS step, before.step AS step_before, before.at_ms AS ms_before, \
                after.step AS step_after, after.at_ms AS ms_after FROM {places ?2} AS step \
                LEFT JOIN recorded AS before ON before.recorder = ?1 AND before.step = \
                (SELECT max(step) FROM recorded WHERE recorder = ?1 AND step < step.value) \
                LEFT JOIN recorded AS after ON after.recorder = ?1 AND after.step = \
                (SELECT min(step) FROM recorded WHERE recorder = ?1 AND step >= step.value) ORDER BY step.key";
    let rows = query(find).bind(recorder).bind(json(&steps)).fetch_all(&mut *conn).await?;
    let mut times = Vec::new();
    for row in &rows {
        let step: i64 = row.try_get("step")?;
        let before = batch(row, "step_before", "ms_before")?;
        let after = batch(row, "step_after", "ms_after")?;
        times.push(match (before, after) {
            (Some((_, ms)), None) | (None, Some((_, ms))) => ms,
            (Some(before), Some(after)) => between(before, after, step as f64),
            (None, None) => 0.0,
        });
    }
    Ok(times)
}

/// The step that a try had reached at a time, the last one if it is the `end` of a range; `None` if that is after its last values.
pub(super) async fn step_at(conn: &mut Conn<'_>, recorder: i64, ms: f64, end: bool) -> Result<Option<f64>> {
    let find = match end {
        true => "SELECT step, at_ms FROM recorded WHERE recorder = ? AND at_ms > ? ORDER BY step LIMIT 1",
        false => "SELECT step, at_ms FROM recorded WHERE recorder = ? AND at_ms >= ? ORDER BY step LIMIT 1",
    };
    let after = query(find).bind(recorder).bind(ms).fetch_optional(&mut *conn).await?;
    let Some(after) = after.map(|row| batch(&row, "step", "at_ms")).transpose()?.flatten() else { return Ok(None) };
    let find = "SELECT step, at_ms FROM recorded WHERE recorder = ? AND step < ? ORDER BY step DESC LIMIT 1";
    let before = query(find).bind(recorder).bind(after.0).fetch_optional(&mut *conn).await?;
    let Some(before) = before.map(|row| batch(&row, "step", "at_ms")).transpose()?.flatten() else {
        // The first batch has one time for all of its steps.
        return Ok(Some(-1.0));
    };
    let flip = |(step, ms): (f64, f64)| (ms, step);
    Ok(Some(between(flip(before), flip(after), ms)))
}

/// A batch's last step and its time, if there is one.
fn batch(row: &Row, step: &str, ms: &str) -> Result<Option<(f64, f64)>> {
    let (step, ms): (Option<i64>, Option<i64>) = (row.try_get(step)?, row.try_get(ms)?);
    Ok(step.zip(ms).map(|(step, ms)| (step as f64, ms as f64)))
}

/// Linear interpolation at `x` between two points with `x0 <= x1`.
fn between((x0, y0): (f64, f64), (x1, y1): (f64, f64), x: f64) -> f64 {
    if x1 > x0 { y0 + (y1 - y0) * (x - x0) / (x1 - x0) } else { y1 }
}
