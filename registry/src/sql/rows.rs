//! Conversion of rows to the catalog's types.

use std::collections::BTreeMap;

use protocol::{Attempt, Digest, RunId, StageName, TaskId};

use super::models::numbers;
use super::statement::{Conn, Row, query};
use crate::QueryError;
use crate::catalog::{CheckpointRow, References, RunRow, StageResultRow};

type Result<T> = std::result::Result<T, QueryError>;

pub(super) fn digest(row: &Row, column: &str) -> Result<Digest> {
    let text: String = row.try_get(column)?;
    text.parse().map_err(|e| QueryError::Blob(format!("column `{column}`: {e}")))
}

pub(super) fn digests(text: &str) -> Result<BTreeMap<String, Digest>> {
    serde_json::from_str(text).map_err(|e| QueryError::Blob(format!("cannot parse a list of artifacts: {e}")))
}

pub(super) fn references(text: &str) -> Result<References> {
    serde_json::from_str(text).map_err(|e| QueryError::Blob(format!("cannot parse the references of an artifact: {e}")))
}

pub(super) fn stage_result(row: &Row) -> Result<StageResultRow> {
    Ok(StageResultRow {
        key: digest(row, "key")?,
        run: RunId::new(row.try_get::<String, _>("run")?),
        stage: StageName::new(row.try_get::<String, _>("stage")?),
        kind: row.try_get("kind")?,
        outputs: digests(row.try_get("outputs")?)?,
        metrics: numbers(row.try_get("metrics")?),
        inputs: digests(row.try_get("inputs")?)?,
        wall_s: row.try_get("wall_s")?,
        at_ms: row.try_get("at_ms")?,
    })
}

pub(super) fn run_row(row: &Row) -> Result<RunRow> {
    let pipeline: &str = row.try_get("pipeline")?;
    Ok(RunRow {
        run: RunId::new(row.try_get::<String, _>("run")?),
        pipeline: serde_json::from_str(pipeline)
            .map_err(|e| QueryError::Blob(format!("a stored pipeline is not JSON: {e}")))?,
        source: row.try_get("source")?,
        state: row.try_get("state")?,
        idempotency_key: row.try_get("idempotency_key")?,
        submission: row.try_get("submission")?,
        created_ms: row.try_get("created_ms")?,
        updated_ms: row.try_get("updated_ms")?,
    })
}

pub(super) async fn checkpoints(conn: &mut Conn<'_>, task: &TaskId) -> Result<Vec<CheckpointRow>> {
    let find = query("SELECT * FROM checkpoints WHERE task = ? ORDER BY step DESC, id DESC").bind(task.as_str());
    let mut checkpoints = Vec::new();
    for row in find.fetch_all(&mut *conn).await? {
        checkpoints.push(CheckpointRow {
            task: task.clone(),
            attempt: Attempt(row.try_get::<i64, _>("attempt")?.unsigned_abs()),
            step: row.try_get::<i64, _>("step")?.unsigned_abs(),
            manifest: digest(&row, "manifest")?,
            metrics: numbers(row.try_get("metrics")?),
            at_ms: row.try_get("at_ms")?,
        });
    }
    Ok(checkpoints)
}
