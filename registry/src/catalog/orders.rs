//! Orders that a catalog commits, and their results.

use std::fmt::Debug;
use std::sync::Arc;

use async_trait::async_trait;
use protocol::stage::Keep;
use protocol::{Alias, Digest, ModelName, RunId, TaskId};

use super::records::Records;
use crate::forget::Forgotten;
use crate::versions::{Expect, Pick, Promotion};
use crate::{Write, WriteError};

/// Commits of orders.
#[async_trait]
pub trait Catalog: Debug + Send + Sync {
    /// Returns the queries on the catalog.
    fn records(&self) -> Arc<dyn Records>;

    /// Commits an order and returns when it is durable, or has changed nothing.
    async fn commit(&self, order: Order) -> Result<Done, WriteError>;
}

/// A request to commit.
#[derive(Debug, Clone)]
pub enum Order {
    /// All of the writes or none.
    Write(Vec<Write>),
    /// Moves an alias forward: compares, checks the gates, moves, logs.
    Promote(PromoteOrder),
    /// Moves an alias back. This adds a log entry.
    Rollback(RollbackOrder),
    /// Deletes a task's checkpoints that the policy does not keep.
    PruneCheckpoints {
        /// Task of the checkpoints.
        task: TaskId,
        /// Number and rank of the checkpoints to keep.
        keep: Keep,
        /// The stage's value is stored.
        at_end: bool,
    },
    /// Keeps an artifact even if no row names it.
    Pin {
        /// Manifest of the artifact.
        digest: Digest,
        /// Reason of the pin; `None` removes the pin.
        reason: Option<String>,
    },
    /// Keeps a blob for a held task, which is about to store it.
    Hold { task: TaskId, digest: Digest },
    /// Keeps the blobs of these tasks no longer.
    LetGo(Vec<TaskId>),
    /// Deletes an ended run.
    Forget(RunId),
    /// Deletes unreferenced data of a run that ended before a time.
    ForgetLeftovers {
        /// The run; its own row stays.
        run: RunId,
        /// The time, in milliseconds since 1970.
        before_ms: i64,
    },
    /// Removes history from before a time, in milliseconds since 1970.
    PruneHistory { before_ms: i64 },
    /// Records that a hook has received the history up to this row.
    Delivered { hook: String, id: i64 },
    /// Starts a collection: deletes its rows, then records the blobs that new rows name.
    BeginCollection,
    /// Removes the record that blobs are present, except of blobs that rows have named since the collection began. From
    /// then on no writer relies on the others.
    Condemn(Vec<Digest>),
}

/// A promotion to commit.
#[derive(Debug, Clone)]
pub struct PromoteOrder {
    pub model: ModelName,
    /// The alias to move.
    pub alias: Alias,
    /// The version to move it to.
    pub to: Which,
    /// Expected current version of the alias, if the caller gives one.
    pub expect: Option<Expect>,
    /// Gates as written.
    pub require: Vec<String>,
    /// Reason for the log.
    pub reason: String,
    /// Name of the caller.
    pub actor: String,
}

/// A rollback to commit.
#[derive(Debug, Clone)]
pub struct RollbackOrder {
    pub model: ModelName,
    /// The alias to move.
    pub alias: Alias,
    /// The target version; `None` means the version before the last promotion.
    pub to: Option<u64>,
    /// Expected current version of the alias, if the caller gives one.
    pub expect: Option<Expect>,
    /// Reason for the log.
    pub reason: String,
    /// Name of the caller.
    pub actor: String,
}

/// Choice of the version to promote.
#[derive(Debug, Clone)]
pub enum Which {
    /// The version with this artifact.
    Artifact(Digest),
    /// A version by number or alias.
    Pick(Pick),
}

/// Result of a committed order.
#[derive(Debug)]
pub enum Done {
    /// The order is stored.
    Nothing,
    /// The log entry of a promotion or rollback.
    Promoted(Box<Promotion>),
    /// The manifests of pruned checkpoints.
    Pruned(Vec<Digest>),
    /// Of pruning history: the number of rows that went.
    PrunedHistory(u64),
    /// The tasks whose shards the start of a collection deleted.
    Begun(Vec<TaskId>),
    /// The condemned blobs, without the ones named by a row.
    Condemned(Vec<Digest>),
    /// The rows that forgetting a run deleted.
    Forgotten(Forgotten),
}
