//! Messages between workers, the coordinator and its clients: JSON over HTTP.
//!
//! Workers pull. `poll` is heartbeat and order book in one: a worker reports what it does, the coordinator answers with
//! the full set of assignments that the worker should have, and the worker makes it so. Nothing is lost when an answer
//! is, because the next one says it all again.
//!
//! Every write carries a [`Grant`]; the coordinator checks its fence in the transaction that stores the write and answers
//! 409 with [`ApiError`] code `stale-fence` to an old one.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::stage::{Backend, CheckpointPolicy, Mode, StageSettings};
use crate::sweep::{SearchKind, Values};
use crate::{Attempt, Digest, Fence, Generation, Incarnation, RunId, Seed, StageName, TaskId, WorkerId};

/// The version of these messages; a worker of another version is turned away.
pub const PROTOCOL_VERSION: u32 = 4;

/// `POST /v1/workers`: a process offers itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Join {
    /// [`PROTOCOL_VERSION`].
    pub protocol: u32,
    /// The worker's name, unique among live workers.
    pub worker: WorkerId,
    /// Process id, for people.
    pub pid: u32,
    /// Where it computes.
    pub backend: Backend,
    /// What its processor's kernels dispatch to, such as `avx512` or `neon`. Sums round differently under another one, so all that
    /// work on one stage share it.
    pub instruction_set: String,
    /// Where peers reach its collective listener, `host:port`.
    pub peer_address: String,
}

/// The answer to [`Join`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Joined {
    /// This process among all that bore the name.
    pub incarnation: Incarnation,
    /// A worker that was not heard of for so long loses its assignments.
    pub lease_ms: u64,
    /// How long `poll` may wait for news.
    pub poll_ms: u64,
}

/// `POST /v1/workers/{worker}/poll`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Poll {
    /// From [`Joined`].
    pub incarnation: Incarnation,
    /// What the worker does now, one for each assignment it holds.
    pub doing: Vec<Doing>,
    /// Of the tasks that it was asked to prepare ([`DesiredAssignments::prepare`]), those whose inputs it has.
    pub ready: Vec<TaskId>,
    /// Digest-like number of the assignments the worker knows ([`DesiredAssignments::version`]); the coordinator answers at once
    /// when it has others, else within `poll_ms`.
    pub version: u64,
}

/// What a worker does about one assignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Doing {
    /// Which assignment.
    pub grant: Grant,
    /// How far.
    pub progress: Progress,
    /// Gang members that this one could not reach in this generation. The coordinator drops them from the gang.
    pub lost: Vec<WorkerId>,
}

/// How far a task is.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps, clips or shards done.
    pub done: u64,
    /// Out of.
    pub total: u64,
    /// What is counted: `steps`, `clips`, `captions`.
    pub unit: String,
    /// Newest values, for a progress line.
    pub metrics: BTreeMap<String, f64>,
}

/// The answer to [`Poll`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DesiredAssignments {
    /// Changes with the assignments.
    pub version: u64,
    /// All that the worker should be doing; what is missing here it must stop and forget.
    pub assignments: Vec<Assignment>,
    /// Tasks that an idle worker may be given: it fetches what they need and says so, and only then takes part. What is missing here it
    /// stops fetching.
    pub prepare: Vec<Prepare>,
    /// The worker should exit when it holds nothing.
    pub leave: bool,
}

/// What a worker fetches before it is given a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Prepare {
    pub task: TaskId,
    /// Artifacts by the field that names them, as in [`StageTask::inputs`].
    pub inputs: BTreeMap<String, Digest>,
    /// The checkpoint that it goes on from, unless a member would hand over its state.
    pub resume: Option<Digest>,
}

/// The right to write about a task.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Grant {
    pub task: TaskId,
    /// The try.
    pub attempt: Attempt,
    /// The fence. For a gang it is the generation.
    pub fence: Fence,
    pub worker: WorkerId,
    /// Its process.
    pub incarnation: Incarnation,
}

/// One thing to do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// Carried by every write.
    pub grant: Grant,
    /// What to do.
    pub stage: StageTask,
    /// Alone or with whom.
    pub role: Role,
    /// Newest committed checkpoint of the task: a manifest's digest.
    pub resume: Option<Digest>,
    /// Stop between two steps: save, report `Yielded`.
    pub drain: bool,
}

/// A stage's work as a worker sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageTask {
    pub run: RunId,
    /// The stage.
    pub name: StageName,
    pub settings: StageSettings,
    /// Artifacts by the field that names them.
    pub inputs: BTreeMap<String, Digest>,
    /// The run's seed.
    pub seed: Seed,
    /// Cadence.
    pub checkpoint: CheckpointPolicy,
}

/// How a worker takes part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "role", rename_all = "kebab-case")]
pub enum Role {
    /// The only worker on a plain stage.
    Alone,
    /// One shard of a map stage.
    Shard {
        /// Which, from 0.
        index: u32,
        /// Of how many.
        of: u32,
    },
    /// Merges the shards of a map stage into its artifact.
    Merge {
        /// The shards' artifacts, in order.
        shards: Vec<Digest>,
    },
    /// A member of a gang.
    Member {
        /// The gang's generation, equal to the grant's fence.
        generation: Generation,
        /// All members, rank by rank. Rank 0 saves checkpoints, records metrics and reports the outcome.
        members: Vec<Member>,
        /// Proves that a peer is of this generation.
        secret: String,
    },
}

/// A member of a gang.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Member {
    /// Who.
    pub worker: WorkerId,
    /// Which process.
    pub incarnation: Incarnation,
    /// Where.
    pub peer_address: String,
}

/// `POST /v1/metrics`: values by step, exactly once per (task, attempt, key, step).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricBatch {
    /// The right to write.
    pub grant: Grant,
    pub rows: Vec<MetricRow>,
}

/// One value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricRow {
    /// After which step.
    pub step: u64,
    /// Name.
    pub key: String,
    pub value: f64,
}

/// `POST /v1/logs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogBatch {
    /// The right to write.
    pub grant: Grant,
    /// Number of the first line within the attempt and worker; a batch sent twice is stored once.
    pub first: u64,
    pub lines: Vec<String>,
}

/// `POST /v1/checkpoints`: makes an uploaded manifest the task's newest checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CommitCheckpoint {
    /// The right to write.
    pub grant: Grant,
    /// Steps applied.
    pub step: u64,
    /// The manifest, uploaded before with the blobs it lists.
    pub manifest: Digest,
    /// Values that retention may rank by.
    pub metrics: BTreeMap<String, f64>,
}

/// `POST /v1/outcomes`: how an assignment ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReportOutcome {
    /// The right to write.
    pub grant: Grant,
    /// How.
    pub outcome: TaskOutcome,
}

/// How an assignment ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "outcome", rename_all = "kebab-case")]
pub enum TaskOutcome {
    /// The output's manifest is uploaded with all it lists.
    Finished {
        output: Digest,
        /// Final values.
        metrics: BTreeMap<String, f64>,
    },
    /// Stopped between steps, with a checkpoint committed.
    Yielded {
        /// Steps applied.
        at: u64,
    },
    /// It cannot be done, or not now.
    Failed {
        /// Whether trying again may help.
        class: FailureClass,
        /// What happened, for the user.
        message: String,
    },
}

/// What a failure says about trying again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FailureClass {
    /// The user's data or settings: final.
    Input,
    /// The loss or the gradient is not a number any more: final.
    Diverged,
    /// Out of memory: final.
    OutOfMemory,
    /// No space or no permission in the store: final, once freed `resume` goes on.
    Storage,
    /// The store has no whole copy of something that the task reads: what gave it does so again, within the restart budget.
    Damaged,
    /// A panic or another fault of ours: counts against the restart budget.
    Fault,
    /// A lost peer, a network error: counts against the infrastructure budget.
    Infrastructure,
}

/// `POST /v1/runs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Submit {
    /// The validated pipeline as JSON (`protocol::pipeline::Pipeline`).
    pub pipeline: serde_json::Value,
    /// The YAML as written, kept for people.
    pub source: String,
    /// Submitting twice with one key gives one run.
    pub idempotency_key: Option<String>,
    /// Stop after this stage.
    pub until: Option<StageName>,
}

/// A run as clients see it: `GET /v1/runs/{run}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunView {
    /// Which.
    pub run: RunId,
    /// The pipeline's name.
    pub pipeline: String,
    /// Where it stands.
    pub state: RunState,
    /// Stages in topological order, and behind them those that sweeps made.
    pub stages: Vec<StageView>,
    /// Sweeps that have begun.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sweeps: Vec<SweepView>,
}

/// Where a run stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunState {
    /// Work is under way or waits for workers.
    Running,
    /// Held back by the user; work yields.
    Paused,
    /// Every stage asked for is done.
    Finished,
    /// A stage failed for good.
    Failed,
    /// Ended by the user.
    Cancelled,
}

impl RunState {
    /// Whether nothing will happen any more.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Finished | Self::Failed | Self::Cancelled)
    }
}

/// A stage as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageView {
    /// Which.
    pub name: StageName,
    /// Its kind, such as `train.vae`.
    pub kind: String,
    /// Where it stands.
    pub state: StageState,
    /// Its key, once its inputs are known.
    pub key: Option<Digest>,
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values, or the newest while it runs.
    pub metrics: BTreeMap<String, f64>,
    /// How far.
    pub progress: Progress,
    /// Seconds of work so far, over all attempts of this run; not part of any key.
    pub wall_s: f64,
    /// The try.
    pub attempt: Attempt,
    /// Who works on it now.
    pub workers: Vec<WorkerId>,
    /// What the kernels of those dispatch to that computed it, or compute it now; not part of any key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// Why it failed or what it waits for.
    pub message: Option<String>,
    /// The swept stage that it is a part of, if a sweep made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<StageName>,
}

/// A sweep as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SweepView {
    /// The swept stage.
    pub stage: StageName,
    /// How it is searched.
    pub search: SearchKind,
    /// What decides.
    pub metric: String,
    /// Its direction.
    pub mode: Mode,
    /// Steps at which trials are compared; the last is the whole budget.
    pub rungs: Vec<u64>,
    /// Nothing is under way and nothing will be.
    pub over: bool,
    /// Steps trained so far, for this sweep or another before it.
    pub spent: u64,
    /// Steps that it will take if no trial fails.
    pub planned: u64,
    /// Steps of every trial at the whole budget.
    pub full: u64,
    /// The best trial at the whole budget so far.
    pub best: Option<usize>,
    /// All trials, by number.
    pub trials: Vec<TrialView>,
}

/// A trial as clients see it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialView {
    /// Its number, from 0.
    pub trial: usize,
    /// Its values by the settings' paths.
    pub values: Values,
    /// Where it stands.
    pub state: TrialState,
    /// Steps trained.
    pub steps: u64,
    /// The metric after each rung that has a result; `None` is a failure.
    pub results: Vec<Option<f64>>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
}

/// Where a trial stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrialState {
    /// Has not begun.
    Waiting,
    /// A rung is asked for: workers are on it or will be.
    Running,
    /// Done with a rung; whether it goes on is not decided.
    Paused,
    /// Did not go on after a rung.
    Stopped,
    /// Trained for the whole budget.
    Finished,
    /// Failed, and was stopped.
    Failed,
}

/// Where a stage stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StageState {
    /// Waits for other stages.
    Waiting,
    /// Could start; waits for workers.
    Ready,
    /// Workers are on it.
    Running,
    /// Done in this run, from step 0.
    Ran,
    /// Not run: its key was known.
    Cached,
    /// Done in this run, continuing a checkpoint of an earlier attempt.
    Resumed,
    /// Failed for good.
    Failed,
    /// Will not run: an input failed, the run was cancelled, or `--until` ends before it.
    Skipped,
}

/// What every refused call answers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ApiError {
    /// For programs: `stale-fence`, `not-found`, `conflict`, `invalid`, `storage`, `gate`, `internal`.
    pub code: String,
    /// For people.
    pub message: String,
    /// What to do.
    pub hint: Option<String>,
}
