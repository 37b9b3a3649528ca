//! What the catalog of a store is: all that is kept besides the blobs, behind two traits.
//!
//! [`Records`] answers questions from what is committed; [`Catalog`] commits. SQLite implements them (`sqlite`), and whatever
//! else does passes the same suite, `registry/tests/catalog_conformance.rs`. What an implementation owes:
//!
//! - **One order is all or nothing.** [`Catalog::commit`] returns once the order would survive a loss of power, or has changed
//!   nothing. Orders that are committed together do not see each other's failures.
//! - **Fences are checked where the write is stored**, in the same transaction (those of a [`Write`] that carries a grant).
//! - **One epoch writes.** Opening for writing raises the epoch; a commit under an older one is refused with
//!   [`WriteError::Superseded`], whichever process or machine it comes from. So exclusivity needs no lock that both can see.
//! - **Committed transactions are counted** ([`Stored::commits`]), so that a catalog that has gone back is told from the newest.
//! - **A row names only what is proven whole**: an artifact without a [`Proof`](crate::Proof) is refused with [`WriteError::Unproven`]. A
//!   commit asks no place for blobs; the blobs of what is named are noted for a collection under way, and as [present](Records::present).
//! - **An answer is of one moment**, and of every commit that was acknowledged before the question.
//!
//! Rules that no database has a say in are functions beside the types ([`crate::versions`], and `curve`): which version is
//! the best, whether a gate holds, where a rollback goes, which attempt's values count.

mod rows;

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;

use async_trait::async_trait;
use protocol::stage::Keep;
use protocol::{Alias, Digest, Group, ModelName, RunId, StageName, TaskId};

pub use rows::{CheckpointRow, EndedRow, LineageNode, LogRow, Needs, Recovery, Root, RunRow, StageResultRow, Usage};

use crate::curve::Curve;
use crate::forget::Forgotten;
use crate::store_id::Stored;
use crate::versions::{self, Expect, Model, ModelRef, Pick, Promotion, Version};
use crate::{QueryError, Write, WriteError};

type Result<T> = std::result::Result<T, QueryError>;

/// What can be asked, from what is committed.
#[async_trait]
pub trait Records: Debug + Send + Sync {
    /// What the catalog says of itself; `None` if it is not one of a store.
    async fn stored(&self) -> Result<Option<Stored>>;

    /// What a coordinator recovers from.
    async fn recovery(&self) -> Result<Recovery>;

    /// What is kept of a run that ended; `None` while it has never ended.
    async fn ended(&self, run: &RunId) -> Result<Option<EndedRow>>;

    /// Returns the views of ended runs as JSON, oldest first: the newest `limit`, or the newest `limit` submitted before a run.
    async fn ended_views(&self, before: Option<&RunId>, limit: u32) -> Result<Vec<(RunId, String)>>;

    /// The same, of the runs of one group.
    async fn ended_views_of(&self, group: &Group, before: Option<&RunId>, limit: u32) -> Result<Vec<(RunId, String)>>;

    /// The groups that runs belong to; a run of the store's own user, or of none, is missing.
    async fn run_owners(&self, runs: &[RunId]) -> Result<BTreeMap<RunId, Group>>;

    /// The groups that models belong to, or that of one model; a model that was imported by hand is missing.
    async fn model_owners(&self, model: Option<&ModelName>) -> Result<BTreeMap<ModelName, Group>>;

    /// Runs that ended before a time, in milliseconds since 1970; oldest first.
    async fn ended_before(&self, before_ms: i64) -> Result<Vec<RunId>>;

    /// The run and the stage under whose names a stage key's logs and metrics are stored: those that made its value, or began to.
    async fn sources(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, (RunId, StageName)>>;

    /// What a coordinator left of a stage's value when nobody waited for it any more, as JSON.
    async fn archived_execution(&self, key: Digest) -> Result<Option<String>>;

    /// The values whose keys are among `keys`.
    async fn stage_results(&self, keys: &[Digest]) -> Result<BTreeMap<Digest, StageResultRow>>;

    /// The value stored under a stage key.
    async fn stage_result(&self, key: Digest) -> Result<Option<StageResultRow>> {
        Ok(self.stage_results(&[key]).await?.remove(&key))
    }

    /// All runs, newest first.
    async fn runs(&self) -> Result<Vec<RunRow>>;

    /// One run.
    async fn run(&self, run: &RunId) -> Result<Option<RunRow>>;

    /// The run that was submitted with an idempotency key.
    async fn run_by_key(&self, key: &str) -> Result<Option<RunRow>>;

    /// A task's committed checkpoints, newest first.
    async fn checkpoints(&self, task: &TaskId) -> Result<Vec<CheckpointRow>>;

    /// A task's newest committed checkpoint: where the next attempt goes on.
    async fn latest_checkpoint(&self, task: &TaskId) -> Result<Option<CheckpointRow>> {
        Ok(self.checkpoints(task).await?.into_iter().next())
    }

    /// The shards of a run's map stages that are stored, by task.
    async fn shards(&self, run: &RunId) -> Result<BTreeMap<TaskId, Digest>>;

    /// Log lines of a run, or of one stage of it, that were stored after line `after`; at most `limit`.
    async fn logs(&self, run: &RunId, stage: Option<&StageName>, after: i64, limit: u32) -> Result<Vec<LogRow>>;

    /// Returns how much a run has stored of everything that has a limit.
    async fn usage(&self, run: &RunId) -> Result<Usage>;

    /// The current values of a stage by key; of all keys, or of `keys`; at most about `points` of each, 0 for all.
    async fn metrics(
        &self,
        run: &RunId,
        stage: &StageName,
        keys: Option<&[String]>,
        points: usize,
    ) -> Result<BTreeMap<String, Curve>>;

    /// All models by name.
    async fn models(&self) -> Result<Vec<Model>>;

    /// One model.
    async fn model(&self, model: &ModelName) -> Result<Option<Model>>;

    /// A model's versions, oldest first.
    async fn versions(&self, model: &ModelName) -> Result<Vec<Version>>;

    /// The version that an artifact was registered as.
    async fn version_of(&self, model: &ModelName, artifact: Digest) -> Result<Option<Version>> {
        Ok(self.versions(model).await?.into_iter().find(|version| version.artifact == artifact))
    }

    /// The moves of a model's aliases, or of one of them, oldest first.
    async fn history(&self, model: &ModelName, alias: Option<&Alias>) -> Result<Vec<Promotion>>;

    /// The version behind `quickstart@staging`, `quickstart@best` or `quickstart:3`.
    async fn resolve(&self, reference: &str) -> Result<Version> {
        let reference: ModelRef = reference.parse().map_err(QueryError::Invalid)?;
        match self.model(&reference.model).await? {
            None => Err(versions::unknown(&reference.model, &self.models().await?)),
            Some(model) => versions::pick(&reference, &model, &self.versions(&reference.model).await?),
        }
    }

    /// An artifact and all that it was made of, nearest first.
    async fn lineage(&self, digest: Digest) -> Result<Vec<LineageNode>>;

    /// Those of `blobs` that are known to be in their place, with their lengths.
    async fn present(&self, blobs: &[Digest]) -> Result<BTreeMap<Digest, u64>>;

    /// What the rows need of the blobs.
    async fn needs(&self) -> Result<Needs>;

    /// What the database finds wrong with itself, in words. Takes as long as reading all of it.
    async fn problems(&self) -> Result<Vec<String>>;

    /// Writes a copy of all of it, as of one moment, to a new file; returns what that copy needs of the blobs. Writes go on
    /// meanwhile.
    async fn copy_to(&self, path: &Path) -> Result<Needs>;

    /// Ends its connections.
    async fn close(&self);
}

/// What commits.
#[async_trait]
pub trait Catalog: Debug + Send + Sync {
    /// What can be asked of it.
    fn records(&self) -> Arc<dyn Records>;

    /// Commits an order; returns once it would survive a loss of power, or has changed nothing.
    async fn commit(&self, order: Order) -> std::result::Result<Done, WriteError>;
}

/// One thing to commit.
#[derive(Debug, Clone)]
pub enum Order {
    /// All of them or none.
    Write(Vec<Write>),
    /// Moves an alias forward: compares, judges the gates, moves, logs.
    Promote(PromoteOrder),
    /// Moves an alias back. This is a log entry itself.
    Rollback(RollbackOrder),
    /// Forgets a task's checkpoints but those that the policy names.
    PruneCheckpoints {
        /// Whose.
        task: TaskId,
        /// Which stay.
        keep: Keep,
    },
    /// Keeps an artifact whatever else points at it.
    Pin {
        /// The artifact.
        digest: Digest,
        /// Why; `None` ends the pin.
        reason: Option<String>,
    },
    /// Forgets a run that has ended.
    Forget(RunId),
    /// Forgets what a run that ended before a time has left behind and nobody needs.
    ForgetLeftovers {
        /// The run, which stays itself.
        run: RunId,
        /// In milliseconds since 1970.
        before_ms: i64,
    },
    /// Forgets the rows that a collection takes. From here on what rows come to name is noted.
    BeginCollection,
    /// Takes away what is known of blobs, but for those that rows have come to name since the collection began: nobody may rely on
    /// the others any more.
    Condemn(Vec<Digest>),
}

/// A promotion to be made.
#[derive(Debug, Clone)]
pub struct PromoteOrder {
    pub model: ModelName,
    /// The alias that moves.
    pub alias: Alias,
    /// Where to.
    pub to: Which,
    /// Where the alias must be now, if the caller minds.
    pub expect: Option<Expect>,
    /// Gates as written.
    pub require: Vec<String>,
    /// Why.
    pub reason: String,
    /// Who.
    pub actor: String,
}

/// A rollback to be made.
#[derive(Debug, Clone)]
pub struct RollbackOrder {
    pub model: ModelName,
    /// The alias that moves.
    pub alias: Alias,
    /// Where to; `None` is the version before its last promotion.
    pub to: Option<u64>,
    /// Where the alias must be now, if the caller minds.
    pub expect: Option<Expect>,
    /// Why.
    pub reason: String,
    /// Who.
    pub actor: String,
}

/// Which version is to be promoted.
#[derive(Debug, Clone)]
pub enum Which {
    /// The one that an artifact was registered as.
    Artifact(Digest),
    /// By its name.
    Pick(Pick),
}

/// What an order gives.
#[derive(Debug)]
pub enum Done {
    /// It is stored.
    Nothing,
    /// Of a promotion or a rollback: the log entry.
    Promoted(Box<Promotion>),
    /// Of pruning: the manifests that were forgotten.
    Pruned(Vec<Digest>),
    /// Of a collection's beginning: the tasks whose shards were forgotten.
    Begun(Vec<TaskId>),
    /// Of condemning: the blobs that no row has come to name.
    Condemned(Vec<Digest>),
    /// Of forgetting: what went.
    Forgotten(Forgotten),
}
