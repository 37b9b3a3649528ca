//! A catalog as one group of tokens sees it: only its own models and runs.
//!
//! Values by key, checkpoints and blobs stay shared. A caller needs a stage's key or a blob's digest to read them, and
//! both follow from the content alone (docs/threat-model.md).

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use async_trait::async_trait;
use protocol::message::Times;
use protocol::{Alias, Digest, Group, ModelName, RunId, StageName, TaskId};

use crate::QueryError;
use crate::catalog::{
    CheckpointRow, EndedRow, HistoryQuery, HistoryRow, KindSize, LineageNode, LogRow, Needs, Records, Recovery,
    References, RunListQuery, RunPage, RunRow, StageResultRow, Usage,
};
use crate::curve::{Buckets, Curve, Page, Window};
use crate::store_id::Stored;
use crate::versions::{Model, Promotion, Version};

type Result<T> = std::result::Result<T, QueryError>;

/// The records that `group` may see.
#[derive(Debug)]
pub(crate) struct ScopedRecords {
    all: Arc<dyn Records>,
    group: Group,
}

impl ScopedRecords {
    pub(crate) fn new(all: Arc<dyn Records>, group: Group) -> Self {
        Self { all, group }
    }

    async fn sees_model(&self, model: &ModelName) -> Result<bool> {
        Ok(self.all.model_owners(Some(model)).await?.get(model) == Some(&self.group))
    }

    async fn sees_run(&self, run: &RunId) -> Result<bool> {
        Ok(self.all.run_owners(std::slice::from_ref(run)).await?.get(run) == Some(&self.group))
    }
}

#[async_trait]
impl Records for ScopedRecords {
    async fn stored(&self) -> Result<Option<Stored>> {
        self.all.stored().await
    }

    async fn recovery(&self) -> Result<Recovery> {
        self.all.recovery().await
    }

    async fn present(&self, blobs: &[Digest]) -> Result<BTreeMap<Digest, u64>> {
        self.all.present(blobs).await
    }

    async fn references(&self, artifacts: &[Digest]) -> Result<Vec<(Digest, References)>> {
        self.all.references(artifacts).await
    }

    async fn run_owners(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Group>> {
        let mut owners = self.all.run_owners(runs).await?;
        owners.retain(|_, owner| *owner == self.group);
        Ok(owners)
    }

    async fn model_owners(&self, model: Option<&ModelName>) -> Result<BTreeMap<ModelName, Group>> {
        let mut owners = self.all.model_owners(model).await?;
        owners.retain(|_, owner| *owner == self.group);
        Ok(owners)
    }

    async fn ended(&self, run: &RunId) -> Result<Option<EndedRow>> {
        if self.sees_run(run).await? { self.all.ended(run).await } else { Ok(None) }
    }

    async fn run_list(&self, asked: &RunListQuery) -> Result<RunPage> {
        self.all.run_list_of(&self.group, asked).await
    }

    async fn run_list_of(&self, group: &Group, asked: &RunListQuery) -> Result<RunPage> {
        if *group == self.group { self.all.run_list_of(group, asked).await } else { Ok(RunPage::default()) }
    }

    async fn ended_before(&self, before_ms: i64) -> Result<Vec<RunId>> {
        let runs = self.all.ended_before(before_ms).await?;
        let owners = self.run_owners(&runs).await?;
        Ok(runs.into_iter().filter(|run| owners.contains_key(run)).collect())
    }

    async fn sources(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, (RunId, StageName)>> {
        self.all.sources(keys).await
    }

    async fn archived_execution(&self, key: Digest) -> Result<Option<String>> {
        self.all.archived_execution(key).await
    }

    async fn stage_results(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, StageResultRow>> {
        self.all.stage_results(keys).await
    }

    async fn runs(&self) -> Result<Vec<RunRow>> {
        let rows = self.all.runs().await?;
        let names: Vec<RunId> = rows.iter().map(|row| row.run.clone()).collect();
        let owners = self.run_owners(&names).await?;
        Ok(rows.into_iter().filter(|row| owners.contains_key(&row.run)).collect())
    }

    async fn run(&self, run: &RunId) -> Result<Option<RunRow>> {
        if self.sees_run(run).await? { self.all.run(run).await } else { Ok(None) }
    }

    async fn run_by_key(&self, key: &str) -> Result<Option<RunRow>> {
        match self.all.run_by_key(key).await? {
            Some(row) if self.sees_run(&row.run).await? => Ok(Some(row)),
            Some(_) | None => Ok(None),
        }
    }

    async fn checkpoints(&self, task: &TaskId) -> Result<Vec<CheckpointRow>> {
        self.all.checkpoints(task).await
    }

    async fn shards(&self, run: &RunId) -> Result<BTreeMap<TaskId, Digest>> {
        if self.sees_run(run).await? { self.all.shards(run).await } else { Ok(BTreeMap::new()) }
    }

    async fn logs(&self, run: &RunId, stage: Option<&StageName>, after: i64, limit: u32) -> Result<Vec<LogRow>> {
        if self.sees_run(run).await? { self.all.logs(run, stage, after, limit).await } else { Ok(Vec::new()) }
    }

    async fn last_logs(&self, run: &RunId, stage: Option<&StageName>, limit: u32) -> Result<Vec<LogRow>> {
        if self.sees_run(run).await? { self.all.last_logs(run, stage, limit).await } else { Ok(Vec::new()) }
    }

    async fn usage(&self, run: &RunId) -> Result<Usage> {
        if self.sees_run(run).await? { self.all.usage(run).await } else { Ok(Usage::default()) }
    }

    async fn group_bytes(&self, group: &Group) -> Result<u64> {
        if *group == self.group { self.all.group_bytes(group).await } else { Ok(0) }
    }

    async fn kind_sizes(&self) -> Result<Vec<KindSize>> {
        // Sizes of the whole store are not for one group.
        Ok(Vec::new())
    }

    async fn points(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        page: Page,
    ) -> Result<BTreeMap<String, Curve>> {
        // The values of a stage follow from its key, as the stage's output does.
        self.all.points(run, stage, keys, page).await
    }

    async fn buckets(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        window: &Window,
    ) -> Result<BTreeMap<String, Buckets>> {
        self.all.buckets(run, stage, keys, window).await
    }

    async fn timeline(&self, asked: &HistoryQuery) -> Result<Vec<HistoryRow>> {
        self.all.timeline_of(&self.group, asked).await
    }

    async fn timeline_of(&self, group: &Group, asked: &HistoryQuery) -> Result<Vec<HistoryRow>> {
        if *group == self.group { self.all.timeline_of(group, asked).await } else { Ok(Vec::new()) }
    }

    async fn history_span(&self) -> Result<(Option<i64>, i64)> {
        self.all.history_span().await
    }

    async fn delivered(&self, hook: &str) -> Result<Option<i64>> {
        self.all.delivered(hook).await
    }

    async fn run_times(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Times>> {
        let owners = self.run_owners(runs).await?;
        let mut times = self.all.run_times(runs).await?;
        times.retain(|run, _| owners.contains_key(run));
        Ok(times)
    }

    async fn stage_times(&self, run: &RunId) -> Result<BTreeMap<StageName, Times>> {
        // As its values, they follow from the stage's key.
        self.all.stage_times(run).await
    }

    async fn models(&self) -> Result<Vec<Model>> {
        let owners = self.model_owners(None).await?;
        let mut models = self.all.models().await?;
        models.retain(|model| owners.contains_key(&model.model));
        Ok(models)
    }

    async fn model(&self, model: &ModelName) -> Result<Option<(Model, Vec<Version>)>> {
        if self.sees_model(model).await? { self.all.model(model).await } else { Ok(None) }
    }

    async fn versions(&self, model: &ModelName) -> Result<Vec<Version>> {
        if self.sees_model(model).await? { self.all.versions(model).await } else { Ok(Vec::new()) }
    }

    async fn has_model(&self, model: &ModelName) -> Result<bool> {
        Ok(self.sees_model(model).await? && self.all.has_model(model).await?)
    }

    async fn version_of(&self, model: &ModelName, artifact: Digest) -> Result<Option<Version>> {
        if self.sees_model(model).await? { self.all.version_of(model, artifact).await } else { Ok(None) }
    }

    async fn history(&self, model: &ModelName, alias: Option<&Alias>) -> Result<Vec<Promotion>> {
        if self.sees_model(model).await? { self.all.history(model, alias).await } else { Ok(Vec::new()) }
    }

    async fn lineage(&self, digest: Digest) -> Result<Vec<LineageNode>> {
        let mut nodes = self.all.lineage(digest).await?;
        let runs: Vec<RunId> = nodes.iter().filter_map(|node| node.run.as_deref().map(RunId::from)).collect();
        let owners = self.run_owners(&runs).await?;
        for node in &mut nodes {
            if node.run.as_deref().is_some_and(|run| !owners.contains_key(&RunId::from(run))) {
                node.run = None;
                node.stage = None;
            }
        }
        Ok(nodes)
    }

    async fn held(&self) -> Result<BTreeMap<TaskId, BTreeSet<Digest>>> {
        self.all.held().await
    }

    async fn named_by(&self, artifact: Digest) -> Result<String> {
        self.all.named_by(artifact).await
    }

    async fn needs(&self) -> Result<Needs> {
        self.all.needs().await
    }

    async fn problems(&self) -> Result<Vec<String>> {
        self.all.problems().await
    }

    async fn copy_to(&self, path: &Path) -> Result<Needs> {
        self.all.copy_to(path).await
    }

    async fn close(&self) {
        self.all.close().await;
    }
}
