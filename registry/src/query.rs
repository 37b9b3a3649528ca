//! What the store says, read from what is committed.

use std::collections::BTreeMap;

use protocol::{Alias, Attempt, Digest, ModelName, RunId, StageName, TaskId, WorkerId};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use crate::catalog::{self, Model, Promotion, Version, numbers};
use crate::{ReadStore, WriteError};

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    /// No such thing.
    #[error("{0}")]
    NotFound(String),
    /// The question is malformed.
    #[error("{0}")]
    Invalid(String),
    /// The database.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// The blobs.
    #[error("{0}")]
    Blob(String),
    /// The disk did not take a change.
    #[error("{0}")]
    Storage(String),
}

impl From<QueryError> for WriteError {
    fn from(e: QueryError) -> Self {
        match e {
            QueryError::NotFound(message) => Self::NotFound(message),
            QueryError::Invalid(message) => Self::Conflict(message),
            QueryError::Database(e) => crate::db::write_error(e),
            QueryError::Blob(message) => Self::Internal(message),
            QueryError::Storage(message) => Self::Storage(message),
        }
    }
}

type Result<T> = std::result::Result<T, QueryError>;

/// A run as stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRow {
    /// Which.
    pub run: RunId,
    /// The validated pipeline.
    pub pipeline: Value,
    /// The YAML as written.
    pub source: String,
    /// `running`, `paused`, `finished`, `failed`, `cancelled`.
    pub state: String,
    /// Unique when given.
    pub idempotency_key: Option<String>,
    /// When it was submitted, in milliseconds since 1970.
    pub created_ms: i64,
    /// When it last changed, in milliseconds since 1970.
    pub updated_ms: i64,
}

/// What a coordinator recovers from, each with the number of its decision.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovery {
    /// The newest snapshot.
    pub snapshot: Option<(u64, String)>,
    /// Facts, oldest first; those after the snapshot count.
    pub facts: Vec<(u64, String)>,
}

/// What is kept of a run that ended. What each says is the coordinator's business; see [`Write::RunEnded`](crate::Write::RunEnded).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndedRow {
    /// The run as clients see it.
    pub view: String,
    /// The run as the coordinator takes it up again.
    pub archive: String,
}

/// A stage's value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageResultRow {
    /// The stage's key.
    pub key: Digest,
    /// Which run made it.
    pub run: RunId,
    /// Which stage.
    pub stage: StageName,
    /// Its kind.
    pub kind: String,
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values.
    pub metrics: BTreeMap<String, f64>,
    /// What it was made of.
    pub inputs: BTreeMap<String, Digest>,
    /// Seconds of work.
    pub wall_s: f64,
    /// When, in milliseconds since 1970.
    pub at_ms: i64,
}

/// A committed checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckpointRow {
    /// The task.
    pub task: TaskId,
    /// Which attempt saved it.
    pub attempt: Attempt,
    /// Steps applied.
    pub step: u64,
    /// The manifest.
    pub manifest: Digest,
    /// Values that retention may rank by.
    pub metrics: BTreeMap<String, f64>,
    /// When, in milliseconds since 1970.
    pub at_ms: i64,
}

/// A log line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogRow {
    /// Grows; ask for what comes after the last one seen.
    pub id: i64,
    /// The task.
    pub task: TaskId,
    /// The try.
    pub attempt: Attempt,
    /// Who wrote it.
    pub worker: WorkerId,
    /// Its number within attempt and worker.
    pub line: u64,
    /// When it was stored, in milliseconds since 1970.
    pub at_ms: i64,
    /// The line.
    pub text: String,
}

/// An artifact and what it was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LineageNode {
    /// The artifact.
    pub digest: Digest,
    /// Its kind, if a stage made it.
    pub kind: Option<String>,
    /// The run that made it.
    pub run: Option<String>,
    /// The stage that made it.
    pub stage: Option<String>,
    /// Its stage's key.
    pub key: Option<String>,
    /// Bytes of its files.
    pub bytes: Option<u64>,
    /// What it was made of, by the field that named it.
    pub inputs: BTreeMap<String, Digest>,
    /// How many steps from the artifact asked for.
    pub depth: u32,
}

impl ReadStore {
    async fn connection(&self) -> Result<sqlx::pool::PoolConnection<sqlx::Sqlite>> {
        Ok(self.readers().acquire().await?)
    }

    /// What a coordinator recovers from.
    pub async fn recovery(&self) -> Result<Recovery> {
        let mut conn = self.connection().await?;
        // One statement is one moment of the database; two might see a snapshot and no longer the facts before it.
        let all = "SELECT 0 AS kind, seq, state AS text FROM (SELECT * FROM snapshots ORDER BY seq DESC LIMIT 1) \
                   UNION ALL SELECT 1, seq, facts FROM facts ORDER BY kind, seq";
        let mut recovery = Recovery::default();
        for row in sqlx::query(all).fetch_all(&mut *conn).await? {
            let (kind, seq, text): (i64, i64, String) = (row.try_get(0)?, row.try_get(1)?, row.try_get(2)?);
            match kind {
                0 => recovery.snapshot = Some((seq.unsigned_abs(), text)),
                _ => recovery.facts.push((seq.unsigned_abs(), text)),
            }
        }
        Ok(recovery)
    }

    /// What is kept of a run that ended; `None` while it has never ended.
    pub async fn ended(&self, run: &RunId) -> Result<Option<EndedRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT view, archive FROM runs WHERE run = ? AND view IS NOT NULL");
        let row = find.bind(run.as_str()).fetch_optional(&mut *conn).await?;
        let ended = |row: SqliteRow| Ok(EndedRow { view: row.try_get(0)?, archive: row.try_get(1)? });
        row.map(ended).transpose()
    }

    /// The views of runs that ended, as JSON, with their runs; oldest first. Of more than `limit` the newest.
    pub async fn ended_views(&self, limit: u32) -> Result<Vec<(RunId, String)>> {
        let mut conn = self.connection().await?;
        let find = "SELECT run, view FROM (SELECT rowid AS number, run, view FROM runs WHERE view IS NOT NULL \
                    ORDER BY rowid DESC LIMIT ?) ORDER BY number";
        let rows = sqlx::query(find).bind(limit).fetch_all(&mut *conn).await?;
        rows.iter().map(|row| Ok((RunId::new(row.try_get::<String, _>(0)?), row.try_get(1)?))).collect()
    }

    /// Under whose names the logs and values behind stage keys are stored: those of the value, or of what there is of it.
    pub async fn sources(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, (RunId, StageName)>> {
        let mut conn = self.connection().await?;
        let find = "SELECT key, run, stage FROM executions WHERE key IN (SELECT value FROM json_each(?1)) \
                    UNION ALL SELECT key, run, stage FROM stage_results WHERE key IN (SELECT value FROM json_each(?1))";
        let rows = sqlx::query(find).bind(crate::db::apply::json(&keys)).fetch_all(&mut *conn).await?;
        let source = |row: &SqliteRow| -> Result<_> {
            let (run, stage): (String, String) = (row.try_get("run")?, row.try_get("stage")?);
            Ok((digest(row, "key")?, (RunId::new(run), StageName::new(stage))))
        };
        // A value that is there stands behind what was left on the way to it.
        rows.iter().map(source).collect()
    }

    /// What a coordinator left of a stage's value when nobody waited for it any more, as JSON.
    pub async fn archived_execution(&self, key: Digest) -> Result<Option<String>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT execution FROM executions WHERE key = ?").bind(key.to_string());
        Ok(find.fetch_optional(&mut *conn).await?.map(|row| row.try_get(0)).transpose()?)
    }

    /// The value stored under a stage key.
    pub async fn stage_result(&self, key: Digest) -> Result<Option<StageResultRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT * FROM stage_results WHERE key = ?").bind(key.to_string());
        find.fetch_optional(&mut *conn).await?.as_ref().map(stage_result).transpose()
    }

    /// The values whose keys are among `keys`.
    pub async fn stage_results(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, StageResultRow>> {
        let mut conn = self.connection().await?;
        let find = "SELECT * FROM stage_results WHERE key IN (SELECT value FROM json_each(?))";
        let rows = sqlx::query(find).bind(crate::db::apply::json(&keys)).fetch_all(&mut *conn).await?;
        rows.iter().map(|row| stage_result(row).map(|result| (result.key, result))).collect()
    }

    /// All runs, newest first.
    pub async fn runs(&self) -> Result<Vec<RunRow>> {
        let mut conn = self.connection().await?;
        let rows = sqlx::query("SELECT * FROM runs ORDER BY created_ms DESC, rowid DESC").fetch_all(&mut *conn).await?;
        rows.iter().map(run_row).collect()
    }

    /// One run.
    pub async fn run(&self, run: &RunId) -> Result<Option<RunRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT * FROM runs WHERE run = ?").bind(run.as_str());
        find.fetch_optional(&mut *conn).await?.as_ref().map(run_row).transpose()
    }

    /// The run that was submitted with an idempotency key.
    pub async fn run_by_key(&self, key: &str) -> Result<Option<RunRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT * FROM runs WHERE idempotency_key = ?").bind(key);
        find.fetch_optional(&mut *conn).await?.as_ref().map(run_row).transpose()
    }

    /// A task's committed checkpoints, newest first.
    pub async fn checkpoints(&self, task: &TaskId) -> Result<Vec<CheckpointRow>> {
        let mut conn = self.connection().await?;
        checkpoints(&mut conn, task).await
    }

    /// A task's newest committed checkpoint: where the next attempt goes on.
    pub async fn latest_checkpoint(&self, task: &TaskId) -> Result<Option<CheckpointRow>> {
        Ok(self.checkpoints(task).await?.into_iter().next())
    }

    /// The shards of a run's map stages that are stored, by task.
    pub async fn shards(&self, run: &RunId) -> Result<BTreeMap<TaskId, Digest>> {
        let mut conn = self.connection().await?;
        let rows = sqlx::query("SELECT task, output FROM shards WHERE run = ?")
            .bind(run.as_str())
            .fetch_all(&mut *conn)
            .await?;
        rows.iter().map(|row| Ok((TaskId::new(row.try_get::<String, _>(0)?), digest(row, "output")?))).collect()
    }

    /// Log lines of a run, or of one stage of it, that were stored after line `after`; at most `limit`.
    pub async fn logs(&self, run: &RunId, stage: Option<&StageName>, after: i64, limit: u32) -> Result<Vec<LogRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query(
            "SELECT * FROM logs WHERE run = ?1 AND (?2 IS NULL OR stage = ?2) AND id > ?3 ORDER BY id LIMIT ?4",
        );
        let find = find.bind(run.as_str()).bind(stage.map(StageName::as_str)).bind(after).bind(limit);
        let line = |row: &SqliteRow| -> Result<LogRow> {
            Ok(LogRow {
                id: row.try_get("id")?,
                task: TaskId::new(row.try_get::<String, _>("task")?),
                attempt: Attempt(row.try_get::<i64, _>("attempt")?.unsigned_abs()),
                worker: WorkerId::new(row.try_get::<String, _>("worker")?),
                line: row.try_get::<i64, _>("line")?.unsigned_abs(),
                at_ms: row.try_get("at_ms")?,
                text: row.try_get("text")?,
            })
        };
        find.fetch_all(&mut *conn).await?.iter().map(line).collect()
    }

    /// All models.
    pub async fn models(&self) -> Result<Vec<Model>> {
        let mut conn = self.connection().await?;
        Ok(catalog::models(&mut conn).await?)
    }

    /// One model.
    pub async fn model(&self, model: &ModelName) -> Result<Option<Model>> {
        let mut conn = self.connection().await?;
        Ok(catalog::model(&mut conn, model).await?)
    }

    /// A model's versions, oldest first.
    pub async fn versions(&self, model: &ModelName) -> Result<Vec<Version>> {
        let mut conn = self.connection().await?;
        Ok(catalog::versions(&mut conn, model).await?)
    }

    /// The version that an artifact was registered as.
    pub async fn version_of(&self, model: &ModelName, artifact: Digest) -> Result<Option<Version>> {
        let mut conn = self.connection().await?;
        Ok(catalog::version_of(&mut conn, model, artifact).await?)
    }

    /// The moves of a model's aliases, or of one of them, oldest first.
    pub async fn history(&self, model: &ModelName, alias: Option<&Alias>) -> Result<Vec<Promotion>> {
        let mut conn = self.connection().await?;
        Ok(catalog::history(&mut conn, model, alias).await?)
    }

    /// The version behind `quickstart@staging`, `quickstart@best` or `quickstart:3`.
    pub async fn resolve(&self, reference: &str) -> Result<Version> {
        let mut conn = self.connection().await?;
        catalog::resolve(&mut conn, reference).await
    }

    /// An artifact and all that it was made of, nearest first.
    pub async fn lineage(&self, digest: Digest) -> Result<Vec<LineageNode>> {
        let mut conn = self.connection().await?;
        lineage(&mut conn, digest).await
    }
}

pub(crate) fn digest(row: &SqliteRow, column: &str) -> Result<Digest> {
    let text: String = row.try_get(column)?;
    text.parse().map_err(|e| QueryError::Blob(format!("column `{column}`: {e}")))
}

pub(crate) fn digests(text: &str) -> Result<BTreeMap<String, Digest>> {
    serde_json::from_str(text).map_err(|e| QueryError::Blob(format!("a list of artifacts does not read: {e}")))
}

fn stage_result(row: &SqliteRow) -> Result<StageResultRow> {
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

fn run_row(row: &SqliteRow) -> Result<RunRow> {
    let pipeline: &str = row.try_get("pipeline")?;
    Ok(RunRow {
        run: RunId::new(row.try_get::<String, _>("run")?),
        pipeline: serde_json::from_str(pipeline)
            .map_err(|e| QueryError::Blob(format!("a stored pipeline is no JSON: {e}")))?,
        source: row.try_get("source")?,
        state: row.try_get("state")?,
        idempotency_key: row.try_get("idempotency_key")?,
        created_ms: row.try_get("created_ms")?,
        updated_ms: row.try_get("updated_ms")?,
    })
}

pub(crate) async fn checkpoints(conn: &mut SqliteConnection, task: &TaskId) -> Result<Vec<CheckpointRow>> {
    let find = sqlx::query("SELECT * FROM checkpoints WHERE task = ? ORDER BY step DESC, id DESC").bind(task.as_str());
    let checkpoint = |row: &SqliteRow| -> Result<CheckpointRow> {
        Ok(CheckpointRow {
            task: task.clone(),
            attempt: Attempt(row.try_get::<i64, _>("attempt")?.unsigned_abs()),
            step: row.try_get::<i64, _>("step")?.unsigned_abs(),
            manifest: digest(row, "manifest")?,
            metrics: numbers(row.try_get("metrics")?),
            at_ms: row.try_get("at_ms")?,
        })
    };
    find.fetch_all(&mut *conn).await?.iter().map(checkpoint).collect()
}

pub(crate) async fn lineage(conn: &mut SqliteConnection, root: Digest) -> Result<Vec<LineageNode>> {
    let mut nodes: Vec<LineageNode> = Vec::new();
    let mut next = vec![root];
    let mut depth = 0;
    while !next.is_empty() {
        let mut after = Vec::new();
        for digest_ in next {
            if nodes.iter().any(|node| node.digest == digest_) {
                continue;
            }
            let name = digest_.to_string();
            let row =
                sqlx::query("SELECT * FROM artifacts WHERE digest = ?").bind(&name).fetch_optional(&mut *conn).await?;
            let edges = sqlx::query("SELECT parent, role FROM edges WHERE child = ? ORDER BY role").bind(&name);
            let mut inputs = BTreeMap::new();
            for edge in edges.fetch_all(&mut *conn).await? {
                inputs.insert(edge.try_get::<String, _>("role")?, digest(&edge, "parent")?);
            }
            after.extend(inputs.values().copied());
            let mut node = LineageNode {
                digest: digest_,
                kind: None,
                run: None,
                stage: None,
                key: None,
                bytes: None,
                inputs,
                depth,
            };
            if let Some(row) = row {
                node.kind = row.try_get("kind")?;
                node.run = row.try_get("run")?;
                node.stage = row.try_get("stage")?;
                node.key = row.try_get("key")?;
                node.bytes = Some(row.try_get::<i64, _>("bytes")?.unsigned_abs());
            }
            nodes.push(node);
        }
        next = after;
        depth += 1;
    }
    Ok(nodes)
}
