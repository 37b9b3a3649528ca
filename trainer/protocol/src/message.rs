//! Messages between workers, the coordinator and its clients: JSON over HTTP.
//!
//! Workers pull. `poll` is both heartbeat and request for work: a worker reports its work, and the coordinator answers
//! with the full set of assignments that the worker should have. The worker then starts and stops work to match it. A
//! lost answer does no harm, because the next one has the same content.
//!
//! Every write carries a [`Grant`]. The coordinator checks its fence in the transaction that stores the write. It
//! answers 409 with [`ApiError`] code `stale-fence` to an old one.
//!
//! Names and grants are not secret. [`proof`](crate::proof) says how a call proves whose it is.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::stage::{Backend, CheckpointPolicy, Mode, StageSettings};
use crate::sweep::{SearchKind, Values};
use crate::{Attempt, Digest, Fence, Generation, Incarnation, Owner, RunId, Seed, StageName, TaskId, WorkerId};

/// Version of these messages; a worker with another version is refused.
pub const PROTOCOL_VERSION: u32 = 5;

/// `POST /v1/workers`: a process registers as a worker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
    /// Address of its collective listener for peers, `host:port`.
    pub peer_address: String,
}

/// The answer to [`Join`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Joined {
    /// Incarnation of this process among all with the worker's name.
    pub incarnation: Incarnation,
    /// A worker that is silent for this time loses its assignments.
    pub lease_ms: u64,
    /// Longest time that `poll` may wait for changes.
    pub poll_ms: u64,
}

/// `POST /v1/workers/{worker}/poll`: a worker reports its work and asks for assignments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
}

/// State of a worker's work on one assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
}

impl Doing {
    /// Work on `grant` that has come so far, with no state in memory and nothing to complain of.
    pub fn new(grant: Grant, progress: Progress) -> Self {
        Self { grant, progress, holds: None, waits_for: None, lost: Vec::new() }
    }
}

/// A gang member that another cannot go on with.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct LostPeer {
    pub worker: WorkerId,
    pub cause: LossCause,
}

/// The reason for which a member cannot go on with a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Number of steps, clips or shards done.
    pub done: u64,
    /// Total number of steps, clips or shards.
    pub total: u64,
    /// Unit of the numbers: `steps`, `clips`, `captions`.
    pub unit: String,
    /// Newest values, for a progress line.
    pub metrics: BTreeMap<String, f64>,
}

/// `POST /v1/workers/{worker}/gone`: the process ends.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gone {
    /// Incarnation from [`Joined`].
    pub incarnation: Incarnation,
}

/// The answer to [`Poll`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Member {
    pub worker: WorkerId,
    pub incarnation: Incarnation,
    /// Address of its collective listener, `host:port`.
    pub peer_address: String,
}

/// `POST /v1/metrics`: values by step, exactly once per (task, attempt, key, step).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricBatch {
    /// Grant of the write.
    pub grant: Grant,
    #[serde(deserialize_with = "crate::bounded::batch")]
    pub rows: Vec<MetricRow>,
}

/// One recorded value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricRow {
    /// Step after which it was recorded.
    pub step: u64,
    /// Name of the value.
    pub key: String,
    /// NaN for everything that is not finite, and `null` in JSON.
    #[serde(deserialize_with = "null_is_nan")]
    pub value: f64,
}

fn null_is_nan<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Option::<f64>::deserialize(deserializer).map(|value| value.unwrap_or(f64::NAN))
}

/// `POST /v1/logs`: lines of a task's log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogBatch {
    /// Grant of the write.
    pub grant: Grant,
    /// Number of the first line within the attempt and worker; a batch sent twice is stored once.
    pub first: u64,
    #[serde(deserialize_with = "crate::bounded::batch")]
    pub lines: Vec<String>,
}

/// `POST /v1/checkpoints`: makes an uploaded manifest the task's newest checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CommitCheckpoint {
    /// Grant of the write.
    pub grant: Grant,
    /// Number of steps applied.
    pub step: u64,
    /// Manifest, uploaded earlier with all blobs that it lists.
    pub manifest: Digest,
    /// Values by which retention may rank.
    pub metrics: BTreeMap<String, f64>,
}

/// `POST /v1/outcomes`: the end of an assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReportOutcome {
    /// Grant of the write.
    pub grant: Grant,
    pub outcome: TaskOutcome,
}

/// End of an assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "outcome", rename_all = "kebab-case")]
pub enum TaskOutcome {
    /// The output's manifest is uploaded with all blobs that it lists.
    Finished {
        output: Digest,
        /// Final metrics by name.
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
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

/// `POST /v1/runs`: submits a pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Submit {
    /// The validated pipeline as JSON (`pipeline::Pipeline`).
    pub pipeline: serde_json::Value,
    /// YAML as written, kept for display.
    pub source: String,
    /// Submitting twice with one key creates one run.
    pub idempotency_key: Option<String>,
    /// Last stage to run.
    pub until: Option<StageName>,
}

/// A run as clients see it: `GET /v1/runs/{run}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunView {
    pub run: RunId,
    /// The pipeline's name.
    pub pipeline: String,
    /// The token that submitted it.
    #[serde(default)]
    pub owner: Owner,
    pub state: RunState,
    /// It is paused because the process that worked on it ended, not because a user paused it.
    #[serde(default)]
    pub interrupted: bool,
    /// Stages in topological order, then the stages made by sweeps.
    pub stages: Vec<StageView>,
    /// Sweeps that have started.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sweeps: Vec<SweepView>,
    /// What keeps the coordinator from storing or reading what the run needs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub storage: Option<StorageProblem>,
    #[serde(default, skip_serializing_if = "Times::are_unknown")]
    pub times: Times,
}

/// Why a store does not take or give what it should.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StorageProblem {
    /// Since when, in milliseconds since 1970.
    pub since_ms: i64,
    /// What is wrong, in words.
    pub what: String,
}

/// State of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunState {
    /// Work is in progress or waits for workers.
    Running,
    /// Paused by the user; work yields.
    Paused,
    /// Every requested stage is done.
    Finished,
    /// A stage failed permanently.
    Failed,
    /// Cancelled by the user.
    Cancelled,
}

impl RunState {
    /// Returns true if the state cannot change any more.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Finished | Self::Failed | Self::Cancelled)
    }
}

/// Times of a run or a stage by the server's clock, in milliseconds since 1970.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Times {
    /// Time of the submission; a stage has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub created_ms: Option<i64>,
    /// Start of the first work.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started_ms: Option<i64>,
    /// End of the newest attempt at all of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ended_ms: Option<i64>,
}

impl Times {
    /// Returns true if no time is known.
    pub fn are_unknown(&self) -> bool {
        *self == Self::default()
    }
}

/// A stage as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageView {
    pub name: StageName,
    /// Stage kind, such as `train.vae`.
    pub kind: String,
    pub state: StageState,
    /// Key of the stage, once its inputs are known.
    pub key: Option<Digest>,
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values, or the newest ones while it runs.
    pub metrics: BTreeMap<String, f64>,
    pub progress: Progress,
    /// Seconds of work so far, over all attempts of this run; not part of any key.
    pub wall_s: f64,
    /// Number of the current attempt.
    pub attempt: Attempt,
    /// Workers with an assignment of it now.
    pub workers: Vec<WorkerId>,
    /// Instruction set of the workers that computed it, or compute it now; not part of any key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// Reason of a failure, or of waiting.
    pub message: Option<String>,
    /// Idle workers that it lacks, if that is what it waits for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wants_workers: Option<usize>,
    /// Swept stage that it belongs to, if a sweep made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<StageName>,
    #[serde(default, skip_serializing_if = "Times::are_unknown")]
    pub times: Times,
    /// Stages that it reads.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<StageName>,
}

impl StageView {
    /// The message of a stage that the submission left out (`until`).
    pub const NOT_ASKED_FOR: &str = "not asked for";

    /// Returns false for a stage that the submission left out (`until`).
    pub fn is_asked_for(&self) -> bool {
        self.state != StageState::Skipped || self.message.as_deref() != Some(Self::NOT_ASKED_FOR)
    }
}

/// A sweep as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SweepView {
    /// The swept stage.
    pub stage: StageName,
    /// Search method of the sweep.
    pub search: SearchKind,
    /// Metric that ranks the trials.
    pub metric: String,
    /// Direction of the metric.
    pub mode: Mode,
    /// Steps at which trials are compared; the last is the whole budget.
    pub rungs: Vec<u64>,
    /// True if no work is in progress or will follow.
    pub over: bool,
    /// Number of steps trained so far, for this sweep or an earlier one.
    pub spent: u64,
    /// Number of steps if no trial fails.
    pub planned: u64,
    /// Number of steps if every trial had the whole budget.
    pub full: u64,
    /// Best trial at the whole budget so far.
    pub best: Option<usize>,
    /// All trials in the order of their numbers.
    pub trials: Vec<TrialView>,
}

/// A trial as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialView {
    /// Number of the trial, from 0.
    pub trial: usize,
    /// Values of the searched settings by path.
    pub values: Values,
    pub state: TrialState,
    /// Number of steps trained.
    pub steps: u64,
    /// Metric after each rung with a result; `None` for a failure.
    pub results: Vec<Option<f64>>,
    /// Reason of a failure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
}

/// State of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrialState {
    /// Not started yet.
    Waiting,
    /// A rung is scheduled: workers compute it or will.
    Running,
    /// A rung is done; the next one is not decided.
    Paused,
    /// Ended after a rung before the whole budget.
    Stopped,
    /// Trained for the whole budget.
    Finished,
    /// Failed and was stopped.
    Failed,
}

/// State of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StageState {
    /// Waits for other stages.
    Waiting,
    /// Can start; waits for workers.
    Ready,
    /// Workers compute it.
    Running,
    /// Done in this run, from step 0.
    Ran,
    /// Not run, because a result with its key exists.
    Cached,
    /// Done in this run, continuing a checkpoint of an earlier attempt.
    Resumed,
    /// Failed, without further attempts.
    Failed,
    /// Will not run: an input failed, the run was cancelled, or `--until` ends before it.
    Skipped,
}

/// Answer to every refused call.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ApiError {
    /// Code for programs: `stale-fence`, `unproven`, `unvouched`, `name-held`, `forbidden`, `not-found`, `conflict`, `invalid`,
    /// `storage`, `gate`, `internal`.
    pub code: String,
    /// Description for users.
    pub message: String,
    /// Remedy, if there is one.
    pub hint: Option<String>,
}
