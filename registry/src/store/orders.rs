//! The orders to the catalog of a held store: moves of aliases, pins, holds, deletions.

use std::time::Duration;

use protocol::stage::Keep;
use protocol::{Alias, Digest, ModelName, RunId, TaskId};

use super::held::Store;
use crate::WriteError;
use crate::catalog::{Done, Order, PromoteOrder, RollbackOrder, Which};
use crate::forget::Forgotten;
use crate::versions::{Expect, Pick, Promotion};

impl Store {
    /// Moves an alias to a version: compares it with `expect` if given, checks the gates, moves, logs.
    #[expect(clippy::too_many_arguments, reason = "what a promotion is made of")]
    pub async fn promote(
        &self,
        model: &ModelName,
        pick: Pick,
        alias: &Alias,
        expect: Option<Expect>,
        require: Vec<String>,
        reason: &str,
        actor: &str,
    ) -> Result<Promotion, WriteError> {
        let order = PromoteOrder {
            model: model.clone(),
            alias: alias.clone(),
            to: Which::Pick(pick),
            expect,
            require,
            reason: reason.to_owned(),
            actor: actor.to_owned(),
        };
        promoted(self.order(Order::Promote(order)).await?)
    }

    /// Moves an alias back to `to`, or to the version before its last promotion. This adds a log entry.
    pub async fn rollback(
        &self,
        model: &ModelName,
        alias: &Alias,
        to: Option<u64>,
        expect: Option<Expect>,
        reason: &str,
        actor: &str,
    ) -> Result<Promotion, WriteError> {
        let model = model.clone();
        let alias = alias.clone();
        let reason = reason.to_owned();
        let actor = actor.to_owned();
        promoted(self.order(Order::Rollback(RollbackOrder { model, alias, to, expect, reason, actor })).await?)
    }

    /// Deletes a task's checkpoints that `keep` does not select, under way or `at_end`, and returns the deleted manifests.
    /// The next [`Self::gc`] removes their blobs.
    pub async fn prune_checkpoints(&self, task: &TaskId, keep: Keep, at_end: bool) -> Result<Vec<Digest>, WriteError> {
        match self.order(Order::PruneCheckpoints { task: task.clone(), keep, at_end }).await? {
            Done::Pruned(manifests) => Ok(manifests),
            done => Err(unexpected(&done)),
        }
    }

    /// Keeps an artifact even if no row names it.
    pub async fn pin(&self, digest: Digest, reason: &str) -> Result<(), WriteError> {
        self.order_proven(&[digest], || Order::Pin { digest, reason: Some(reason.to_owned()) }).await.map(|_| ())
    }

    /// Removes a pin.
    pub async fn unpin(&self, digest: Digest) -> Result<(), WriteError> {
        self.order(Order::Pin { digest, reason: None }).await.map(|_| ())
    }

    /// Keeps a blob that a held task is about to store until [`Self::let_go`], also after a restart.
    pub async fn hold(&self, task: &TaskId, digest: Digest) -> Result<(), WriteError> {
        if !self.blobs().has_stored(task, digest) {
            self.order(Order::Hold { task: task.clone(), digest }).await?;
            self.blobs().hold(task, digest);
        }
        Ok(())
    }

    /// Keeps the blobs of tasks that are not held no longer. Deletes uploads without a request for `idle`, usually
    /// [`crate::blob::IDLE`].
    pub async fn let_go(&self, idle: Duration, is_held: impl Fn(&TaskId) -> bool + Send) -> Result<(), WriteError> {
        let over = self.blobs().let_go(idle, is_held);
        if over.is_empty() {
            return Ok(());
        }
        // If this fails, the next process reads the rows and deletes them.
        self.order(Order::LetGo(over)).await.map(|_| ())
    }

    /// Deletes an ended run. The next [`Self::gc`] removes its blobs.
    pub async fn forget(&self, run: &RunId) -> Result<Forgotten, WriteError> {
        match self.order(Order::Forget(run.clone())).await? {
            Done::Forgotten(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Deletes unreferenced data of a run that ended before a time: sweep trials other than the best, and checkpoints
    /// and shards of stages without a value. The run stays. The next [`Self::gc`] removes the blobs.
    pub async fn forget_leftovers(&self, run: &RunId, before_ms: i64) -> Result<Forgotten, WriteError> {
        match self.order(Order::ForgetLeftovers { run: run.clone(), before_ms }).await? {
            Done::Forgotten(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Records that a hook has received the history up to this row.
    pub async fn record_delivery(&self, hook: &str, id: i64) -> Result<(), WriteError> {
        self.order(Order::Delivered { hook: hook.to_owned(), id }).await.map(drop)
    }

    /// Removes history from before a time, in milliseconds since 1970; returns the number of rows that went.
    pub async fn prune_history(&self, before_ms: i64) -> Result<u64, WriteError> {
        match self.order(Order::PruneHistory { before_ms }).await? {
            Done::PrunedHistory(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Starts a collection and deletes its rows. Returns the tasks whose shards were deleted.
    pub(crate) async fn begin_collection(&self) -> Result<Vec<TaskId>, WriteError> {
        match self.order(Order::BeginCollection).await? {
            Done::Begun(forgotten) => Ok(forgotten),
            done => Err(unexpected(&done)),
        }
    }

    /// Deletes the records of blobs that no row has named since the collection began, and returns these blobs.
    pub(crate) async fn condemn(&self, blobs: Vec<Digest>) -> Result<Vec<Digest>, WriteError> {
        match self.order(Order::Condemn(blobs)).await? {
            Done::Condemned(taken) => Ok(taken),
            done => Err(unexpected(&done)),
        }
    }

    pub(crate) async fn order(&self, order: Order) -> Result<Done, WriteError> {
        self.catalog().commit(order).await
    }
}

fn promoted(done: Done) -> Result<Promotion, WriteError> {
    match done {
        Done::Promoted(promotion) => Ok(*promotion),
        done => Err(unexpected(&done)),
    }
}

fn unexpected(done: &Done) -> WriteError {
    WriteError::Internal(format!("the writer answered {done:?} to another order"))
}
