//! Queries on the committed data of a store.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Debug;
use std::path::Path;

use async_trait::async_trait;
use protocol::message::Times;
use protocol::{Alias, Digest, Group, ModelName, RunId, StageName, TaskId};

use super::rows::{
    CheckpointRow, EndedRow, HistoryQuery, HistoryRow, KindSize, LineageNode, LogRow, Needs, Recovery, References,
    RunListQuery, RunPage, RunRow, StageResultRow, Usage,
};
use crate::QueryError;
use crate::curve::{Buckets, Curve, Page, Window};
use crate::store_id::Stored;
use crate::versions::{self, Model, ModelRef, Promotion, Version};

type Result<T> = std::result::Result<T, QueryError>;

/// Queries on committed data.
#[async_trait]
pub trait Records: Debug + Send + Sync {
    /// Returns the catalog's identity and counters; `None` if it belongs to no store.
    async fn stored(&self) -> Result<Option<Stored>>;

    /// Returns the data from which a coordinator recovers.
    async fn recovery(&self) -> Result<Recovery>;

    /// Returns the stored data of an ended run; `None` if it has never ended.
    async fn ended(&self, run: &RunId) -> Result<Option<EndedRow>>;

    /// Returns a part of the list of runs, without reading the rest of it.
    async fn run_list(&self, asked: &RunListQuery) -> Result<RunPage>;

    /// The same for the runs of one group.
    async fn run_list_of(&self, group: &Group, asked: &RunListQuery) -> Result<RunPage>;

    /// Returns the groups that own the runs. Runs of the store's own user, or without an owner, are missing.
    async fn run_owners(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Group>>;

    /// Returns the groups that own all models, or one model. Models that were imported by hand are missing.
    async fn model_owners(&self, model: Option<&ModelName>) -> Result<BTreeMap<ModelName, Group>>;

    /// Returns the runs that ended before a time in milliseconds since 1970, oldest first.
    async fn ended_before(&self, before_ms: i64) -> Result<Vec<RunId>>;

    /// Returns the run and stage that computed, or began to compute, each key's value. Its logs and metrics are stored
    /// under them.
    async fn sources(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, (RunId, StageName)>>;

    /// Returns the JSON of an unfinished execution that a coordinator archived when no run needed it.
    async fn archived_execution(&self, key: Digest) -> Result<Option<String>>;

    /// Returns the stored values for `keys`.
    async fn stage_results(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, StageResultRow>>;

    /// Returns the value stored under a stage key.
    async fn stage_result(&self, key: Digest) -> Result<Option<StageResultRow>> {
        Ok(self.stage_results(&[key]).await?.remove(&key))
    }

    /// Returns all runs, newest first.
    async fn runs(&self) -> Result<Vec<RunRow>>;

    /// Returns one run.
    async fn run(&self, run: &RunId) -> Result<Option<RunRow>>;

    /// Returns the run that was submitted with an idempotency key.
    async fn run_by_key(&self, key: &str) -> Result<Option<RunRow>>;

    /// Returns a task's committed checkpoints, newest first.
    async fn checkpoints(&self, task: &TaskId) -> Result<Vec<CheckpointRow>>;

    /// Returns a task's newest committed checkpoint, from which the next attempt continues.
    async fn latest_checkpoint(&self, task: &TaskId) -> Result<Option<CheckpointRow>> {
        Ok(self.checkpoints(task).await?.into_iter().next())
    }

    /// Returns the stored shards of a run's map stages, by task.
    async fn shards(&self, run: &RunId) -> Result<BTreeMap<TaskId, Digest>>;

    /// Returns at most `limit` log lines of a run, or of one of its stages, stored after line `after`.
    async fn logs(&self, run: &RunId, stage: Option<&StageName>, after: i64, limit: u32) -> Result<Vec<LogRow>>;

    /// The newest `limit` log lines of a run, or of one stage of it, in their order.
    async fn last_logs(&self, run: &RunId, stage: Option<&StageName>, limit: u32) -> Result<Vec<LogRow>>;

    /// Returns the amounts that count against a run's limits.
    async fn usage(&self, run: &RunId) -> Result<Usage>;

    /// Returns the number of bytes of all artifacts and log lines of a group's runs.
    async fn group_bytes(&self, group: &Group) -> Result<u64>;

    /// Returns the sizes of all artifacts by kind, largest first.
    async fn kind_sizes(&self) -> Result<Vec<KindSize>>;

    /// The points of a stage's curves by key; of all keys, or of `keys`.
    async fn points(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        page: Page,
    ) -> Result<BTreeMap<String, Curve>>;

    /// The same curves in buckets.
    async fn buckets(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        window: &Window,
    ) -> Result<BTreeMap<String, Buckets>>;

    /// Returns the events, oldest first.
    async fn timeline(&self, asked: &HistoryQuery) -> Result<Vec<HistoryRow>>;

    /// The same; what happened to runs of other groups is left out.
    async fn timeline_of(&self, group: &Group, asked: &HistoryQuery) -> Result<Vec<HistoryRow>>;

    /// Returns the ids of the oldest row of the history and of the newest one ever added.
    async fn history_span(&self) -> Result<(Option<i64>, i64)>;

    /// Returns the last row of the history that a hook has received; `None` for an unknown hook.
    async fn delivered(&self, hook: &str) -> Result<Option<i64>>;

    /// Returns the times of runs. Their views do not have them.
    async fn run_times(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Times>>;

    /// Returns the times of the stages that a run began.
    async fn stage_times(&self, run: &RunId) -> Result<BTreeMap<StageName, Times>>;

    /// All models by name.
    async fn models(&self) -> Result<Vec<Model>>;

    /// Returns one model and its versions, oldest first.
    async fn model(&self, model: &ModelName) -> Result<Option<(Model, Vec<Version>)>>;

    /// Returns a model's versions, oldest first.
    async fn versions(&self, model: &ModelName) -> Result<Vec<Version>>;

    /// Returns true if there is such a model. Does not read its versions.
    async fn has_model(&self, model: &ModelName) -> Result<bool>;

    /// Returns the model's version with this artifact. Reads no other version.
    async fn version_of(&self, model: &ModelName, artifact: Digest) -> Result<Option<Version>>;

    /// Returns the moves of a model's aliases, or of one alias, oldest first.
    async fn history(&self, model: &ModelName, alias: Option<&Alias>) -> Result<Vec<Promotion>>;

    /// Returns the version named by a reference such as `quickstart@staging`, `quickstart@best` or `quickstart:3`.
    async fn resolve(&self, reference: &str) -> Result<Version> {
        let reference: ModelRef = reference.parse().map_err(QueryError::Invalid)?;
        match self.model(&reference.model).await? {
            None => Err(versions::unknown(&reference.model, &self.models().await?)),
            Some((model, versions)) => versions::pick(&reference, &model, &versions),
        }
    }

    /// Returns an artifact and everything it was made from, nearest first.
    async fn lineage(&self, digest: Digest) -> Result<Vec<LineageNode>>;

    /// Returns those of `blobs` that are known to be stored, with their lengths.
    async fn present(&self, blobs: &[Digest]) -> Result<BTreeMap<Digest, u64>>;

    /// Returns the references of those of `artifacts` that rows have named. Long lists are not recorded and left out.
    async fn references(&self, artifacts: &[Digest]) -> Result<Vec<(Digest, References)>>;

    /// Returns the blobs that held tasks have stored and that are to be kept although no row may name them yet.
    async fn held(&self) -> Result<BTreeMap<TaskId, BTreeSet<Digest>>>;

    /// Returns the blobs that rows need.
    async fn needs(&self) -> Result<Needs>;

    /// Describes a row that names an artifact, such as "version walker:3". Reads all rows.
    async fn named_by(&self, artifact: Digest) -> Result<String>;

    /// Describes the inconsistencies that the database finds in itself. Reads all of it.
    async fn problems(&self) -> Result<Vec<String>>;

    /// Copies the database, as of one moment, to a new file and returns the blobs that the copy needs. Does not block
    /// writes.
    async fn copy_to(&self, path: &Path) -> Result<Needs>;

    /// Closes the connections.
    async fn close(&self);
}
