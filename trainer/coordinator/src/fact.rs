//! What became of an event: the only thing that is kept, and the only thing that changes the state.
//!
//! A fact says how something is from now on, never why and never by which rule. [`apply`](crate::state::State::apply) puts it into the
//! state and reads neither policy nor clock, so what was once decided stands, whatever a later build would decide in its place.
//!
//! Facts are stored as JSON, one row for all of one decision ([`Decision`](crate::journal::Decision)). A field may be added if it has a
//! serde default that means "as before"; a kind may be added; both raise the minor version of [`FORMAT`](crate::journal::FORMAT).
//! Anything else raises the major one, which older builds refuse.

use std::collections::BTreeMap;

use protocol::message::{ReportOutcome, RunState};
use protocol::pipeline::PipelineStage;
use protocol::stage::Placement;
use protocol::{Attempt, Digest, Fence, RunId, StageName, WorkerId};
use serde::{Deserialize, Serialize};

use crate::search::Progress;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::{Run, Status, Sweeping};
use crate::state::task::{Lease, Saved, Task};
use crate::state::worker::Worker;
use crate::time::Millis;

/// How something is from now on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fact {
    /// A run is known: it was submitted, or it had ended and is taken up again.
    Run {
        /// All of it.
        run: Box<Run>,
    },
    /// Where a run stands.
    RunState {
        /// Its number.
        run: u64,
        /// Where.
        state: RunState,
        /// Whether a restart paused it.
        parked: bool,
    },
    /// Where stages of a run stand.
    Stages {
        /// Its number.
        run: u64,
        /// By place.
        stages: Vec<(usize, Status)>,
    },
    /// A worker digested the files that a stage reads outside the store.
    Resolved {
        /// The run's number.
        run: u64,
        /// The stage's place.
        stage: usize,
        /// By field; empty for what is to be found again.
        digests: BTreeMap<String, Digest>,
    },
    /// A sweep made stages, behind those that there are; they wait.
    StagesAdded {
        /// The run's number.
        run: u64,
        stages: Vec<PipelineStage>,
    },
    /// A sweep began.
    SweepBegun {
        /// The run's number.
        run: u64,
        /// All of it.
        sweep: Box<Sweeping>,
    },
    /// A sweep went on.
    SweepMoved {
        /// The run's number.
        run: u64,
        /// The place of the swept stage.
        stage: usize,
        /// What became of its searcher.
        progress: Progress,
        /// Places of the stages of tickets, behind those that are known.
        places: Vec<Option<usize>>,
        /// Why trials failed, by trial; those that are new.
        failures: Vec<(usize, String)>,
    },
    /// A run ended and is in the tables; memory needs it no more.
    RunForgotten {
        /// Its number.
        run: u64,
    },
    /// A stage's value is wanted for the first time since it was last forgotten.
    Execution {
        /// All of it.
        execution: Box<StageExecution>,
    },
    /// How far an execution is.
    ExecutionState {
        key: Digest,
        /// How far.
        state: ExecutionState,
    },
    /// How many workers and how many checkpoints the run that wants it now asks for.
    ExecutionPlacement {
        key: Digest,
        /// What is asked for.
        placement: Placement,
    },
    /// Under whose names its logs and values are, and its tasks if there will be any.
    ExecutionSource { key: Digest, run: RunId, stage: StageName },
    /// Its seconds of work.
    ExecutionTime {
        key: Digest,
        /// Milliseconds up to `busy_since`.
        wall_ms: u64,
        /// Since when somebody works on it.
        busy_since: Option<Millis>,
    },
    /// It goes on from something that an earlier try has saved.
    ExecutionResumed { key: Digest },
    /// The instruction set of all that work on it.
    ExecutionInstructions {
        key: Digest,
        /// What their kernels dispatch to.
        instruction_set: String,
    },
    /// It has tasks: new ones, or those that an earlier try left.
    Tasks { key: Digest, tasks: Vec<Task> },
    /// How a task is.
    Task {
        /// The key of its execution.
        key: Digest,
        /// Its place there.
        task: usize,
        /// What is new.
        change: Box<TaskChange>,
    },
    /// Nobody waits for an execution or works on it; what there is of it is in the tables.
    ExecutionForgotten { key: Digest },
    /// A worker process joined, or whether it can be given work is another matter now.
    Worker {
        /// Who.
        worker: WorkerId,
        /// How it is.
        process: Worker,
    },
    /// A worker has been away for so long that its name is nothing to remember.
    WorkerForgotten {
        /// Who.
        worker: WorkerId,
    },
    /// Whether the coordinator is about to stop.
    Draining {
        /// Whether.
        draining: bool,
    },
}

/// What is new about a task; what is not mentioned is as before.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TaskChange {
    /// Who has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub now: Option<Lease>,
    /// The newest try.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attempt: Option<Attempt>,
    /// The newest fence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fence: Option<Fence>,
    /// Faults, losses, and failures in a row.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub counts: Option<(u32, u32, u32)>,
    /// Workers without enough memory for it, all of them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub too_small: Option<Vec<WorkerId>>,
    /// Steps whose checkpoints are not kept.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub dropped: Vec<u64>,
    /// Checkpoints that came, behind those that stay.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub saved: Vec<Saved>,
    /// The report that was last accepted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reported: Option<ReportOutcome>,
}

impl TaskChange {
    /// What `after` has that `before` had not.
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
            dropped: gone.map(|saved| saved.step).collect(),
            saved: come.cloned().collect(),
            reported: if before.reported == after.reported { None } else { after.reported.clone() },
        }
    }

    /// Whether nothing is new.
    pub fn is_nothing(&self) -> bool {
        *self == Self::default()
    }

    /// Makes `task` what it is from now on.
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
        task.checkpoints.retain(|saved| !self.dropped.contains(&saved.step));
        task.checkpoints.extend(self.saved.iter().cloned());
        if let Some(reported) = &self.reported {
            task.reported = Some(reported.clone());
        }
    }
}
