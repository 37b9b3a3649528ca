//! The coordinator's complete state. Only facts change it ([`apply`](State::apply)), except for data that need not
//! survive a restart, which `observe` changes.
//!
//! Indexes are derived from the facts as well:
//! - waiting and held tasks of an execution (`tasks::Tasks`);
//! - the task that a worker holds, and the workers without a task;
//! - the runs that use an execution, and the active stages of a run;
//! - the executions that need workers (`queue::Queue`);
//! - the runs that are parked or have an idempotency key.
//!
//! Invariant C14 checks them.
//!
//! Copies share unchanged data (`shared::Map`): a decision on a copy costs only its changes, regardless of the size of
//! the state.
//!
//! Memory has only data that may still matter: runs that have not ended, executions that one of them uses or a worker
//! is busy with, and workers that polled lately. The rest is in the store's tables. Numbers of runs, incarnations and
//! fences come from counters that only grow, so that a forgotten object cannot be mistaken for a new one.

mod apply;
pub mod evidence;
pub mod execution;
pub mod gang;
pub mod queue;
mod queueing;
pub mod run;
pub mod shared;
pub mod task;
pub mod tasks;
pub mod worker;

use std::collections::HashSet;
use std::sync::Arc;

use protocol::message::{Grant, Progress};
use protocol::{Digest, Fence, Incarnation, RunId, StageName, TaskId, WorkerId};

pub use self::apply::UnknownObject;
use self::evidence::Words;
use self::execution::{ExecutionState, StageExecution};
use self::queue::Queue;
use self::run::Run;
use self::shared::{Map, Set};
use self::task::Task;
use self::worker::Worker;
use crate::policy::Policy;
use crate::rejected::Rejected;
use crate::time::Millis;

/// Data from polls. It is lost with the process, which does no harm.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    /// Time of each worker's last poll.
    pub workers: Map<WorkerId, Millis>,
    /// The last reported progress of each task that is its execution's only task.
    pub progress: Map<TaskId, Arc<Progress>>,
    /// The highest reported memory of a worker's process by task, in bytes.
    pub memory: Map<TaskId, u64>,
    /// Times since when workers hold no task, while they are divided among groups.
    pub idle: Map<WorkerId, Millis>,
    /// Reports of gang members about their state and about each other. A worker that loses its task also loses its
    /// report.
    pub words: Arc<Words>,
}

/// The coordinator's complete state. A copy is cheap, because it shares the contents of the maps.
#[derive(Debug, Clone, Default)]
pub struct State {
    pub policy: Policy,
    /// The number of decisions so far, which is also the newest decision's number.
    pub seq: u64,
    /// The time of the newest decision.
    pub now: Millis,
    /// The number of runs ever submitted.
    pub submitted: u64,
    /// The newest incarnation of any worker.
    pub incarnation: Incarnation,
    /// The newest fence of any task.
    pub fence: Fence,
    /// Workers by name.
    pub workers: Map<WorkerId, Worker>,
    /// Workers that hold no task.
    pub unused: Set<WorkerId>,
    /// Runs that have not ended, by number, which is the order of submission.
    pub runs: Map<u64, Arc<Run>>,
    /// Executions by the stage's key.
    pub executions: Map<Digest, Arc<StageExecution>>,
    /// The execution of each task, and the task's index in it.
    pub tasks: Map<TaskId, (Digest, usize)>,
    /// Executions that running runs wait for, by their needs.
    pub queue: Queue,
    /// For each recomputed execution, the executions that wait for it.
    pub mends: Map<Digest, Set<Digest>>,
    /// Runs by the client's idempotency key.
    pub idempotent: Map<String, u64>,
    /// Runs that a restart paused.
    pub parked: Set<u64>,
    /// Set before a shutdown: no grants, and workers save and leave.
    pub draining: bool,
    pub heard: Heard,
    /// The number of facts recorded since this process started.
    pub recorded: u64,
    /// Gangs that could admit idle workers, which prepare for them. Rebuilt by each decision.
    pub open_gangs: Arc<Vec<(Digest, usize)>>,
    /// The number of runs, executions and workers inspected by decisions; tests use it to measure cost.
    pub visits: u64,
}

impl State {
    /// Creates an empty state.
    pub fn new(policy: Policy) -> Self {
        Self { policy, ..Self::default() }
    }

    /// A run by id, if it has not ended.
    pub fn run(&self, run: &RunId) -> Result<&Arc<Run>, Rejected> {
        run::number_of(run)
            .and_then(|number| self.runs.get(&number))
            .filter(|known| known.id == *run)
            .ok_or_else(|| Rejected::unknown_run(run))
    }

    /// The task of a grant, with its execution.
    pub fn task(&self, task: &TaskId) -> Result<(&StageExecution, &Task), Rejected> {
        let (key, i) = self.place(task)?;
        let execution = &self.executions[&key];
        Ok((execution, &execution.tasks[i]))
    }

    /// The key of a task's execution, and the task's index in it.
    pub(crate) fn place(&self, task: &TaskId) -> Result<(Digest, usize), Rejected> {
        self.tasks.get(task).copied().ok_or_else(|| Rejected::NotFound(format!("task `{task}` is unknown or over")))
    }

    /// Checks that a write's grant has not been superseded and that its process is not known to have ended.
    pub fn check_write(&self, grant: &Grant) -> Result<(), Rejected> {
        let (_, task) = self.task(&grant.task)?;
        task.check_fence(grant)
    }

    /// Like [`check_write`](Self::check_write), for reports about work that has just ended. If the task has left
    /// memory, only the store knows its fence and checks it.
    pub fn check_telemetry(&self, grant: &Grant) -> Result<(), Rejected> {
        match self.check_write(grant) {
            Err(Rejected::NotFound(_)) => Ok(()),
            checked => checked,
        }
    }

    /// The worker, if `incarnation` is its newest process.
    pub fn process(&self, worker: &WorkerId, incarnation: Incarnation) -> Result<&Worker, Rejected> {
        let known = self
            .workers
            .get(worker)
            .ok_or_else(|| Rejected::NotFound(format!("worker `{worker}` is not known; join first")))?;
        if known.incarnation != incarnation {
            return Err(Rejected::Conflict(format!(
                "incarnation {incarnation} is not the newest process of worker `{worker}`"
            )));
        }
        Ok(known)
    }

    /// The run for which an execution registers: the one that started it, or else the oldest other run that waits for
    /// it.
    pub fn registrant(&self, execution: &StageExecution) -> Option<&Arc<Run>> {
        let users = || execution.users.iter().filter_map(|(number, _)| self.runs.get(number));
        users().find(|run| run.id == execution.run).or_else(|| users().next())
    }

    /// The task that a worker holds.
    pub fn held_by(&self, worker: &WorkerId) -> Option<(&StageExecution, &Task)> {
        let (key, i) = self.workers.get(worker)?.holds?;
        let execution = &self.executions[&key];
        Some((execution, &execution.tasks[i]))
    }

    /// The keys of executions that a running run waits for, in the order of service: by submission of the run, then by
    /// stage. Recomputed inputs precede their readers.
    pub fn wanted(&self) -> Vec<Digest> {
        let mut seen = HashSet::new();
        let active = self.runs.values().flat_map(|run| run.active());
        let mut wanted = Vec::new();
        for (_, key) in active {
            if !seen.contains(&key) {
                wanted.extend(self.mended_for(key).into_iter().filter(|input| seen.insert(*input)));
                wanted.push(key);
                seen.insert(key);
            }
        }
        wanted
    }

    /// Returns true if a running run waits for an execution.
    pub fn is_wanted(&self, execution: &StageExecution) -> bool {
        self.queue.rank(&execution.key).is_some()
    }

    /// Executions recomputed so that `key` can continue, dependencies first. Usually empty.
    pub(crate) fn mended_for(&self, key: Digest) -> Vec<Digest> {
        let mut all = Vec::new();
        if let Some(ExecutionState::Mending { inputs }) = self.executions.get(&key).map(|execution| &execution.state) {
            for input in inputs {
                all.extend(self.mended_for(*input));
                all.push(*input);
            }
        }
        all
    }

    /// The execution of a stage of a run, if it has started or its value was already known here.
    pub fn execution_of(&self, run: &Run, stage: &StageName) -> Option<&Arc<StageExecution>> {
        self.executions.get(&run.status(stage)?.key()?)
    }
}
