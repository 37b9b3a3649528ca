//! Writes as data. One call of [`Store::write`](crate::Store::write) is one transaction: all of it or none.
//!
//! The transaction checks every write with a [`Grant`] against the task's fence, so that no code path can omit the
//! check. An older fence refuses the whole transaction with [`WriteError::StaleFence`](crate::WriteError::StaleFence).

use std::collections::BTreeMap;

use protocol::message::{Grant, MetricRow};
use protocol::{Alias, Digest, Fence, Group, ModelName, Owner, RunId, StageName, TaskId};
use serde_json::Value;

use crate::history::HistoryEntry;

/// One row or change.
#[derive(Debug, Clone, PartialEq)]
pub enum Write {
    /// Appends the facts of one decision of the coordinator; recovery applies them in order.
    Facts {
        /// The decision's number, one more than the one before. A number that exists is refused, so that only one of
        /// two coordinators on a store can continue.
        seq: u64,
        /// JSON that only the coordinator interprets.
        facts: String,
    },
    /// Parts of the snapshot of decision `seq`. They have no effect until that snapshot is written.
    SnapshotParts {
        /// Number of the snapshot's decision.
        seq: u64,
        /// Parts that changed since the previous snapshot, by name, as JSON; `None` deletes a part.
        parts: Vec<(String, Option<String>)>,
    },
    /// The coordinator's state after decision `seq`, except for its parts. Deletes the covered facts and replaced
    /// parts.
    Snapshot {
        /// The newest decision that the snapshot covers.
        seq: u64,
        /// The state as JSON.
        state: String,
    },
    /// Sets a task's fence; it must be larger than the stored one.
    Fence {
        task: TaskId,
        /// The new fence.
        fence: Fence,
    },
    /// A submitted run with its pipeline.
    Run {
        run: RunId,
        /// The validated pipeline.
        pipeline: Value,
        /// The YAML as written.
        source: String,
        /// `running`, `paused`, `finished`, `failed`, `cancelled`.
        state: String,
        /// Unique if given.
        idempotency_key: Option<String>,
    },
    /// The digest of a run's submission as it was sent; see [`RunRow::submission`](crate::RunRow::submission).
    Submission { run: RunId, digest: Digest },
    /// The group that owns a run.
    RunOwner {
        run: RunId,
        /// The owning group.
        owner: Group,
    },
    /// Records the owner of a new model. If an existing model is not under the owner's control, the whole transaction
    /// is refused.
    ModelOwner {
        model: ModelName,
        /// Owner of the token that registers the model.
        owner: Owner,
    },
    /// Changes the state of a run.
    RunState {
        run: RunId,
        /// The new state, as in [`Write::Run`].
        state: String,
    },
    /// Ends a run and stores everything that later queries need, because the coordinator forgets the run.
    RunEnded {
        run: RunId,
        /// The final state, as in [`Write::Run`].
        state: String,
        /// The run as clients see it, as JSON.
        view: String,
        /// The run as the coordinator resumes it, as JSON.
        archive: String,
    },
    /// Archives an unfinished execution that no run needs: attempts, shards, checkpoints. `None` deletes it, because it
    /// has no data or a run has resumed it.
    Archive {
        /// The stage's key.
        key: Digest,
        /// The run of its tasks; logs and metrics are stored under this run and `stage`.
        run: RunId,
        /// The stage of its tasks.
        stage: StageName,
        /// The execution as JSON.
        execution: Option<String>,
    },
    /// Events for human readers. They change nothing else.
    History(Vec<HistoryEntry>),
    /// Values by step, stored once per (task, attempt, key, step) even if sent several times.
    Metrics {
        /// Grant whose fence is checked.
        grant: Grant,
        rows: Vec<MetricRow>,
    },
    /// Log lines, stored once per (task, attempt, worker, line number).
    Logs {
        /// Grant whose fence is checked.
        grant: Grant,
        /// Number of the first line.
        first: u64,
        lines: Vec<String>,
    },
    /// Makes a manifest, whose blobs are stored, the task's newest checkpoint.
    Checkpoint {
        /// Grant whose fence is checked.
        grant: Grant,
        /// Number of applied steps.
        step: u64,
        manifest: Digest,
        /// Values by which retention may rank checkpoints.
        metrics: BTreeMap<String, f64>,
    },
    /// The artifact of one shard.
    Shard {
        /// Grant whose fence is checked.
        grant: Grant,
        /// Manifest of the shard's artifact.
        output: Digest,
    },
    /// A stage's value under its key; the stage is cached from then on. The first writer of a key wins; another output
    /// is refused as [`WriteError::Conflict`].
    StageResult {
        /// Grant of a worker, whose fence is checked; `None` for a value of the coordinator.
        grant: Option<Grant>,
        /// The stage's key.
        key: Digest,
        /// The run that computed it.
        run: RunId,
        /// The stage that computed it.
        stage: StageName,
        kind: String,
        /// Outputs by name.
        outputs: BTreeMap<String, Digest>,
        /// Final metrics by name.
        metrics: BTreeMap<String, f64>,
        /// Artifacts that it was made from, stored as lineage.
        inputs: BTreeMap<String, Digest>,
        /// Working time in seconds.
        wall_s: f64,
    },
    /// A model version. Registering the same artifact again only adds its metrics.
    Version {
        model: ModelName,
        /// Digest of a manifest of kind `model`.
        artifact: Digest,
        /// Metrics by name.
        metrics: BTreeMap<String, f64>,
        /// Origin: run, stage, stage key.
        source: Value,
    },
    /// Moves an alias to the version of `artifact`, and logs it.
    Promote {
        model: ModelName,
        alias: Alias,
        /// The registered artifact.
        artifact: Digest,
        /// Gates as written, checked on stored metrics inside the transaction.
        require: Vec<String>,
        /// Reason for the log.
        reason: String,
        /// Name of the caller.
        actor: String,
    },
}

impl Write {
    /// Returns the artifacts that the write names, which must be proven whole.
    pub(crate) fn artifacts(&self) -> Vec<Digest> {
        match self {
            Self::Checkpoint { manifest, .. } => vec![*manifest],
            Self::Shard { output, .. } => vec![*output],
            Self::StageResult { outputs, .. } => outputs.values().copied().collect(),
            Self::Version { artifact, .. } => vec![*artifact],
            Self::Facts { .. }
            | Self::SnapshotParts { .. }
            | Self::Snapshot { .. }
            | Self::Fence { .. }
            | Self::Run { .. }
            | Self::Submission { .. }
            | Self::RunOwner { .. }
            | Self::ModelOwner { .. }
            | Self::RunState { .. }
            | Self::RunEnded { .. }
            | Self::Archive { .. }
            | Self::History(_)
            | Self::Metrics { .. }
            | Self::Logs { .. }
            | Self::Promote { .. } => Vec::new(),
        }
    }

    /// Returns the grant whose fence the store checks. A new kind of write must decide here if it needs one.
    pub(crate) fn grant(&self) -> Option<&Grant> {
        match self {
            Self::Metrics { grant, .. }
            | Self::Logs { grant, .. }
            | Self::Checkpoint { grant, .. }
            | Self::Shard { grant, .. } => Some(grant),
            Self::StageResult { grant, .. } => grant.as_ref(),
            Self::Facts { .. }
            | Self::SnapshotParts { .. }
            | Self::Snapshot { .. }
            | Self::Fence { .. }
            | Self::Run { .. }
            | Self::Submission { .. }
            | Self::RunOwner { .. }
            | Self::ModelOwner { .. }
            | Self::RunState { .. }
            | Self::RunEnded { .. }
            | Self::Archive { .. }
            | Self::History(_)
            | Self::Version { .. }
            | Self::Promote { .. } => None,
        }
    }
}

/// Message about two different checkpoints of one step.
pub fn two_states(task: &TaskId, step: u64, stored: &str, now: &str) -> String {
    format!(
        "task `{task}` has checkpoint {stored} at step {step}, but this attempt made {now}: two computations of the \
         same step differ, which is a bug"
    )
}
