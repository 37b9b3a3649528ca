//! All that the coordinator knows. Changed by `decide` and, for what need not survive a restart, by `observe`; read by
//! everybody.

pub mod execution;
pub mod gang;
pub mod run;
pub mod task;
pub mod tasks;
pub mod worker;

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;

use protocol::message::{Grant, Progress};
use protocol::{Digest, Incarnation, RunId, StageName, TaskId, WorkerId};

use self::execution::StageExecution;
use self::run::Run;
use self::task::Task;
use self::worker::Worker;
use crate::event::{Millis, Rejected};
use crate::policy::Policy;

/// What is merely heard: lost with the process, and no loss.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    /// When each worker was last heard of.
    pub workers: Arc<BTreeMap<WorkerId, Millis>>,
    /// What was last said about each task that is all of its work.
    pub progress: Arc<BTreeMap<TaskId, Arc<Progress>>>,
    /// When the clock was last looked at.
    pub ticked: Option<Millis>,
}

/// All that the coordinator knows. What may be large is shared between copies until one changes it, so a copy is cheap.
///
/// A task is changed by `State::change` alone, which keeps what is known twice, for speed, in step: who waits and who is
/// held in a work (`tasks::Tasks`), what a worker holds, and which workers hold nothing.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Times and budgets.
    pub policy: Policy,
    /// The time of the newest event.
    pub now: Millis,
    /// Workers by name.
    pub workers: Arc<BTreeMap<WorkerId, Worker>>,
    /// Those of them that hold no task.
    pub unused: Arc<BTreeSet<WorkerId>>,
    /// Runs in the order of submission; the first has number 1.
    pub runs: Vec<Arc<Run>>,
    /// Works by the stage's key.
    pub executions: BTreeMap<Digest, Arc<StageExecution>>,
    /// Which work a task is of, and its place there.
    pub tasks: Arc<BTreeMap<TaskId, (Digest, usize)>>,
    /// About to stop: no grants, workers save and leave.
    pub draining: bool,
    /// What was merely heard.
    pub heard: Heard,
}

impl State {
    /// A coordinator that knows nothing yet.
    pub fn new(policy: Policy) -> Self {
        Self { policy, ..Self::default() }
    }

    /// A run by name.
    pub fn run(&self, run: &RunId) -> Result<&Arc<Run>, Rejected> {
        self.runs
            .iter()
            .find(|r| r.id == *run)
            .ok_or_else(|| Rejected::NotFound(format!("run `{run}` is not known; `trainer status` lists runs")))
    }

    /// The work and the task that a grant is about.
    pub fn task(&self, task: &TaskId) -> Result<(&StageExecution, &Task), Rejected> {
        let (key, i) = self.place(task)?;
        let execution = &self.executions[&key];
        Ok((execution, &execution.tasks[i]))
    }

    /// The key of the work that a task is of, and its place there.
    pub(crate) fn place(&self, task: &TaskId) -> Result<(Digest, usize), Rejected> {
        self.tasks.get(task).copied().ok_or_else(|| Rejected::NotFound(format!("task `{task}` is not known")))
    }

    /// Checks that a write's grant has not been superseded and that its process is not known to be over.
    pub fn check_write(&self, grant: &Grant) -> Result<(), Rejected> {
        let (_, task) = self.task(&grant.task)?;
        task.check_fence(grant)
    }

    /// Changes a work; other copies of the state keep theirs.
    pub(crate) fn execution_mut(&mut self, key: Digest) -> &mut StageExecution {
        Arc::make_mut(self.executions.get_mut(&key).expect("executions are never forgotten"))
    }

    /// Changes a task; the only way to.
    pub(crate) fn change<T>(&mut self, key: Digest, i: usize, change: impl FnOnce(&mut Task) -> T) -> T {
        let execution = Arc::make_mut(self.executions.get_mut(&key).expect("executions are never forgotten"));
        let before = execution.tasks[i].holders().to_vec();
        let made = execution.tasks.change(i, change);
        let after = execution.tasks[i].holders();
        if before != after {
            let (workers, unused) = (Arc::make_mut(&mut self.workers), Arc::make_mut(&mut self.unused));
            let mut set = |name: &WorkerId, holds| {
                // Whoever holds something has joined, and nobody is forgotten.
                workers.get_mut(name).expect("holders are known").holds = holds;
                if holds.is_none() {
                    unused.insert(name.clone())
                } else {
                    unused.remove(name)
                };
            };
            before.iter().for_each(|member| set(&member.worker, None));
            after.iter().for_each(|member| set(&member.worker, Some((key, i))));
        }
        made
    }

    /// The worker, if `incarnation` is its newest process.
    pub fn process(&self, worker: &WorkerId, incarnation: Incarnation) -> Result<&Worker, Rejected> {
        let known = self
            .workers
            .get(worker)
            .ok_or_else(|| Rejected::NotFound(format!("worker `{worker}` is not known; join first")))?;
        if known.incarnation != incarnation {
            return Err(Rejected::Conflict(format!(
                "worker `{worker}` is now another process (incarnation {}, the call is from {incarnation})",
                known.incarnation
            )));
        }
        Ok(known)
    }

    /// The task that a worker holds.
    pub fn held_by(&self, worker: &WorkerId) -> Option<(&StageExecution, &Task)> {
        let (key, i) = self.workers.get(worker)?.holds?;
        let execution = &self.executions[&key];
        Some((execution, &execution.tasks[i]))
    }

    /// The keys of works that a running run waits for, in the order in which they are served: runs as submitted, stages
    /// as in the pipeline.
    pub fn wanted(&self) -> Vec<Digest> {
        let mut seen = HashSet::new();
        let active = self.runs.iter().flat_map(|run| run.active());
        active.map(|(_, key)| key).filter(|key| seen.insert(*key)).collect()
    }

    /// The work behind a stage of a run, if it has begun or was done here before.
    pub fn execution_of(&self, run: &Run, stage: &StageName) -> Option<&Arc<StageExecution>> {
        self.executions.get(&run.status(stage)?.key()?)
    }
}
