//! Deletion of runs in the tables; [`crate::forget`] describes the rules.

use std::collections::BTreeSet;

use protocol::{RunId, StageName};

use super::error::write_error;
use super::owners;
use super::statement::{Conn, one, query, run as execute};
use crate::forget::Forgotten;
use crate::{WriteError, clock};

/// Deletes an ended run, and data of earlier ones that is no longer needed.
pub(super) async fn forget(conn: &mut Conn<'_>, run: &RunId) -> Result<Forgotten, WriteError> {
    let find = query("SELECT state, view IS NOT NULL FROM runs WHERE run = ?").bind(run.as_str());
    let Some(row) = one(conn, find).await? else {
        return Err(WriteError::NotFound(format!("there is no run `{run}`")));
    };
    let (state, has_ended): (String, bool) = (row.get(0), row.get(1));
    if !has_ended || !matches!(state.as_str(), "finished" | "failed" | "cancelled") {
        return Err(WriteError::Conflict(format!(
            "run `{run}` is {state}; only an ended run can be forgotten; `trainer cancel {run}` ends it"
        )));
    }
    execute(conn, query("DELETE FROM runs WHERE run = ?").bind(run.as_str())).await?;
    owners::disown_run(conn, run).await?;
    let note = query("INSERT INTO forgotten (run, at_ms) VALUES (?, ?) ON CONFLICT DO NOTHING");
    execute(conn, note.bind(run.as_str()).bind(clock::now_ms())).await?;
    let mut gone = Forgotten::default();
    for row in query("SELECT run FROM forgotten").fetch_all(&mut *conn).await.map_err(write_error)? {
        forget_stages(conn, row.get(0), &mut gone).await?;
    }
    Ok(gone)
}

/// Deletes unreferenced data of a run that ended before a time. The run and its stages' values stay; resuming the run
/// computes the deleted data again.
pub(super) async fn forget_leftovers(
    conn: &mut Conn<'_>,
    run: &RunId,
    before_ms: i64,
) -> Result<Forgotten, WriteError> {
    let mut gone = Forgotten::default();
    let ended = "SELECT 1 FROM runs WHERE run = ? AND view IS NOT NULL AND state IN ('finished', 'failed', 'cancelled') AND updated_ms < ?";
    if one(conn, query(ended).bind(run.as_str()).bind(before_ms)).await?.is_none() {
        return Ok(gone);
    }
    let run = run.as_str();
    let kept = query(STILL_NEEDED).bind(run).bind(before_ms).fetch_all(&mut *conn).await.map_err(write_error)?;
    let kept: BTreeSet<String> = kept.iter().map(|row| row.get(0)).collect();
    let under_way = stages(conn, UNDER_WAY, run).await?;
    let valued = stages(conn, "SELECT stage FROM stage_results WHERE run = ?1", run).await?;
    let left = stages(conn, LEFT, run).await?;
    let left: BTreeSet<&str> = left.iter().map(|name| name.split('/').next().unwrap_or_default()).collect();
    for stage in left {
        let is_trial = stage.contains('.');
        let is_needed = kept.contains(stage) || under_way.contains(stage.split('.').next().unwrap_or_default());
        if (is_trial || !valued.contains(stage)) && !is_needed {
            forget_stage(conn, run, &StageName::new(stage), &mut gone).await?;
        }
    }
    Ok(gone)
}

async fn stages(conn: &mut Conn<'_>, sql: &'static str, run: &str) -> Result<BTreeSet<String>, WriteError> {
    let rows = query(sql).bind(run).fetch_all(conn).await.map_err(write_error)?;
    Ok(rows.iter().map(|row| row.get(0)).collect())
}

/// All stages with rows of the run.
const STAGES: &str = "SELECT stage FROM stage_results WHERE run = ?1 UNION SELECT stage FROM executions WHERE run = ?1 \
    UNION SELECT stage FROM series WHERE run = ?1 UNION SELECT stage FROM log_streams WHERE run = ?1 \
    UNION SELECT substr(task, length(?1) + 2) FROM checkpoints WHERE task >= ?1 || '/' AND task < ?1 || '0' \
    UNION SELECT substr(task, length(?1) + 2) FROM fences WHERE task >= ?1 || '/' AND task < ?1 || '0'";

/// Stages in the lineage of a version or a pin, or whose value another run has.
const NEEDED: &str = "WITH RECURSIVE lineage (digest) AS (SELECT artifact FROM versions UNION SELECT digest FROM pins \
    UNION SELECT parent FROM edges JOIN lineage ON child = lineage.digest), \
    held (key) AS (SELECT stage.value ->> 'key' FROM runs, {stages runs.view} AS stage) \
    SELECT stage FROM stage_results, {pairs outputs} AS output WHERE run = ?1 AND output.value IN (SELECT digest FROM lineage) \
    UNION SELECT stage FROM stage_results WHERE run = ?1 AND key IN (SELECT key FROM held) \
    UNION SELECT stage FROM executions WHERE run = ?1 AND key IN (SELECT key FROM held)";

/// Stages with rows that name blobs.
const LEFT: &str = "SELECT stage FROM stage_results WHERE run = ?1 \
    UNION SELECT substr(task, length(?1) + 2) FROM checkpoints WHERE task >= ?1 || '/' AND task < ?1 || '0' \
    UNION SELECT substr(task, length(?1) + 2) FROM shards WHERE task >= ?1 || '/' AND task < ?1 || '0'";

/// Stages in the lineage of a version or a pin, or whose value a stage other than a trial or a recently ended run has.
const STILL_NEEDED: &str = "WITH RECURSIVE lineage (digest) AS (SELECT artifact FROM versions UNION SELECT digest FROM pins \
    UNION SELECT parent FROM edges JOIN lineage ON child = lineage.digest), \
    held (key, is_trial, is_recent) AS (SELECT stage.value ->> 'key', \
        stage.value ->> 'of' IS NOT NULL, updated_ms >= ?2 \
        FROM runs, {stages runs.view} AS stage) \
    SELECT stage FROM stage_results, {pairs outputs} AS output WHERE run = ?1 AND output.value IN (SELECT digest FROM lineage) \
    UNION SELECT stage FROM stage_results WHERE run = ?1 AND key IN (SELECT key FROM held WHERE NOT is_trial OR is_recent) \
    UNION SELECT stage FROM executions WHERE run = ?1 AND key IN (SELECT key FROM held WHERE is_recent)";

/// Names of the stages of running runs.
const UNDER_WAY: &str = "SELECT stage.value ->> 'name' FROM runs, {stages runs.pipeline} AS stage \
    WHERE state IN ('running', 'paused') AND ?1 = ?1";

async fn forget_stages(conn: &mut Conn<'_>, run: &str, gone: &mut Forgotten) -> Result<(), WriteError> {
    let needed = stages(conn, NEEDED, run).await?;
    let under_way = stages(conn, UNDER_WAY, run).await?;
    // The name of a sweep's stage starts with the swept stage and a dot; a shard's task ends with a slash and its
    // number.
    let first = |name: &str| name.split(['.', '/']).next().unwrap_or_default().to_owned();
    let all: BTreeSet<String> = stages(conn, STAGES, run).await?;
    let all = all.iter().map(|name| name.split('/').next().unwrap_or_default().to_owned());
    let mut kept_any = false;
    for stage in all.collect::<BTreeSet<_>>() {
        if needed.contains(&stage) || under_way.contains(&first(&stage)) {
            kept_any = true;
            gone.kept.push(format!("{run}/{stage}"));
            continue;
        }
        forget_stage(conn, run, &StageName::new(stage), gone).await?;
    }
    if !kept_any {
        execute(conn, query("DELETE FROM shards WHERE run = ?").bind(run)).await?;
        execute(conn, query("DELETE FROM usage WHERE run = ?").bind(run)).await?;
        execute(conn, query("DELETE FROM forgotten WHERE run = ?").bind(run)).await?;
    }
    Ok(())
}

async fn forget_stage(
    conn: &mut Conn<'_>,
    run: &str,
    stage: &StageName,
    gone: &mut Forgotten,
) -> Result<(), WriteError> {
    let mut delete = async |sql: &'static str| execute(conn, query(sql).bind(run).bind(stage.as_str())).await;
    delete("DELETE FROM rollups WHERE series IN (SELECT id FROM series WHERE run = ?1 AND stage = ?2)").await?;
    delete("DELETE FROM recorded WHERE recorder IN (SELECT id FROM recorders WHERE run = ?1 AND stage = ?2)").await?;
    delete("DELETE FROM recorders WHERE run = ?1 AND stage = ?2").await?;
    gone.values +=
        delete("DELETE FROM metrics WHERE series IN (SELECT id FROM series WHERE run = ?1 AND stage = ?2)").await?;
    delete("DELETE FROM series WHERE run = ?1 AND stage = ?2").await?;
    let streams = "SELECT CAST(coalesce(sum(count), 0) AS BIGINT) FROM log_batches WHERE stream IN \
                   (SELECT id FROM log_streams WHERE run = ?1 AND stage = ?2)";
    let lines = query(streams).bind(run).bind(stage.as_str()).fetch_one(&mut *conn).await.map_err(write_error)?;
    gone.lines += lines.get::<i64, _>(0).unsigned_abs();
    let mut delete = async |sql: &'static str| execute(conn, query(sql).bind(run).bind(stage.as_str())).await;
    delete("DELETE FROM log_batches WHERE stream IN (SELECT id FROM log_streams WHERE run = ?1 AND stage = ?2)")
        .await?;
    delete("DELETE FROM log_streams WHERE run = ?1 AND stage = ?2").await?;
    delete("DELETE FROM stage_times WHERE run = ?1 AND stage = ?2").await?;
    delete("DELETE FROM executions WHERE run = ?1 AND stage = ?2").await?;
    // A task's name is `run/stage` or `run/stage/shard`; `0` is the character after `/`.
    gone.checkpoints += delete(
        "DELETE FROM checkpoints WHERE task = ?1 || '/' || ?2 OR (task >= ?1 || '/' || ?2 || '/' AND task < ?1 || '/' || ?2 || '0')",
    )
    .await?;
    delete("DELETE FROM shards WHERE task = ?1 || '/' || ?2 OR (task >= ?1 || '/' || ?2 || '/' AND task < ?1 || '/' || ?2 || '0')")
        .await?;
    delete("DELETE FROM fences WHERE task = ?1 || '/' || ?2 OR (task >= ?1 || '/' || ?2 || '/' AND task < ?1 || '/' || ?2 || '0')")
        .await?;
    delete("DELETE FROM edges WHERE child IN (SELECT digest FROM artifacts WHERE run = ?1 AND stage = ?2)").await?;
    delete("DELETE FROM artifacts WHERE run = ?1 AND stage = ?2").await?;
    gone.results += delete("DELETE FROM stage_results WHERE run = ?1 AND stage = ?2").await?;
    Ok(())
}
