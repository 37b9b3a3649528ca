//! Messages between workers, the coordinator and its clients: JSON over HTTP.
//!
//! Workers pull. `poll` is both heartbeat and request for work: a worker reports its work, and the coordinator answers
//! with the full set of assignments that the worker should have. The worker then starts and stops work to match it. A
//! lost answer does no harm, because the next one has the same content.
//!
//! Every write carries a [`Grant`]. The coordinator checks its fence in the transaction that stores the write. It
//! answers 409 with the code `stale-fence` to an old one.
//!
//! Names and grants are not secret. [`proof`](crate::proof) says how a call proves whose it is.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Backend, CheckpointPolicy, Mode, StageSettings};
use crate::sweep::{SearchKind, Values};
use crate::{Attempt, Digest, Fence, Generation, Incarnation, Labels, Owner, RunId, Seed, StageName, TaskId, WorkerId};

/// Version of these messages; a worker with another version is refused.
pub const PROTOCOL_VERSION: u32 = 6;

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

/// `POST /v1/runs`: submits a pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
    /// The storage problem that blocks the run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub storage: Option<StorageProblem>,
    #[serde(default, skip_serializing_if = "Times::are_unknown")]
    pub times: Times,
    /// Its standing in a sentence: the reason of a failure or of waiting, or the result.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
}

/// A part of a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Listing<T> {
    pub items: Vec<T>,
    /// The `after` that continues the list; missing at its end. A search may return few items and still continue.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}

/// A run in a list: `GET /v1/runs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunSummary {
    pub run: RunId,
    /// The pipeline's name.
    pub pipeline: String,
    /// Name of the token that submitted it, if it is known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub owner: String,
    /// The token's project.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub project: Option<String>,
    pub state: RunState,
    /// It is paused because the process that worked on it ended, not because a user paused it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub interrupted: bool,
    /// Time of the submission, in milliseconds since 1970.
    pub created_ms: i64,
    /// Time of the newest change of its state, in milliseconds since 1970.
    pub changed_ms: i64,
    /// Number of finished stages.
    pub done: u32,
    /// Number of stages that were asked for, without those of sweeps.
    pub stages: u32,
    /// Seconds of work on these stages.
    pub wall_s: f64,
    /// Idle workers that it lacks, if that is what it waits for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wants_workers: Option<usize>,
    /// The beginning of [`RunView::note`].
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
}

impl RunSummary {
    /// Largest size of a summary as JSON in bytes, unless its names alone are longer.
    pub const BYTES: usize = 300;

    /// Summarises a view. Its times are those of the view, or 0.
    pub fn of(view: &RunView) -> Self {
        let main = || view.stages.iter().filter(|stage| stage.of.is_none() && stage.is_asked_for());
        let count = |stages: usize| u32::try_from(stages).unwrap_or(u32::MAX);
        let created_ms = view.times.created_ms.unwrap_or_default();
        Self {
            run: view.run.clone(),
            pipeline: view.pipeline.clone(),
            owner: view.owner.name.clone(),
            project: view.owner.project.clone(),
            state: view.state,
            interrupted: view.interrupted,
            created_ms,
            changed_ms: view.times.ended_ms.unwrap_or(created_ms),
            done: count(main().filter(|stage| stage.state.is_done()).count()),
            stages: count(main().count()),
            wall_s: main().map(|stage| stage.wall_s).sum(),
            wants_workers: main().find_map(|stage| stage.wants_workers),
            note: view.note.clone(),
        }
    }

    /// Shortens the note so that the summary as JSON has at most [`Self::BYTES`] bytes.
    #[must_use]
    pub fn shortened(mut self) -> Self {
        self.wall_s = (self.wall_s * 10.0).round() / 10.0;
        let note = std::mem::take(&mut self.note);
        // Ten bytes: the note's name, quotes and comma.
        let mut left = Self::BYTES.saturating_sub(json_length(&self) + 10);
        if json_length(&note) - 2 <= left {
            self.note = note;
            return self;
        }
        left = left.saturating_sub('…'.len_utf8());
        for letter in note.chars() {
            let bytes = json_length(&letter) - 2;
            if bytes > left {
                break;
            }
            left -= bytes;
            self.note.push(letter);
        }
        if !self.note.is_empty() {
            self.note.push('…');
        }
        self
    }
}

fn json_length(value: &impl Serialize) -> usize {
    serde_json::to_vec(value).map_or(0, |text| text.len())
}

/// Why a store does not take or give what it should.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct StorageProblem {
    /// Since when, in milliseconds since 1970.
    pub since_ms: i64,
    /// Description of the problem.
    pub what: String,
}

/// State of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
    const ALL: [(Self, &str); 5] = [
        (Self::Running, "running"),
        (Self::Paused, "paused"),
        (Self::Finished, "finished"),
        (Self::Failed, "failed"),
        (Self::Cancelled, "cancelled"),
    ];

    /// Its name in JSON and in tables.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(state, _)| *state == self).map_or("", |(_, name)| name)
    }

    /// The state of a name.
    pub fn named(text: &str) -> Option<Self> {
        Self::ALL.iter().find(|(_, name)| *name == text).map(|(state, _)| *state)
    }

    /// Returns true if the state cannot change any more.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Finished | Self::Failed | Self::Cancelled)
    }
}

/// Times of a run or a stage by the server's clock, in milliseconds since 1970.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
    #[schemars(with = "BTreeMap<String, Option<f64>>")]
    pub metrics: BTreeMap<String, f64>,
    pub progress: Progress,
    /// Seconds of work so far, over all attempts of this run; not part of any key.
    pub wall_s: f64,
    /// Peak resident memory of one of its workers' processes during its newest attempt, in bytes; not part of any key.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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

impl StageState {
    /// Returns true if the stage has its value.
    pub fn is_done(self) -> bool {
        matches!(self, Self::Ran | Self::Cached | Self::Resumed)
    }
}

/// The reason for a refusal, as clients read it. The server sends it as [`Problem`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ApiError {
    /// Code for programs, one of [`CODES`].
    pub code: String,
    /// Description for users.
    #[serde(alias = "detail")]
    pub message: String,
    /// Remedy, if there is one.
    pub hint: Option<String>,
}

/// Answer to every refused call: problem details (RFC 9457) with our code and hint, sent as [`Problem::CONTENT_TYPE`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Problem {
    /// Kind of the problem as a URI: `urn:stride:problem:` and the code.
    #[serde(rename = "type")]
    pub kind: String,
    /// The kind in words, the same for each problem of the kind.
    pub title: String,
    /// The answer's HTTP status.
    pub status: u16,
    /// Description for users.
    pub detail: String,
    /// Code for programs, one of [`CODES`].
    pub code: String,
    /// Remedy, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
}

impl Problem {
    /// The media type of problems.
    pub const CONTENT_TYPE: &str = "application/problem+json";

    /// The problem of a call that is answered with `status`.
    pub fn new(status: u16, error: ApiError) -> Self {
        let ApiError { code, message: detail, hint } = error;
        let title = CODES.iter().find(|(known, _)| *known == code).map_or("Refused", |(_, title)| *title);
        Self { kind: format!("urn:stride:problem:{code}"), title: title.to_owned(), status, detail, code, hint }
    }
}

/// Codes of refusals with their titles.
pub const CODES: [(&str, &str); 26] = [
    ("arrived-damaged", "The blob was damaged on its way"),
    ("busy", "The server has too much to do"),
    ("conflict", "The request conflicts with the current state"),
    ("cut", "The request ended early"),
    ("damaged", "The stored data is damaged"),
    ("failed", "The server has failed"),
    ("forbidden", "The token does not allow this"),
    ("gate", "A gate does not hold"),
    ("host", "The server has another name"),
    ("internal", "The server made a mistake"),
    ("invalid", "The request is invalid"),
    ("method", "The path has no such method"),
    ("name-held", "Another process holds the name"),
    ("not-found", "There is no such object"),
    ("offset", "The part does not follow the stored ones"),
    ("origin", "Pages of other sites may not call this server"),
    ("slow", "The request came too slowly"),
    ("stale-fence", "The grant has been superseded"),
    ("storage", "The store does not take data"),
    ("tls", "The server speaks TLS"),
    ("too-large", "The data is too large"),
    ("unauthorized", "The call shows no valid token"),
    ("unproven", "The data is not proven complete"),
    ("unreachable", "The blob storage does not answer"),
    ("unvouched", "The call does not prove its upload"),
    ("used-up", "The run has used up its limit"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_fits_whatever_its_note_says() {
        let note =
            ["short", &"loss is NaN ".repeat(100), &"\"\\\u{1}".repeat(200), &"ö…😀".repeat(200)].map(str::to_owned);
        for note in note {
            let summary = RunSummary {
                run: "quickstart-0a1b2c3d-100000".into(),
                pipeline: "quickstart".into(),
                owner: "alice".into(),
                project: Some("motion".into()),
                state: RunState::Cancelled,
                interrupted: true,
                created_ms: 1_764_054_273_000,
                changed_ms: 1_764_054_273_000,
                done: 12,
                stages: 12,
                wall_s: 1.0 / 3.0,
                wants_workers: Some(2),
                note: note.clone(),
            };
            let shortened = summary.shortened();
            assert!(json_length(&shortened) <= RunSummary::BYTES, "{shortened:?}");
            assert!(note.starts_with(shortened.note.trim_end_matches('…')) && !shortened.note.is_empty());
        }
    }

    #[test]
    fn a_problem_reads_as_the_error_that_it_tells() {
        let error = ApiError { code: "busy".into(), message: "too much".into(), hint: Some("wait".into()) };
        let problem = serde_json::to_value(Problem::new(429, error.clone())).unwrap_or_default();
        assert_eq!(problem["title"], "The server has too much to do");
        assert_eq!(problem["type"], "urn:stride:problem:busy");
        assert_eq!(serde_json::from_value::<ApiError>(problem).ok(), Some(error.clone()));
        let plain = serde_json::to_value(&error).unwrap_or_default();
        assert_eq!(serde_json::from_value::<ApiError>(plain).ok(), Some(error));
        assert!(CODES.is_sorted(), "{CODES:?}");
    }
}
