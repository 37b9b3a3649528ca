//! All that the coordinator knows. Changed by facts alone ([`apply`](State::apply)) and, for what need not survive a restart, by
//! `observe`; read by everybody.
//!
//! What is known twice, for speed, follows from the facts as well: who waits and who is held in an execution (`tasks::Tasks`), what a
//! worker holds and which workers hold nothing, which runs use an execution, which stages of a run are active, which executions need
//! workers (`queue::Queue`), which runs are parked or have an idempotency key. Invariant C14.
//!
//! Copies share what neither changes (`shared::Map`): a decision on a copy costs what it changes, however much there is.
//!
//! In memory is what may still matter: runs that have not ended, executions that one of them uses or that somebody works on, workers that
//! were heard of lately. The rest is in the store's tables. Numbers of runs, incarnations and fences come from counters that only grow, so
//! that nothing that was forgotten is mistaken for something new.

mod apply;
pub mod evidence;
pub mod execution;
pub mod gang;
pub mod queue;
pub mod run;
pub mod shared;
pub mod task;
pub mod tasks;
pub mod worker;

use std::collections::HashSet;
use std::sync::Arc;

use protocol::message::{Grant, Progress};
use protocol::{Digest, Fence, Incarnation, RunId, StageName, TaskId, WorkerId};

pub use self::apply::Misfit;
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

/// What is merely heard: lost with the process, and no loss.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    /// When each worker was last heard of.
    pub workers: Map<WorkerId, Millis>,
    /// What was last said about each task that is all of its work.
    pub progress: Map<TaskId, Arc<Progress>>,
    /// What members of gangs have said about their state and about each other. A worker that loses its task loses its word.
    pub words: Arc<Words>,
}

/// All that the coordinator knows. A copy is cheap: it shares what is in the maps.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Times and budgets.
    pub policy: Policy,
    /// Decisions so far, which is the number of the newest.
    pub seq: u64,
    /// The time of the newest decision.
    pub now: Millis,
    /// Runs that were ever submitted.
    pub submitted: u64,
    /// The newest incarnation of any worker.
    pub incarnation: Incarnation,
    /// The newest fence of any task.
    pub fence: Fence,
    /// Workers by name.
    pub workers: Map<WorkerId, Worker>,
    /// Those of them that hold no task.
    pub unused: Set<WorkerId>,
    /// Runs that have not ended, by number, which is the order of submission.
    pub runs: Map<u64, Arc<Run>>,
    /// Executions by the stage's key.
    pub executions: Map<Digest, Arc<StageExecution>>,
    /// Which execution a task is of, and its place there.
    pub tasks: Map<TaskId, (Digest, usize)>,
    /// Executions that running runs wait for, by what they need.
    pub queue: Queue,
    /// By an execution that is made again: those that wait for it.
    pub mends: Map<Digest, Set<Digest>>,
    /// Runs by the client's key.
    pub idempotent: Map<String, u64>,
    /// Runs that a restart has paused.
    pub parked: Set<u64>,
    /// About to stop: no grants, workers save and leave.
    pub draining: bool,
    /// What was merely heard.
    pub heard: Heard,
    /// How many facts decisions have recorded since this process started.
    pub recorded: u64,
    /// Gangs that could take in workers which have nothing to do: what those should prepare for. Made anew by each decision.
    pub open_gangs: Arc<Vec<(Digest, usize)>>,
    /// How many runs, executions and workers decisions have looked at: what they cost, for tests that count it.
    pub visits: u64,
}

impl State {
    /// A coordinator that knows nothing yet.
    pub fn new(policy: Policy) -> Self {
        Self { policy, ..Self::default() }
    }

    /// A run by name, if it has not ended.
    pub fn run(&self, run: &RunId) -> Result<&Arc<Run>, Rejected> {
        run::number_of(run)
            .and_then(|number| self.runs.get(&number))
            .filter(|known| known.id == *run)
            .ok_or_else(|| Rejected::unknown_run(run))
    }

    /// The execution and the task that a grant is about.
    pub fn task(&self, task: &TaskId) -> Result<(&StageExecution, &Task), Rejected> {
        let (key, i) = self.place(task)?;
        let execution = &self.executions[&key];
        Ok((execution, &execution.tasks[i]))
    }

    /// The key of the execution that a task is of, and its place there.
    pub(crate) fn place(&self, task: &TaskId) -> Result<(Digest, usize), Rejected> {
        self.tasks.get(task).copied().ok_or_else(|| Rejected::NotFound(format!("task `{task}` is not known, or over")))
    }

    /// Checks that a write's grant has not been superseded and that its process is not known to be over.
    pub fn check_write(&self, grant: &Grant) -> Result<(), Rejected> {
        let (_, task) = self.task(&grant.task)?;
        task.check_fence(grant)
    }

    /// As [`check_write`](Self::check_write), for what a worker has to say about work that it has just ended: of a task that has left
    /// memory the store alone knows the fence, and checks it.
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
                "worker `{worker}` is another process than incarnation {incarnation}"
            )));
        }
        Ok(known)
    }

    /// The run on whose behalf an execution registers: the one that began it, or the oldest other that waits for it.
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

    /// The keys of executions that a running run waits for, in the order in which they are served: runs as submitted, stages
    /// as in the pipeline. What is made again for one of them comes before it.
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

    /// Whether a running run waits for an execution.
    pub fn is_wanted(&self, execution: &StageExecution) -> bool {
        self.queue.rank(&execution.key).is_some()
    }

    /// What is made again so that an execution can go on, and what for that; what comes first is waited for by what comes later. Mostly
    /// nothing.
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

    /// The execution behind a stage of a run, if it has begun or was done here before.
    pub fn execution_of(&self, run: &Run, stage: &StageName) -> Option<&Arc<StageExecution>> {
        self.executions.get(&run.status(stage)?.key()?)
    }
}
