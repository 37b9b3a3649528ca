//! Queries in SQL over read-only connections.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use async_trait::async_trait;
use futures::TryStreamExt as _;
use protocol::message::Times;
use protocol::{Alias, Digest, Group, ModelName, RunId, StageName, TaskId};
use sqlx::pool::PoolConnection;
use sqlx::sqlite::SqliteRow;
use sqlx::{Connection, Row, Sqlite, SqliteConnection, SqlitePool};

use super::open::{open_copy, stored};
use super::rows::{checkpoints, digest, run_row, stage_result};
use super::statement::json;
use super::{curves, history, logs, models, owners, retention, run_list, usage};
use crate::QueryError;
use crate::catalog::{
    CheckpointRow, EndedRow, HistoryQuery, HistoryRow, KindSize, LineageNode, LogRow, Needs, Records, Recovery,
    RunListQuery, RunPage, RunRow, StageResultRow, Usage,
};
use crate::curve::{Buckets, Curve, Page, Window};
use crate::store_id::Stored;
use crate::versions::{Model, Promotion, Version};

type Result<T> = std::result::Result<T, QueryError>;

/// A query for rows of runs with their submissions.
macro_rules! runs {
    ($which:literal) => {
        concat!("SELECT runs.*, submissions.digest AS submission FROM runs LEFT JOIN submissions USING (run) ", $which)
    };
}

/// A pool of read-only connections.
#[derive(Debug)]
pub(crate) struct SqliteRecords(SqlitePool);

impl SqliteRecords {
    /// Wraps connections made by [`super::open_readers`].
    pub(crate) fn new(readers: SqlitePool) -> Self {
        Self(readers)
    }

    async fn connection(&self) -> Result<PoolConnection<Sqlite>> {
        Ok(self.0.acquire().await?)
    }
}

#[async_trait]
impl Records for SqliteRecords {
    async fn stored(&self) -> Result<Option<Stored>> {
        Ok(stored(&mut *self.connection().await?).await?)
    }

    async fn recovery(&self) -> Result<Recovery> {
        let mut conn = self.connection().await?;
        // One transaction sees one moment; two could see a snapshot without the facts after it.
        let mut moment = conn.begin().await?;
        let mut recovery = Recovery::default();
        let newest = "SELECT seq, state FROM snapshots ORDER BY seq DESC LIMIT 1";
        if let Some(row) = sqlx::query(newest).fetch_optional(&mut *moment).await? {
            let seq: i64 = row.try_get(0)?;
            recovery.snapshot = Some((seq.unsigned_abs(), row.try_get(1)?));
            // SQLite takes the other columns of a group from the row with the maximum.
            let parts = "SELECT part, state, max(seq) FROM snapshot_parts WHERE seq <= ? GROUP BY part";
            let mut rows = sqlx::query(parts).bind(seq).fetch(&mut *moment);
            while let Some(row) = rows.try_next().await? {
                if let Some(state) = row.try_get(1)? {
                    recovery.parts.insert(row.try_get(0)?, state);
                }
            }
        }
        let facts = "SELECT seq, facts FROM facts ORDER BY seq";
        for row in sqlx::query(facts).fetch_all(&mut *moment).await? {
            recovery.facts.push((row.try_get::<i64, _>(0)?.unsigned_abs(), row.try_get(1)?));
        }
        moment.rollback().await?;
        Ok(recovery)
    }

    async fn ended(&self, run: &RunId) -> Result<Option<EndedRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT view, archive FROM runs WHERE run = ? AND view IS NOT NULL");
        let row = find.bind(run.as_str()).fetch_optional(&mut *conn).await?;
        let ended = |row: SqliteRow| Ok(EndedRow { view: row.try_get(0)?, archive: row.try_get(1)? });
        row.map(ended).transpose()
    }

    async fn run_list(&self, asked: &RunListQuery) -> Result<RunPage> {
        let mut conn = self.connection().await?;
        let mut moment = conn.begin().await?;
        let page = run_list::page(&mut moment, asked, None).await?;
        moment.rollback().await?;
        Ok(page)
    }

    async fn run_list_of(&self, group: &Group, asked: &RunListQuery) -> Result<RunPage> {
        let mut conn = self.connection().await?;
        let mut moment = conn.begin().await?;
        let page = run_list::page(&mut moment, asked, Some(group)).await?;
        moment.rollback().await?;
        Ok(page)
    }

    async fn run_owners(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Group>> {
        Ok(owners::of_runs(&mut *self.connection().await?, runs).await?)
    }

    async fn model_owners(&self, model: Option<&ModelName>) -> Result<BTreeMap<ModelName, Group>> {
        Ok(owners::of_models(&mut *self.connection().await?, model).await?)
    }

    async fn sources(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, (RunId, StageName)>> {
        let mut conn = self.connection().await?;
        let find = "SELECT key, run, stage FROM executions WHERE key IN (SELECT value FROM json_each(?1)) \
                    UNION ALL SELECT key, run, stage FROM stage_results WHERE key IN (SELECT value FROM json_each(?1))";
        let rows = sqlx::query(find).bind(json(&keys)).fetch_all(&mut *conn).await?;
        let source = |row: &SqliteRow| -> Result<_> {
            let (run, stage): (String, String) = (row.try_get("run")?, row.try_get("stage")?);
            Ok((digest(row, "key")?, (RunId::new(run), StageName::new(stage))))
        };
        // A finished value replaces an archived execution of the same key.
        rows.iter().map(source).collect()
    }

    async fn archived_execution(&self, key: Digest) -> Result<Option<String>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query("SELECT execution FROM executions WHERE key = ?").bind(key.to_string());
        Ok(find.fetch_optional(&mut *conn).await?.map(|row| row.try_get(0)).transpose()?)
    }

    async fn stage_results(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, StageResultRow>> {
        let mut conn = self.connection().await?;
        let find = "SELECT * FROM stage_results WHERE key IN (SELECT value FROM json_each(?))";
        let rows = sqlx::query(find).bind(json(&keys)).fetch_all(&mut *conn).await?;
        rows.iter().map(|row| stage_result(row).map(|result| (result.key, result))).collect()
    }

    async fn runs(&self) -> Result<Vec<RunRow>> {
        let mut conn = self.connection().await?;
        let rows = sqlx::query(runs!("ORDER BY created_ms DESC, runs.rowid DESC")).fetch_all(&mut *conn).await?;
        rows.iter().map(run_row).collect()
    }

    async fn run(&self, run: &RunId) -> Result<Option<RunRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query(runs!("WHERE run = ?")).bind(run.as_str());
        find.fetch_optional(&mut *conn).await?.as_ref().map(run_row).transpose()
    }

    async fn run_by_key(&self, key: &str) -> Result<Option<RunRow>> {
        let mut conn = self.connection().await?;
        let find = sqlx::query(runs!("WHERE idempotency_key = ?")).bind(key);
        find.fetch_optional(&mut *conn).await?.as_ref().map(run_row).transpose()
    }

    async fn checkpoints(&self, task: &TaskId) -> Result<Vec<CheckpointRow>> {
        let mut conn = self.connection().await?;
        checkpoints(&mut conn, task).await
    }

    async fn shards(&self, run: &RunId) -> Result<BTreeMap<TaskId, Digest>> {
        let mut conn = self.connection().await?;
        let rows = sqlx::query("SELECT task, output FROM shards WHERE run = ?")
            .bind(run.as_str())
            .fetch_all(&mut *conn)
            .await?;
        rows.iter().map(|row| Ok((TaskId::new(row.try_get::<String, _>(0)?), digest(row, "output")?))).collect()
    }

    async fn logs(&self, run: &RunId, stage: Option<&StageName>, after: i64, limit: u32) -> Result<Vec<LogRow>> {
        logs::read(&mut *self.connection().await?, run, stage, after, limit).await
    }

    async fn last_logs(&self, run: &RunId, stage: Option<&StageName>, limit: u32) -> Result<Vec<LogRow>> {
        logs::last(&mut *self.connection().await?, run, stage, limit).await
    }

    async fn usage(&self, run: &RunId) -> Result<Usage> {
        usage::read(&mut *self.connection().await?, run).await
    }

    async fn kind_sizes(&self) -> Result<Vec<KindSize>> {
        usage::kind_sizes(&mut *self.connection().await?).await
    }

    async fn timeline(&self, asked: &HistoryQuery) -> Result<Vec<HistoryRow>> {
        history::read(&mut *self.connection().await?, asked, None).await
    }

    async fn timeline_of(&self, group: &Group, asked: &HistoryQuery) -> Result<Vec<HistoryRow>> {
        history::read(&mut *self.connection().await?, asked, Some(group)).await
    }

    async fn history_span(&self) -> Result<(Option<i64>, i64)> {
        history::span(&mut *self.connection().await?).await
    }

    async fn delivered(&self, hook: &str) -> Result<Option<i64>> {
        history::delivered(&mut *self.connection().await?, hook).await
    }

    async fn run_times(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Times>> {
        history::run_times(&mut *self.connection().await?, runs).await
    }

    async fn stage_times(&self, run: &RunId) -> Result<BTreeMap<StageName, Times>> {
        history::stage_times(&mut *self.connection().await?, run).await
    }

    async fn models(&self) -> Result<Vec<Model>> {
        let mut conn = self.connection().await?;
        Ok(models::models(&mut conn).await?)
    }

    async fn model(&self, model: &ModelName) -> Result<Option<Model>> {
        let mut conn = self.connection().await?;
        Ok(models::model(&mut conn, model).await?)
    }

    async fn versions(&self, model: &ModelName) -> Result<Vec<Version>> {
        let mut conn = self.connection().await?;
        Ok(models::versions(&mut conn, model).await?)
    }

    async fn history(&self, model: &ModelName, alias: Option<&Alias>) -> Result<Vec<Promotion>> {
        let mut conn = self.connection().await?;
        Ok(models::history(&mut conn, model, alias).await?)
    }

    async fn lineage(&self, digest: Digest) -> Result<Vec<LineageNode>> {
        let mut conn = self.connection().await?;
        lineage(&mut conn, digest).await
    }

    async fn ended_before(&self, before_ms: i64) -> Result<Vec<RunId>> {
        let mut conn = self.connection().await?;
        let find = "SELECT run FROM runs WHERE state IN ('finished', 'failed', 'cancelled') AND view IS NOT NULL \
                    AND updated_ms < ? ORDER BY updated_ms, run";
        let rows = sqlx::query(find).bind(before_ms).fetch_all(&mut *conn).await?;
        rows.iter().map(|row| Ok(RunId::new(row.try_get::<String, _>(0)?))).collect()
    }

    async fn points(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        page: Page,
    ) -> Result<BTreeMap<String, Curve>> {
        let mut conn = self.connection().await?;
        let mut moment = conn.begin().await?;
        let curves = curves::points(&mut moment, run, stage, keys, page).await?;
        moment.rollback().await?;
        Ok(curves)
    }

    async fn buckets(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        window: &Window,
    ) -> Result<BTreeMap<String, Buckets>> {
        let mut conn = self.connection().await?;
        let mut moment = conn.begin().await?;
        let curves = curves::buckets(&mut moment, run, stage, keys, window).await?;
        moment.rollback().await?;
        Ok(curves)
    }

    async fn present(&self, blobs: &[Digest]) -> Result<BTreeMap<Digest, u64>> {
        let mut conn = self.connection().await?;
        let find = "SELECT digest, bytes FROM blobs WHERE digest IN (SELECT value FROM json_each(?))";
        let rows = sqlx::query(find).bind(json(&blobs)).fetch_all(&mut *conn).await?;
        rows.iter().map(|row| Ok((digest(row, "digest")?, row.try_get::<i64, _>("bytes")?.unsigned_abs()))).collect()
    }

    async fn held(&self) -> Result<BTreeMap<TaskId, BTreeSet<Digest>>> {
        let mut conn = self.connection().await?;
        retention::held(&mut conn).await
    }

    async fn needs(&self) -> Result<Needs> {
        let mut conn = self.connection().await?;
        // A reading transaction sees one moment of the database.
        let mut moment = conn.begin().await?;
        let needs = retention::needs(&mut moment).await?;
        moment.rollback().await?;
        Ok(needs)
    }

    async fn problems(&self) -> Result<Vec<String>> {
        let mut conn = self.connection().await?;
        let mut problems = Vec::new();
        for row in sqlx::query("PRAGMA integrity_check").fetch_all(&mut *conn).await? {
            let line: String = row.try_get(0)?;
            if line != "ok" {
                problems.push(format!("database: {line}"));
            }
        }
        for row in sqlx::query("PRAGMA foreign_key_check").fetch_all(&mut *conn).await? {
            problems.push(format!("database: a row of `{}` has a dangling reference", row.try_get::<String, _>(0)?));
        }
        Ok(problems)
    }

    async fn copy_to(&self, path: &Path) -> Result<Needs> {
        let mut conn = self.connection().await?;
        sqlx::query("VACUUM INTO ?").bind(path.to_string_lossy().into_owned()).execute(&mut *conn).await?;
        drop(conn);
        let mut copy = open_copy(path).await?;
        let needs = retention::needs(&mut copy).await;
        let checked: String = sqlx::query("PRAGMA integrity_check").fetch_one(&mut copy).await?.try_get(0)?;
        copy.close().await?;
        match checked.as_str() {
            "ok" => needs,
            problem => Err(QueryError::Blob(format!("the database is damaged: {problem}"))),
        }
    }

    async fn close(&self) {
        self.0.close().await;
    }
}

pub(super) async fn lineage(conn: &mut SqliteConnection, root: Digest) -> Result<Vec<LineageNode>> {
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
