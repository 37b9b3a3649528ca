//! Outcomes of decisions. Facts are the only data stored and the only way to change the state.
//!
//! A fact describes the new condition of something, without a reason or a rule. [`apply`](crate::state::State::apply)
//! puts it into the state and reads neither policy nor clock. A stored decision therefore holds, even if a later build
//! would decide otherwise.
//!
//! Facts are stored as JSON, one row for all facts of a decision ([`Decision`](crate::journal::Decision)). New kinds,
//! and new fields with a serde default that means "unchanged", raise the minor version of
//! [`FORMAT`](crate::journal::FORMAT). All other changes raise the major version, which older builds refuse.

use std::collections::BTreeMap;

use pipeline::PipelineStage;
use protocol::message::{ReportOutcome, RunState};
use protocol::stage::Placement;
use protocol::{Attempt, Digest, Fence, RunId, StageName, WorkerId};
use serde::{Deserialize, Serialize};

use crate::search::Progress;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::{Run, Status, Sweeping};
use crate::state::task::{Lease, Saved, Task};
use crate::state::worker::Worker;
use crate::time::Millis;

/// A change of the state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fact {
    /// A run was submitted, or an ended run was resumed.
    Run { run: Box<Run> },
    /// The state of a run changed.
    RunState {
        run: u64,
        state: RunState,
        /// Set if a restart paused the run.
        parked: bool,
    },
    /// A run waits until fewer runs of its group are at work, or no longer does.
    RunQueued { run: u64, queued: bool },
    /// The status of some stages of a run changed.
    Stages {
        run: u64,
        /// The new status by stage index.
        stages: Vec<(usize, Status)>,
    },
    /// A worker digested the files that a stage reads outside the store.
    Resolved {
        run: u64,
        /// The stage's index.
        stage: usize,
        /// Digests by field; empty if they must be computed again.
        digests: BTreeMap<String, Digest>,
    },
    /// A sweep appended stages to the pipeline; they start as waiting.
    StagesAdded { run: u64, stages: Vec<PipelineStage> },
    /// A sweep started.
    SweepBegun { run: u64, sweep: Box<Sweeping> },
    /// A sweep advanced.
    SweepMoved {
        run: u64,
        /// The index of the swept stage.
        stage: usize,
        /// The new progress of its searcher.
        progress: Progress,
        /// Stage indexes of new tickets, appended to the known ones.
        places: Vec<Option<usize>>,
        /// Reasons of newly failed trials, by trial.
        failures: Vec<(usize, String)>,
    },
    /// A run that has ended and is in the tables leaves memory.
    RunForgotten { run: u64 },
    /// A stage's value is needed for the first time since its execution was last forgotten.
    Execution { execution: Box<StageExecution> },
    /// The state of an execution changed.
    ExecutionState { key: Digest, state: ExecutionState },
    /// The number of workers or of kept checkpoints changed, because another run needs the execution now.
    ExecutionPlacement { key: Digest, placement: Placement },
    /// The run and stage under which the execution's logs, metrics and tasks are stored.
    ExecutionSource { key: Digest, run: RunId, stage: StageName },
    /// The accounted working time of an execution changed.
    ExecutionTime {
        key: Digest,
        /// Milliseconds of work before `busy_since`.
        wall_ms: u64,
        /// Start of the current period of work, if a worker is busy with it.
        busy_since: Option<Millis>,
        /// Start of the current period without work.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        idle_since: Option<Millis>,
    },
    /// The execution continues from data that an earlier try saved.
    ExecutionResumed { key: Digest },
    /// The instruction set that all workers of an execution share.
    ExecutionInstructions {
        key: Digest,
        /// The instruction set that their kernels use.
        instruction_set: String,
    },
    /// An execution has tasks: new ones, or those of an earlier try.
    Tasks { key: Digest, tasks: Vec<Task> },
    /// A task changed.
    Task {
        /// The key of its execution.
        key: Digest,
        /// The task's index in the execution.
        task: usize,
        change: Box<TaskChange>,
    },
    /// An execution that no run waits for and no worker holds leaves memory; its data is in the tables.
    ExecutionForgotten { key: Digest },
    /// A worker process joined, or its availability for work changed.
    Worker { worker: WorkerId, process: Worker },
    /// A worker has been away so long that its name is forgotten.
    WorkerForgotten { worker: WorkerId },
    /// The coordinator starts or stops draining before a shutdown.
    Draining { draining: bool },
}

/// Changed fields of a task; absent fields are unchanged.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TaskChange {
    /// The new lease.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub now: Option<Lease>,
    /// The number of the newest attempt.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attempt: Option<Attempt>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fence: Option<Fence>,
    /// Number of faults, of losses, and of consecutive failures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub counts: Option<(u32, u32, u32)>,
    /// The complete list of workers without enough memory for the task.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub too_small: Option<Vec<WorkerId>>,
    /// The complete list of workers whose attempts failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failed_on: Option<Vec<WorkerId>>,
    /// Steps whose checkpoints were deleted.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub dropped: Vec<u64>,
    /// New checkpoints, appended to the remaining ones.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub saved: Vec<Saved>,
    /// The last accepted report.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reported: Option<ReportOutcome>,
}

impl TaskChange {
    /// The difference from `before` to `after`.
    pub fn between(before: &Task, after: &Task) -> Self {
        fn new<T: PartialEq + Clone>(before: &T, after: &T) -> Option<T> {
            (before != after).then(|| after.clone())
        }
        let counts = |task: &Task| (task.faults, task.losses, task.streak);
        let gone = before.checkpoints.iter().filter(|saved| !after.checkpoints.contains(saved));
        let come = after.checkpoints.iter().filter(|saved| !before.checkpoints.contains(saved));
        Self {
            now: new(&before.lease, &after.lease),
            attempt: new(&before.attempt, &after.attempt),
            fence: new(&before.fence, &after.fence),
            counts: new(&counts(before), &counts(after)),
            too_small: new(&before.too_small, &after.too_small),
            failed_on: new(&before.failed_on, &after.failed_on),
            dropped: gone.map(|saved| saved.step).collect(),
            saved: come.cloned().collect(),
            reported: if before.reported == after.reported { None } else { after.reported.clone() },
        }
    }

    /// Returns true if no field changed.
    pub fn is_nothing(&self) -> bool {
        *self == Self::default()
    }

    /// Applies the change to `task`.
    pub fn apply(&self, task: &mut Task) {
        if let Some(lease) = &self.now {
            task.lease = lease.clone();
        }
        task.attempt = self.attempt.unwrap_or(task.attempt);
        task.fence = self.fence.unwrap_or(task.fence);
        (task.faults, task.losses, task.streak) = self.counts.unwrap_or((task.faults, task.losses, task.streak));
        if let Some(too_small) = &self.too_small {
            task.too_small.clone_from(too_small);
        }
        if let Some(failed_on) = &self.failed_on {
            task.failed_on.clone_from(failed_on);
        }
        task.checkpoints.retain(|saved| !self.dropped.contains(&saved.step));
        task.checkpoints.extend(self.saved.iter().cloned());
        if let Some(reported) = &self.reported {
            task.reported = Some(reported.clone());
        }
    }
}
