//! Log lines, one row for each batch, so that short lines take little space.

use futures::TryStreamExt as _;
use protocol::message::Grant;
use protocol::{Attempt, RunId, StageName, TaskId, WorkerId};

use super::error::write_error;
use super::statement::{Conn, Row, int, json, one, query, run, run_and_stage};
use super::usage;
use crate::catalog::LogRow;
use crate::{QueryError, WriteError, clock};

/// Number of lines in one row.
const LINES: usize = 1000;
/// Bytes counted for a line besides its text.
const LINE_BYTES: usize = 8;

/// Adds those of the lines from number `first` on that are not stored yet.
pub(super) async fn add(conn: &mut Conn<'_>, grant: &Grant, first: u64, lines: &[String]) -> Result<(), WriteError> {
    let stream = stream(conn, grant).await?;
    let mut bytes = 0;
    for new in not_stored(conn, stream, first, lines).await? {
        let lines = &lines[new.clone()];
        let take = "UPDATE log_numbers SET next = next + ? RETURNING next";
        let take = query(take).bind(int(lines.len() as u64)).fetch_one(&mut *conn);
        let next: i64 = take.await.map_err(write_error)?.get(0);
        let add = "INSERT INTO log_batches (id, stream, line, count, at_ms, lines) VALUES (?, ?, ?, ?, ?, ?)";
        let count = int(lines.len() as u64);
        let add = query(add).bind(next - count).bind(stream).bind(int(first + new.start as u64)).bind(count);
        run(conn, add.bind(clock::now_ms()).bind(json(&lines))).await?;
        bytes += lines.iter().map(|line| line.len() + LINE_BYTES).sum::<usize>();
    }
    usage::add(conn, run_and_stage(&grant.task).0, bytes as u64, 0).await
}

async fn stream(conn: &mut Conn<'_>, grant: &Grant) -> Result<i64, WriteError> {
    let task = grant.task.as_str();
    let attempt = int(grant.attempt.0);
    let worker = grant.worker.as_str();
    let find = query("SELECT id FROM log_streams WHERE task = ? AND attempt = ? AND worker = ?");
    if let Some(row) = one(conn, find.bind(task).bind(attempt).bind(worker)).await? {
        return Ok(row.get(0));
    }
    let (of_run, stage) = run_and_stage(&grant.task);
    let add = "INSERT INTO log_streams (run, stage, task, attempt, worker) VALUES (?, ?, ?, ?, ?) RETURNING id";
    let add = query(add).bind(of_run).bind(stage).bind(task).bind(attempt).bind(worker);
    Ok(add.fetch_one(&mut *conn).await.map_err(write_error)?.get(0))
}

/// Returns the ranges of `lines` that are not stored yet, each at most [`LINES`] long.
async fn not_stored(
    conn: &mut Conn<'_>,
    stream: i64,
    first: u64,
    lines: &[String],
) -> Result<Vec<std::ops::Range<usize>>, WriteError> {
    // A row that contains a line starts at most `LINES` before it.
    let find = "SELECT line, count FROM log_batches WHERE stream = ? AND line > ? AND line < ? ORDER BY line";
    let find = query(find).bind(stream).bind(int(first) - LINES as i64).bind(int(first + lines.len() as u64));
    let stored = find.fetch_all(&mut *conn).await.map_err(write_error)?;
    let place = |line: i64| usize::try_from(line - int(first)).unwrap_or(0).min(lines.len());
    let mut begin = 0;
    let mut new = Vec::new();
    let mut gap = |from: usize, to: usize| {
        new.extend((from..to).step_by(LINES).map(|begin| begin..(begin + LINES).min(to)));
    };
    for row in stored {
        let (line, count): (i64, i64) = (row.get(0), row.get(1));
        gap(begin, place(line));
        begin = begin.max(place(line + count));
    }
    gap(begin, lines.len());
    Ok(new)
}

/// Reads at most `limit` lines of a run, or of one of its stages, after line `after`.
pub(super) async fn read(
    conn: &mut Conn<'_>,
    of_run: &RunId,
    stage: Option<&StageName>,
    after: i64,
    limit: u32,
) -> Result<Vec<LogRow>, QueryError> {
    // The index gives the rows in order; the text is read only for the selected rows.
    let find = "SELECT b.*, s.task, s.attempt, s.worker FROM log_batches b JOIN log_streams s ON s.id = b.stream \
                WHERE b.id IN (SELECT id FROM log_batches WHERE stream IN \
                (SELECT id FROM log_streams WHERE run = ?1 AND (?2 IS NULL OR stage = ?2)) \
                AND id > ?3 - ?4 AND id + count > ?3 + 1 ORDER BY id LIMIT ?5) ORDER BY b.id";
    let find = query(find).bind(of_run.as_str()).bind(stage.map(StageName::as_str)).bind(after);
    let batches = find.bind(LINES as i64).bind(limit).fetch_all(&mut *conn).await?;
    let mut rows = Vec::new();
    for batch in &batches {
        rows.extend(lines(batch)?.into_iter().filter(|line| line.id > after));
        if rows.len() >= limit as usize {
            rows.truncate(limit as usize);
            break;
        }
    }
    Ok(rows)
}

/// The newest `limit` lines of a run, or of one stage of it, in their order.
pub(super) async fn last(
    conn: &mut Conn<'_>,
    of_run: &RunId,
    stage: Option<&StageName>,
    limit: u32,
) -> Result<Vec<LogRow>, QueryError> {
    let find = "SELECT b.*, s.task, s.attempt, s.worker FROM log_batches b JOIN log_streams s ON s.id = b.stream \
                WHERE b.id IN (SELECT id FROM log_batches WHERE stream IN \
                (SELECT id FROM log_streams WHERE run = ?1 AND (?2 IS NULL OR stage = ?2)) ORDER BY id DESC LIMIT ?3) \
                ORDER BY b.id DESC";
    let find = query(find).bind(of_run.as_str()).bind(stage.map(StageName::as_str)).bind(limit);
    let mut batches = find.fetch(&mut *conn);
    let mut rows = Vec::new();
    while rows.len() < limit as usize
        && let Some(batch) = batches.try_next().await?
    {
        rows.extend(lines(&batch)?.into_iter().rev());
    }
    rows.truncate(limit as usize);
    rows.reverse();
    Ok(rows)
}

fn lines(batch: &Row) -> Result<Vec<LogRow>, QueryError> {
    let (id, line): (i64, i64) = (batch.try_get("id")?, batch.try_get("line")?);
    let texts: Vec<String> = serde_json::from_str(batch.try_get("lines")?)
        .map_err(|error| QueryError::Database(format!("cannot parse the log lines from {id} on: {error}")))?;
    let task = TaskId::new(batch.try_get::<String, _>("task")?);
    let worker = WorkerId::new(batch.try_get::<String, _>("worker")?);
    let attempt = Attempt(batch.try_get::<i64, _>("attempt")?.unsigned_abs());
    let at_ms = batch.try_get("at_ms")?;
    let mut rows = Vec::new();
    for (place, text) in texts.into_iter().enumerate() {
        let id = id + place as i64;
        let line = line.unsigned_abs() + place as u64;
        rows.push(LogRow { id, task: task.clone(), attempt, worker: worker.clone(), line, at_ms, text });
    }
    Ok(rows)
}
