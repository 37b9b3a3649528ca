//! Messages of workers: joining, polling with its assignments, and what a grant allows to write.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Backend, CheckpointPolicy, StageSettings};
use crate::{Attempt, Digest, Fence, Generation, Incarnation, Labels, RunId, Seed, StageName, TaskId, WorkerId};

/// Version of these messages; a worker with another version is refused.
pub const PROTOCOL_VERSION: u32 = 7;

/// `POST /v1/workers`: a process registers as a worker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Join {
    /// Version of the worker's messages, [`PROTOCOL_VERSION`].
    pub protocol: u32,
    /// The worker's name, unique among live workers. It stays with the token that joined, and with the process until that leaves
    /// or its lease ends.
    pub worker: WorkerId,
    /// Process id, for display.
    pub pid: u32,
    /// Backend on which it computes.
    pub backend: Backend,
    /// Instruction set of its processor's kernels, such as `avx512` or `neon`. Sums round differently under another
    /// one, so all workers of one stage must have the same.
    pub instruction_set: String,
    /// Code versions of its stage kinds, those above 1. Another version computes other numbers, so a worker with other
    /// versions than the coordinator is refused.
    #[serde(default)]
    pub code_versions: BTreeMap<String, u32>,
    /// Address of its collective listener for peers, `host:port`.
    pub peer_address: String,
    /// Labels that stages may require.
    #[serde(default, skip_serializing_if = "Labels::is_empty")]
    pub labels: Labels,
}

/// The answer to [`Join`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Joined {
    /// Incarnation of this process among all with the worker's name.
    pub incarnation: Incarnation,
    /// A worker that is silent for this time loses its assignments.
    pub lease_ms: u64,
    /// Longest time that `poll` may wait for changes.
    pub poll_ms: u64,
}

/// `POST /v1/workers/{worker}/poll`: a worker reports its work and asks for assignments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Poll {
    /// Incarnation from [`Joined`].
    pub incarnation: Incarnation,
    /// Current work, one entry for each assignment of the worker.
    pub doing: Vec<Doing>,
    /// Tasks of [`DesiredAssignments::prepare`] whose inputs the worker has.
    pub ready: Vec<TaskId>,
    /// Version of the assignments that the worker has ([`DesiredAssignments::version`]). The coordinator answers at
    /// once if it has another version, else within `poll_ms`.
    pub version: u64,
    /// True once the process was asked to end. It takes no more work, and gangs continue without it where they can.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub leaving: bool,
}

/// State of a worker's work on one assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Doing {
    /// Grant of the assignment.
    pub grant: Grant,
    pub progress: Progress,
    /// Steps applied in the training state that this member holds in memory; `None` while it has only initialised itself.
    pub holds: Option<u64>,
    /// The member that this one waits for now.
    pub waits_for: Option<WorkerId>,
    /// Gang members that this one cannot go on with in this generation. The coordinator decides who of them leaves the gang.
    pub lost: Vec<LostPeer>,
    /// Peak resident memory of the worker's process during this assignment, in bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
}

impl Doing {
    /// Work on `grant` that has come so far, with no state in memory and nothing to complain of.
    pub fn new(grant: Grant, progress: Progress) -> Self {
        Self { grant, progress, holds: None, waits_for: None, lost: Vec::new(), peak_memory: None }
    }
}

/// A gang member that another cannot go on with.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
pub struct LostPeer {
    pub worker: WorkerId,
    pub cause: LossCause,
}

/// The reason for which a member cannot go on with a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LossCause {
    /// No connection, or no byte of it for too long.
    Unreachable,
    /// Reachable, but training alone would be faster.
    Slow,
    /// It sends what this build does not expect.
    Disagrees,
}

/// Progress of a task.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Progress {
    /// Number of steps, clips or shards done.
    pub done: u64,
    /// Total number of steps, clips or shards.
    pub total: u64,
    /// Unit of the numbers: `steps`, `clips`, `captions`.
    pub unit: String,
    /// Newest values, for a progress line.
    #[schemars(with = "BTreeMap<String, Option<f64>>")]
    pub metrics: BTreeMap<String, f64>,
}

/// `POST /v1/workers/{worker}/gone`: the process ends.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Gone {
    /// Incarnation from [`Joined`].
    pub incarnation: Incarnation,
}

/// The answer to [`Poll`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DesiredAssignments {
    /// Version that changes with the assignments.
    pub version: u64,
    /// All assignments of the worker; it must stop and drop any other work.
    pub assignments: Vec<Assignment>,
    /// Tasks that an idle worker may get. It fetches their inputs and reports that it is ready, and only then takes
    /// part. It stops fetching for tasks that are no longer listed.
    pub prepare: Vec<Prepare>,
    /// True if the worker should exit once it has no work.
    pub leave: bool,
}

/// Inputs to be fetched before a task can be assigned.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Prepare {
    pub task: TaskId,
    /// Artifacts by the field that names them, as in [`StageTask::inputs`].
    pub inputs: BTreeMap<String, Digest>,
    /// Checkpoint to continue from, unless a member would supply its state.
    pub resume: Option<Digest>,
    /// The members that it would join. It is ready once it reaches all of them.
    pub peers: Vec<Member>,
}

/// The right to write for a task.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
pub struct Grant {
    pub task: TaskId,
    /// Number of the attempt.
    pub attempt: Attempt,
    /// Fence of the grant; for a gang it is the generation.
    pub fence: Fence,
    pub worker: WorkerId,
    /// Incarnation of the worker's process.
    pub incarnation: Incarnation,
}

/// Work for one worker on one task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Assignment {
    /// Grant, carried by every write.
    pub grant: Grant,
    /// Secret of the grant, shown by every write in [`SECRET_HEADER`](crate::proof::SECRET_HEADER). The server adds it to its
    /// answer; the state does not hold it.
    pub secret: String,
    /// Settings and inputs of the stage.
    pub stage: StageTask,
    /// Part of the worker: alone, a shard, or a gang member.
    pub role: Role,
    /// Newest committed checkpoint of the task, as its manifest's digest.
    pub resume: Option<Digest>,
    /// True if the worker should stop between two steps: save and report `Yielded`.
    pub drain: bool,
}

/// A stage's work from the point of view of a worker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StageTask {
    pub run: RunId,
    pub name: StageName,
    pub settings: StageSettings,
    /// Artifacts by the field that names them.
    pub inputs: BTreeMap<String, Digest>,
    /// The run's seed.
    pub seed: Seed,
    /// Cadence and retention of checkpoints.
    pub checkpoint: CheckpointPolicy,
}

/// Part of a worker in a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "role", rename_all = "kebab-case")]
pub enum Role {
    /// The only worker on a plain stage.
    Alone,
    /// One shard of a map stage.
    Shard {
        /// Index of the shard, from 0.
        index: u32,
        /// Number of shards.
        of: u32,
    },
    /// Digests what the stage's settings name outside the store, before the stage has a key. Answers [`TaskOutcome::Resolved`].
    Resolve,
    /// Merges the shards of a map stage into its artifact.
    Merge {
        /// Artifacts of the shards, in order.
        shards: Vec<Digest>,
    },
    /// A member of a gang.
    Member {
        /// The gang's generation, equal to the grant's fence.
        generation: Generation,
        /// All members by rank. Rank 0 saves checkpoints, records metrics and reports the outcome.
        members: Vec<Member>,
        /// Secret that proves membership of this generation.
        secret: String,
    },
}

/// A member of a gang.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Member {
    pub worker: WorkerId,
    pub incarnation: Incarnation,
    /// Address of its collective listener, `host:port`.
    pub peer_address: String,
}

/// `POST /v1/metrics`: values by step, exactly once per (task, attempt, key, step).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MetricBatch {
    /// Grant of the write.
    pub grant: Grant,
    #[serde(deserialize_with = "crate::bounded::batch")]
    pub rows: Vec<MetricRow>,
}

/// One recorded value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MetricRow {
    /// Step after which it was recorded.
    pub step: u64,
    /// Name of the value.
    pub key: String,
    /// NaN for everything that is not finite, and `null` in JSON.
    #[serde(deserialize_with = "null_is_nan")]
    #[schemars(with = "Option<f64>")]
    pub value: f64,
}

fn null_is_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Option::<f64>::deserialize(deserializer).map(|value| value.unwrap_or(f64::NAN))
}

/// `POST /v1/logs`: lines of a task's log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LogBatch {
    /// Grant of the write.
    pub grant: Grant,
    /// Number of the first line within the attempt and worker; a batch sent twice is stored once.
    pub first: u64,
    #[serde(deserialize_with = "crate::bounded::batch")]
    pub lines: Vec<String>,
}

/// `POST /v1/checkpoints`: makes an uploaded manifest the task's newest checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CommitCheckpoint {
    /// Grant of the write.
    pub grant: Grant,
    /// Number of steps applied.
    pub step: u64,
    /// Manifest, uploaded earlier with all blobs that it lists.
    pub manifest: Digest,
    /// Values by which retention may rank.
    #[schemars(with = "BTreeMap<String, Option<f64>>")]
    pub metrics: BTreeMap<String, f64>,
}

/// `POST /v1/outcomes`: the end of an assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ReportOutcome {
    /// Grant of the write.
    pub grant: Grant,
    pub outcome: TaskOutcome,
    /// Peak resident memory of the worker's process during the assignment, in bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
}

impl ReportOutcome {
    /// An outcome of `grant`, with no measured memory.
    pub fn new(grant: Grant, outcome: TaskOutcome) -> Self {
        Self { grant, outcome, peak_memory: None }
    }
}

/// End of an assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "outcome", rename_all = "kebab-case")]
pub enum TaskOutcome {
    /// The output's manifest is uploaded with all blobs that it lists.
    Finished {
        output: Digest,
        /// Final metrics by name.
        #[schemars(with = "BTreeMap<String, Option<f64>>")]
        metrics: BTreeMap<String, f64>,
    },
    /// The digests that [`Role::Resolve`] asks for.
    Resolved {
        /// By the field that names each file or folder.
        digests: BTreeMap<String, Digest>,
    },
    /// Stopped between steps, with a checkpoint committed.
    Yielded {
        /// Number of steps applied.
        at: u64,
    },
    /// The task cannot be done, or not now.
    Failed {
        /// Class of the failure, which decides about retries.
        class: FailureClass,
        /// Description of the failure for the user.
        message: String,
    },
}

/// Consequence of a failure for retries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FailureClass {
    /// The user's data or settings are wrong: final.
    Input,
    /// The loss or the gradient is not finite: final.
    Diverged,
    /// The memory was exhausted: final.
    OutOfMemory,
    /// The coordinator or another member refuses what is too large or of another build: final.
    Refused,
    /// The store is full or not writable: final; after freeing space, `resume` continues.
    Storage,
    /// The store has no intact copy of an input: its producer runs again, within the restart budget.
    Damaged,
    /// A panic or another internal fault: counts against the restart budget.
    Fault,
    /// A lost peer or a network error: counts against the infrastructure budget.
    Infrastructure,
}

impl FailureClass {
    /// Returns true if another try on another worker would fail the same way.
    pub fn is_final(self) -> bool {
        match self {
            Self::Input | Self::Diverged | Self::OutOfMemory | Self::Refused | Self::Storage => true,
            Self::Damaged | Self::Fault | Self::Infrastructure => false,
        }
    }
}
