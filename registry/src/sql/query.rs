//! Queries in SQL over read-only connections.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use async_trait::async_trait;
use futures::TryStreamExt as _;
use protocol::message::Times;
use protocol::{Alias, Digest, Group, ModelName, RunId, StageName, TaskId};

use super::pool::Pool;
use super::rows::{checkpoints, digest, references, run_row, stage_result};
use super::statement::{Conn, Row, json, query};
use super::{curves, history, logs, models, open, owners, postgres, retention, run_list, sqlite, transfer, usage};
use crate::QueryError;
use crate::catalog::{
    CheckpointRow, EndedRow, HistoryQuery, HistoryRow, KindSize, LineageNode, LogRow, Needs, Records, Recovery,
    References, RunListQuery, RunPage, RunRow, StageResultRow, Usage,
};
use crate::curve::{Buckets, Curve, Page, Window};
use crate::store_id::Stored;
use crate::versions::{Model, Promotion, Version};

type Result<T> = std::result::Result<T, QueryError>;

/// A query for rows of runs with their submissions.
macro_rules! runs {
    ($which:literal) => {
        concat!(
            "SELECT runs.*, submissions.digest AS submission FROM runs LEFT JOIN submissions USING (run) ",
            "LEFT JOIN run_list USING (run) ",
            $which
        )
    };
}

/// A pool of read-only connections.
#[derive(Debug)]
pub(crate) struct SqlRecords(Pool);

impl SqlRecords {
    /// Wraps connections for queries.
    pub(crate) fn new(readers: Pool) -> Self {
        Self(readers)
    }
}

#[async_trait]
impl Records for SqlRecords {
    async fn stored(&self) -> Result<Option<Stored>> {
        Ok(open::stored(&mut self.0.reader().await?.conn()).await?)
    }

    async fn recovery(&self) -> Result<Recovery> {
        // One transaction sees one moment; two could see a snapshot without the facts after it.
        let mut moment = self.0.moment().await?;
        let mut recovery = Recovery::default();
        let newest = "SELECT seq, state FROM snapshots ORDER BY seq DESC LIMIT 1";
        if let Some(row) = query(newest).fetch_optional(&mut moment.conn()).await? {
            let seq: i64 = row.try_get(0)?;
            recovery.snapshot = Some((seq.unsigned_abs(), row.try_get(1)?));
            let parts = "SELECT part, state FROM snapshot_parts AS newest WHERE seq = \
                         (SELECT max(seq) FROM snapshot_parts WHERE part = newest.part AND seq <= ?)";
            let mut conn = moment.conn();
            let mut rows = query(parts).bind(seq).fetch(&mut conn);
            while let Some(row) = rows.try_next().await? {
                if let Some(state) = row.try_get(1)? {
                    recovery.parts.insert(row.try_get(0)?, state);
                }
            }
        }
        let facts = "SELECT seq, facts FROM facts ORDER BY seq";
        for row in query(facts).fetch_all(&mut moment.conn()).await? {
            recovery.facts.push((row.try_get::<i64, _>(0)?.unsigned_abs(), row.try_get(1)?));
        }
        moment.end().await?;
        Ok(recovery)
    }

    async fn ended(&self, run: &RunId) -> Result<Option<EndedRow>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = query("SELECT view, archive FROM runs WHERE run = ? AND view IS NOT NULL");
        let row = find.bind(run.as_str()).fetch_optional(&mut conn).await?;
        let ended = |row: Row| Ok(EndedRow { view: row.try_get(0)?, archive: row.try_get(1)? });
        row.map(ended).transpose()
    }

    async fn run_list(&self, asked: &RunListQuery) -> Result<RunPage> {
        let mut moment = self.0.moment().await?;
        let page = run_list::page(&mut moment.conn(), asked, None).await?;
        moment.end().await?;
        Ok(page)
    }

    async fn run_list_of(&self, group: &Group, asked: &RunListQuery) -> Result<RunPage> {
        let mut moment = self.0.moment().await?;
        let page = run_list::page(&mut moment.conn(), asked, Some(group)).await?;
        moment.end().await?;
        Ok(page)
    }

    async fn run_owners(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Group>> {
        Ok(owners::of_runs(&mut self.0.reader().await?.conn(), runs).await?)
    }

    async fn model_owners(&self, model: Option<&ModelName>) -> Result<BTreeMap<ModelName, Group>> {
        Ok(owners::of_models(&mut self.0.reader().await?.conn(), model).await?)
    }

    async fn sources(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, (RunId, StageName)>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = "SELECT key, run, stage FROM executions WHERE key IN {texts ?1} \
                    UNION ALL SELECT key, run, stage FROM stage_results WHERE key IN {texts ?1}";
        let rows = query(find).bind(json(&keys)).fetch_all(&mut conn).await?;
        let mut sources = BTreeMap::new();
        for row in &rows {
            let run = RunId::new(row.try_get::<String, _>("run")?);
            let stage = StageName::new(row.try_get::<String, _>("stage")?);
            // A finished value replaces an archived execution of the same key.
            sources.insert(digest(row, "key")?, (run, stage));
        }
        Ok(sources)
    }

    async fn archived_execution(&self, key: Digest) -> Result<Option<String>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = query("SELECT execution FROM executions WHERE key = ?").bind(key.to_string());
        Ok(find.fetch_optional(&mut conn).await?.map(|row| row.try_get(0)).transpose()?)
    }

    async fn stage_results(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, StageResultRow>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = "SELECT * FROM stage_results WHERE key IN {texts ?}";
        let rows = query(find).bind(json(&keys)).fetch_all(&mut conn).await?;
        rows.iter().map(|row| stage_result(row).map(|result| (result.key, result))).collect()
    }

    async fn runs(&self) -> Result<Vec<RunRow>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let rows = query(runs!("ORDER BY runs.created_ms DESC, run_list.number DESC")).fetch_all(&mut conn).await?;
        rows.iter().map(run_row).collect()
    }

    async fn run(&self, run: &RunId) -> Result<Option<RunRow>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = query(runs!("WHERE runs.run = ?")).bind(run.as_str());
        find.fetch_optional(&mut conn).await?.as_ref().map(run_row).transpose()
    }

    async fn run_by_key(&self, key: &str) -> Result<Option<RunRow>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = query(runs!("WHERE idempotency_key = ?")).bind(key);
        find.fetch_optional(&mut conn).await?.as_ref().map(run_row).transpose()
    }

    async fn checkpoints(&self, task: &TaskId) -> Result<Vec<CheckpointRow>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        checkpoints(&mut conn, task).await
    }

    async fn shards(&self, run: &RunId) -> Result<BTreeMap<TaskId, Digest>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let rows =
            query("SELECT task, output FROM shards WHERE run = ?").bind(run.as_str()).fetch_all(&mut conn).await?;
        rows.iter().map(|row| Ok((TaskId::new(row.try_get::<String, _>(0)?), digest(row, "output")?))).collect()
    }

    async fn logs(&self, run: &RunId, stage: Option<&StageName>, after: i64, limit: u32) -> Result<Vec<LogRow>> {
        logs::read(&mut self.0.reader().await?.conn(), run, stage, after, limit).await
    }

    async fn last_logs(&self, run: &RunId, stage: Option<&StageName>, limit: u32) -> Result<Vec<LogRow>> {
        logs::last(&mut self.0.reader().await?.conn(), run, stage, limit).await
    }

    async fn usage(&self, run: &RunId) -> Result<Usage> {
        usage::read(&mut self.0.reader().await?.conn(), run).await
    }

    async fn group_bytes(&self, group: &Group) -> Result<u64> {
        usage::group_bytes(&mut self.0.reader().await?.conn(), group).await
    }

    async fn kind_sizes(&self) -> Result<Vec<KindSize>> {
        usage::kind_sizes(&mut self.0.reader().await?.conn()).await
    }

    async fn timeline(&self, asked: &HistoryQuery) -> Result<Vec<HistoryRow>> {
        history::read(&mut self.0.reader().await?.conn(), asked, None).await
    }

    async fn timeline_of(&self, group: &Group, asked: &HistoryQuery) -> Result<Vec<HistoryRow>> {
        history::read(&mut self.0.reader().await?.conn(), asked, Some(group)).await
    }

    async fn history_span(&self) -> Result<(Option<i64>, i64)> {
        history::span(&mut self.0.reader().await?.conn()).await
    }

    async fn delivered(&self, hook: &str) -> Result<Option<i64>> {
        history::delivered(&mut self.0.reader().await?.conn(), hook).await
    }

    async fn run_times(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Times>> {
        history::run_times(&mut self.0.reader().await?.conn(), runs).await
    }

    async fn stage_times(&self, run: &RunId) -> Result<BTreeMap<StageName, Times>> {
        history::stage_times(&mut self.0.reader().await?.conn(), run).await
    }

    async fn models(&self) -> Result<Vec<Model>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        Ok(models::models(&mut conn).await?)
    }

    async fn model(&self, model: &ModelName) -> Result<Option<(Model, Vec<Version>)>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        Ok(models::model(&mut conn, model).await?)
    }

    async fn versions(&self, model: &ModelName) -> Result<Vec<Version>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        Ok(models::versions(&mut conn, model).await?)
    }

    async fn has_model(&self, model: &ModelName) -> Result<bool> {
        Ok(models::exists(&mut self.0.reader().await?.conn(), model).await?)
    }

    async fn version_of(&self, model: &ModelName, artifact: Digest) -> Result<Option<Version>> {
        Ok(models::version_of(&mut self.0.reader().await?.conn(), model, artifact).await?)
    }

    async fn history(&self, model: &ModelName, alias: Option<&Alias>) -> Result<Vec<Promotion>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        Ok(models::history(&mut conn, model, alias).await?)
    }

    async fn lineage(&self, digest: Digest) -> Result<Vec<LineageNode>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        lineage(&mut conn, digest).await
    }

    async fn ended_before(&self, before_ms: i64) -> Result<Vec<RunId>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = "SELECT run FROM runs WHERE state IN ('finished', 'failed', 'cancelled') AND view IS NOT NULL \
                    AND updated_ms < ? ORDER BY updated_ms, run";
        let rows = query(find).bind(before_ms).fetch_all(&mut conn).await?;
        rows.iter().map(|row| Ok(RunId::new(row.try_get::<String, _>(0)?))).collect()
    }

    async fn points(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        page: Page,
    ) -> Result<BTreeMap<String, Curve>> {
        let mut moment = self.0.moment().await?;
        let curves = curves::points(&mut moment.conn(), run, stage, keys, page).await?;
        moment.end().await?;
        Ok(curves)
    }

    async fn buckets(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        window: &Window,
    ) -> Result<BTreeMap<String, Buckets>> {
        let mut moment = self.0.moment().await?;
        let curves = curves::buckets(&mut moment.conn(), run, stage, keys, window).await?;
        moment.end().await?;
        Ok(curves)
    }

    async fn present(&self, blobs: &[Digest]) -> Result<BTreeMap<Digest, u64>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = "SELECT digest, bytes FROM blobs WHERE digest IN {texts ?}";
        let rows = query(find).bind(json(&blobs)).fetch_all(&mut conn).await?;
        rows.iter().map(|row| Ok((digest(row, "digest")?, row.try_get::<i64, _>("bytes")?.unsigned_abs()))).collect()
    }

    async fn references(&self, artifacts: &[Digest]) -> Result<Vec<(Digest, References)>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        let find = "SELECT digest, refers FROM manifests WHERE digest IN {texts ?}";
        let rows = query(find).bind(json(&artifacts)).fetch_all(&mut conn).await?;
        rows.iter().map(|row| Ok((digest(row, "digest")?, references(row.try_get("refers")?)?))).collect()
    }

    async fn held(&self) -> Result<BTreeMap<TaskId, BTreeSet<Digest>>> {
        let mut reader = self.0.reader().await?;
        let mut conn = reader.conn();
        retention::held(&mut conn).await
    }

    async fn needs(&self) -> Result<Needs> {
        // A reading transaction sees one moment of the database.
        let mut moment = self.0.moment().await?;
        let needs = retention::needs(&mut moment.conn()).await?;
        moment.end().await?;
        Ok(needs)
    }

    async fn named_by(&self, artifact: Digest) -> Result<String> {
        retention::named_by(&mut self.0.reader().await?.conn(), artifact).await
    }

    async fn problems(&self) -> Result<Vec<String>> {
        let mut reader = self.0.reader().await?;
        match &mut reader.conn() {
            Conn::Sqlite(conn) => sqlite::problems(conn).await,
            Conn::Postgres(conn) => postgres::problems(conn).await,
        }
    }

    async fn copy_to(&self, path: &Path) -> Result<Needs> {
        match &self.0 {
            Pool::Sqlite(pool) => sqlite::copy(&mut *pool.acquire().await?, path).await?,
            Pool::Postgres(_) => {
                transfer::to_file(&self.0, path).await?;
            }
        }
        let mut copy = sqlite::open_copy(path).await?;
        let needs = retention::needs(&mut Conn::Sqlite(&mut copy)).await;
        sqlite::check_copy(copy).await?;
        needs
    }

    async fn close(&self) {
        self.0.close().await;
    }
}

pub(super) async fn lineage(conn: &mut Conn<'_>, root: Digest) -> Result<Vec<LineageNode>> {
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
            let row = query("SELECT * FROM artifacts WHERE digest = ?").bind(&name).fetch_optional(conn).await?;
            let edges = query("SELECT parent, role FROM edges WHERE child = ? ORDER BY role").bind(&name);
            let mut inputs = BTreeMap::new();
            for edge in edges.fetch_all(conn).await? {
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
