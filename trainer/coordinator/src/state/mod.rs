//! All that the coordinator knows. Changed by `decide` and, for what need not survive a restart, by `observe`; read by
//! everybody.

pub mod gang;
pub mod run;
pub mod task;
pub mod work;
pub mod worker;

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::message::{Grant, Progress};
use protocol::{Digest, Incarnation, RunId, StageName, TaskId, WorkerId};

use self::run::Run;
use self::task::Task;
use self::work::Work;
use self::worker::Worker;
use crate::event::{Millis, Rejected};
use crate::policy::Policy;

/// What is merely heard: lost with the process, and no loss.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    /// When each worker was last heard of.
    pub workers: BTreeMap<WorkerId, Millis>,
    /// What was last said about each task, with the fence under which it was said.
    pub progress: BTreeMap<TaskId, Progress>,
    /// When the clock was last looked at.
    pub ticked: Option<Millis>,
}

/// All that the coordinator knows. Runs and works are shared between copies until one changes them, so a copy is cheap.
#[derive(Debug, Clone, Default)]
pub struct State {
    /// Times and budgets.
    pub policy: Policy,
    /// The time of the newest event.
    pub now: Millis,
    /// Workers by name.
    pub workers: BTreeMap<WorkerId, Worker>,
    /// Runs in the order of submission; the first has number 1.
    pub runs: Vec<Arc<Run>>,
    /// Works by the stage's key.
    pub works: BTreeMap<Digest, Arc<Work>>,
    /// Which work a task is of.
    pub tasks: BTreeMap<TaskId, Digest>,
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
    pub fn task(&self, task: &TaskId) -> Result<(&Work, &Task), Rejected> {
        self.tasks
            .get(task)
            .and_then(|key| self.works.get(key))
            .and_then(|work| Some((&**work, &work.tasks[work.position(task)?])))
            .ok_or_else(|| Rejected::NotFound(format!("task `{task}` is not known")))
    }

    /// Checks that a write's grant has not been superseded and that its process is not known to be over.
    pub fn check_write(&self, grant: &Grant) -> Result<(), Rejected> {
        let (_, task) = self.task(&grant.task)?;
        task.check_fence(grant)
    }

    /// Changes a work; other copies of the state keep theirs.
    pub(crate) fn work_mut(&mut self, key: Digest) -> &mut Work {
        Arc::make_mut(self.works.get_mut(&key).expect("works are never forgotten"))
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

    /// The tasks that a worker holds; at most one.
    pub fn held_by<'a>(&'a self, worker: &'a WorkerId) -> impl Iterator<Item = (&'a Work, &'a Task)> + 'a {
        self.works.values().flat_map(move |work| {
            work.tasks
                .iter()
                .filter(move |task| task.holders().iter().any(|member| member.worker == *worker))
                .map(move |task| (&**work, task))
        })
    }

    /// The keys of works that a running run waits for, in the order in which they are served: runs as submitted, stages
    /// as in the pipeline.
    pub fn wanted(&self) -> Vec<Digest> {
        let mut keys = Vec::new();
        for (_, key) in self.runs.iter().flat_map(|run| run.active()) {
            if !keys.contains(&key) {
                keys.push(key);
            }
        }
        keys
    }

    /// The work behind a stage of a run, if it has begun or was done here before.
    pub fn work_of(&self, run: &Run, stage: &StageName) -> Option<&Arc<Work>> {
        self.works.get(&run.status(stage)?.key()?)
    }
}
