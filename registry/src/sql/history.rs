//! History: what happened, when, to whom and why. Rows are added and, once they are old, removed; none is changed.

use std::collections::BTreeMap;

use protocol::message::Times;
use protocol::{Group, ModelName, RunId, StageName, TaskId, WorkerId};

use super::statement::{Builder, Conn, Row, Values, insert, int, json, query, run};
use crate::catalog::{HistoryQuery, HistoryRow};
use crate::history::{HistoryEntry, HistoryKind};
use crate::{QueryError, WriteError};

/// Adds what happened at `now`, in milliseconds since 1970.
pub(super) async fn add(conn: &mut Conn<'_>, entries: &[HistoryEntry], now: i64) -> Result<(), WriteError> {
    let values = |row: &mut Values<'_, '_>, entry: &HistoryEntry| {
        row.push_bind(now).push_bind(entry.kind.name());
        row.push_bind(entry.run.as_ref().map(|run| run.as_str().to_owned()));
        row.push_bind(entry.stage.as_ref().map(|stage| stage.as_str().to_owned()));
        row.push_bind(entry.task.as_ref().map(|task| task.as_str().to_owned()));
        row.push_bind(entry.attempt.map(int)).push_bind(entry.step.map(int));
        row.push_bind(entry.worker.as_ref().map(|worker| worker.as_str().to_owned()));
        row.push_bind(entry.model.as_ref().map(|model| model.as_str().to_owned()));
        row.push_bind(entry.actor.clone()).push_bind(entry.why.clone());
    };
    let begin = "INSERT INTO history (at_ms, kind, run, stage, task, attempt, step, worker, model, actor, why) ";
    insert(conn, begin, entries, values, "").await?;
    for entry in entries {
        let (Some(of_run), Some(stage)) = (&entry.run, &entry.stage) else { continue };
        let set = match entry.kind {
            HistoryKind::Granted => {
                "INSERT INTO stage_times (run, stage, started_ms) VALUES (?, ?, ?) ON CONFLICT (run, stage) DO UPDATE SET ended_ms = NULL"
            }
            HistoryKind::Finished | HistoryKind::Failed => {
                "INSERT INTO stage_times (run, stage, started_ms, ended_ms) VALUES (?1, ?2, ?3, ?3) \
                 ON CONFLICT (run, stage) DO UPDATE SET ended_ms = excluded.ended_ms"
            }
            _ => continue,
        };
        run(conn, query(set).bind(of_run.as_str()).bind(stage.as_str()).bind(now)).await?;
    }
    Ok(())
}

/// Removes rows from before a time; returns how many.
pub(super) async fn prune(conn: &mut Conn<'_>, before_ms: i64) -> Result<u64, WriteError> {
    run(conn, query("DELETE FROM history WHERE at_ms < ?").bind(before_ms)).await
}

/// The ids of the oldest row and of the newest one ever added.
pub(super) async fn span(conn: &mut Conn<'_>) -> Result<(Option<i64>, i64), QueryError> {
    // The newest row may have been removed; its number is not given again.
    let find = "SELECT (SELECT min(id) FROM history), coalesce({added_history}, 0)";
    let row = query(find).fetch_one(conn).await?;
    Ok((row.try_get(0)?, row.try_get(1)?))
}

/// Records the last row that a hook has received.
pub(super) async fn record_delivery(conn: &mut Conn<'_>, hook: &str, id: i64) -> Result<(), WriteError> {
    let note = "INSERT INTO webhooks (name, delivered) VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET delivered = excluded.delivered";
    run(conn, query(note).bind(hook).bind(id)).await.map(drop)
}

/// The last row that a hook has received.
pub(super) async fn delivered(conn: &mut Conn<'_>, hook: &str) -> Result<Option<i64>, QueryError> {
    let row = query("SELECT delivered FROM webhooks WHERE name = ?").bind(hook).fetch_optional(conn).await?;
    Ok(row.map(|row| row.try_get("delivered")).transpose()?)
}

/// Rows in the order in which they happened. Those of runs of others than `group` are left out, if there is one.
pub(super) async fn read(
    conn: &mut Conn<'_>,
    asked: &HistoryQuery,
    group: Option<&Group>,
) -> Result<Vec<HistoryRow>, QueryError> {
    let mut find = Builder::new("SELECT * FROM history WHERE id > ");
    find.push_bind(asked.after);
    if let Some(of_run) = &asked.run {
        find.push(" AND run = ").push_bind(of_run.as_str());
    }
    if let Some(worker) = &asked.worker {
        find.push(" AND worker = ").push_bind(worker.as_str());
    }
    if let Some(since_ms) = asked.since_ms {
        find.push(" AND at_ms >= ").push_bind(since_ms);
    }
    if let Some(group) = group {
        find.push(" AND (run IS NULL OR run IN (SELECT run FROM run_owners WHERE owner = ").push_bind(group.as_str());
        find.push(")) AND (model IS NULL OR model IN (SELECT model FROM model_owners WHERE owner = ")
            .push_bind(group.as_str());
        find.push("))");
    }
    find.push(" ORDER BY id LIMIT ").push_bind(asked.limit);
    let rows = find.build().fetch_all(conn).await?;
    let mut rows = rows.iter().map(history_row).collect::<Result<Vec<_>, _>>()?;
    if group.is_some() {
        // Workers are everyone's to see, the tokens that they came with are not.
        rows.iter_mut().filter(|row| row.entry.run.is_none()).for_each(|row| row.entry.actor = None);
    }
    Ok(rows)
}

fn history_row(row: &Row) -> Result<HistoryRow, QueryError> {
    let text = |column: &str| row.try_get::<Option<String>, _>(column);
    let number = |column: &str| row.try_get::<Option<i64>, _>(column).map(|number| number.map(i64::unsigned_abs));
    let name = row.try_get::<&str, _>("kind")?;
    let kind = HistoryKind::ALL.into_iter().find(|kind| kind.name() == name);
    let kind =
        kind.ok_or_else(|| QueryError::Database(format!("`{name}` is not a kind of history that this build knows")))?;
    let entry = HistoryEntry {
        kind,
        run: text("run")?.map(RunId::new),
        stage: text("stage")?.map(StageName::new),
        task: text("task")?.map(TaskId::new),
        attempt: number("attempt")?,
        step: number("step")?,
        worker: text("worker")?.map(WorkerId::new),
        model: text("model")?.map(ModelName::new),
        actor: text("actor")?,
        why: text("why")?,
    };
    Ok(HistoryRow { id: row.try_get("id")?, at_ms: row.try_get("at_ms")?, entry })
}

/// Times of a run's stages by name, of those that were begun in its name.
pub(super) async fn stage_times(conn: &mut Conn<'_>, of_run: &RunId) -> Result<BTreeMap<StageName, Times>, QueryError> {
    let find = query("SELECT stage, started_ms, ended_ms FROM stage_times WHERE run = ?").bind(of_run.as_str());
    let mut times = BTreeMap::new();
    for row in find.fetch_all(conn).await? {
        let stage = StageName::new(row.try_get::<String, _>("stage")?);
        let started_ms = row.try_get("started_ms")?;
        let ended_ms = row.try_get("ended_ms")?;
        times.insert(stage, Times { created_ms: None, started_ms, ended_ms });
    }
    Ok(times)
}

/// Times of runs by name.
pub(super) async fn run_times(conn: &mut Conn<'_>, runs: &[RunId]) -> Result<BTreeMap<RunId, Times>, QueryError> {
    let find = "SELECT run, created_ms, (SELECT min(started_ms) FROM stage_times WHERE stage_times.run = runs.run) AS started_ms, \
                CASE WHEN state IN ('finished', 'failed', 'cancelled') THEN {greatest}(updated_ms, coalesce((SELECT max(ended_ms) FROM stage_times WHERE stage_times.run = runs.run), 0)) END AS ended_ms \
                FROM runs WHERE run IN {texts ?}";
    let mut times = BTreeMap::new();
    for row in query(find).bind(json(&runs)).fetch_all(conn).await? {
        let run = RunId::new(row.try_get::<String, _>("run")?);
        let created_ms = row.try_get("created_ms")?;
        let started_ms = row.try_get("started_ms")?;
        let ended_ms = row.try_get("ended_ms")?;
        times.insert(run, Times { created_ms, started_ms, ended_ms });
    }
    Ok(times)
}
