//! What may be written, as data. One call of [`Store::write`](crate::Store::write) is one transaction: all of it or none.
//!
//! A write that carries a [`Grant`] is checked against the task's fence inside that transaction, so that no code path can
//! forget it; an older fence refuses the whole transaction with [`WriteError::StaleFence`](crate::WriteError::StaleFence).

use std::collections::BTreeMap;

use protocol::message::{Grant, MetricRow};
use protocol::{Alias, Digest, Fence, Group, ModelName, Owner, RunId, StageName, TaskId};
use serde_json::Value;

/// One row or change.
#[derive(Debug, Clone, PartialEq)]
pub enum Write {
    /// Appends the facts of one decision of the coordinator; recovery applies them in order.
    Facts {
        /// The decision's number: one more than that of the decision before. A number that is taken is refused, so that of two
        /// coordinators on one store only one goes on.
        seq: u64,
        /// JSON; what it says is the coordinator's business.
        facts: String,
    },
    /// Parts of the snapshot of decision `seq`, which follows; until then they do not count.
    SnapshotParts {
        /// As below.
        seq: u64,
        /// The parts that changed since the previous snapshot, by name: JSON, or `None` for a part that is gone.
        parts: Vec<(String, Option<String>)>,
    },
    /// The coordinator's state after decision `seq`, but for what is in its parts. The facts that it stands for go, and of each part all
    /// but the newest.
    Snapshot {
        /// The newest decision that it holds.
        seq: u64,
        /// JSON.
        state: String,
    },
    /// Sets a task's fence; it must be larger than the one stored.
    Fence {
        task: TaskId,
        /// Its new fence.
        fence: Fence,
    },
    /// A run that was submitted, and its pipeline.
    Run {
        /// Which.
        run: RunId,
        /// The validated pipeline.
        pipeline: Value,
        /// The YAML as written.
        source: String,
        /// `running`, `paused`, `finished`, `failed`, `cancelled`.
        state: String,
        /// Unique when given.
        idempotency_key: Option<String>,
    },
    /// The group that a run belongs to.
    RunOwner {
        /// Which.
        run: RunId,
        /// Whose.
        owner: Group,
    },
    /// Makes a new model its owner's. One that is there must be the owner's to control, or the whole transaction is refused.
    ModelOwner {
        model: ModelName,
        /// Who registers.
        owner: Owner,
    },
    /// A run that goes on in another state.
    RunState {
        /// Which.
        run: RunId,
        /// As above.
        state: String,
    },
    /// A run that ended, and with it all that is asked about it from now on: the coordinator forgets it.
    RunEnded {
        /// Which.
        run: RunId,
        /// As above.
        state: String,
        /// The run as clients see it, as JSON.
        view: String,
        /// The run as the coordinator takes it up again, as JSON.
        archive: String,
    },
    /// What there is of a stage's value that nobody waits for any more: tries, shards, checkpoints. `None`: there is nothing, or
    /// somebody has taken it up.
    Archive {
        /// The stage's key.
        key: Digest,
        /// Whose tasks they are: under these names its logs and values are stored.
        run: RunId,
        /// As above.
        stage: StageName,
        /// JSON.
        execution: Option<String>,
    },
    /// Values by step; stored once per (task, attempt, key, step) however often they are sent.
    Metrics {
        /// Checked.
        grant: Grant,
        rows: Vec<MetricRow>,
    },
    /// Log lines; stored once per (task, attempt, worker, line number).
    Logs {
        /// Checked.
        grant: Grant,
        /// Number of the first line.
        first: u64,
        lines: Vec<String>,
    },
    /// Makes a manifest whose blobs are stored the task's newest checkpoint.
    Checkpoint {
        /// Checked.
        grant: Grant,
        /// Steps applied.
        step: u64,
        manifest: Digest,
        /// Values that retention may rank by.
        metrics: BTreeMap<String, f64>,
    },
    /// One shard's artifact.
    Shard {
        /// Checked.
        grant: Grant,
        /// The artifact.
        output: Digest,
    },
    /// A stage's value under its key: from here on the stage is cached. The first writer of a key wins; a second one with
    /// another output is refused as [`WriteError::Conflict`].
    StageResult {
        /// Checked when a worker made it; `None` when the coordinator did.
        grant: Option<Grant>,
        /// The stage's key.
        key: Digest,
        /// Which run made it.
        run: RunId,
        /// Which stage.
        stage: StageName,
        kind: String,
        /// Outputs by name.
        outputs: BTreeMap<String, Digest>,
        /// Final values.
        metrics: BTreeMap<String, f64>,
        /// The artifacts it was made of: lineage edges.
        inputs: BTreeMap<String, Digest>,
        /// Seconds of work.
        wall_s: f64,
    },
    /// A model version. Registering the same artifact for the same model again adds its metrics and makes no new version.
    Version {
        model: ModelName,
        /// What is registered: a manifest of kind `model`.
        artifact: Digest,
        /// Metrics by name.
        metrics: BTreeMap<String, f64>,
        /// Where it came from: run, stage, stage key.
        source: Value,
    },
    /// Moves an alias to the version of `artifact`, and logs it.
    Promote {
        model: ModelName,
        alias: Alias,
        /// The registered artifact.
        artifact: Digest,
        /// Gates as written; evaluated on stored metrics inside the transaction.
        require: Vec<String>,
        /// Why.
        reason: String,
        /// Who.
        actor: String,
    },
}

impl Write {
    /// The artifacts that it names, which must be proven whole.
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
            | Self::RunOwner { .. }
            | Self::ModelOwner { .. }
            | Self::RunState { .. }
            | Self::RunEnded { .. }
            | Self::Archive { .. }
            | Self::Metrics { .. }
            | Self::Logs { .. }
            | Self::Promote { .. } => Vec::new(),
        }
    }

    /// The grant that vouches for it; the store checks its fence. Who adds a write decides here whether it needs one.
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
            | Self::RunOwner { .. }
            | Self::ModelOwner { .. }
            | Self::RunState { .. }
            | Self::RunEnded { .. }
            | Self::Archive { .. }
            | Self::Version { .. }
            | Self::Promote { .. } => None,
        }
    }
}

/// What is said of two checkpoints of one step that differ.
pub fn two_states(task: &TaskId, step: u64, stored: &str, now: &str) -> String {
    format!(
        "task `{task}` has checkpoint {stored} at step {step}; now it is {now}: the same step was computed twice with \
         different results, which should be impossible"
    )
}
