//! Questions to the state: its runs, tasks and workers by name, and what they wait for.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::message::Grant;
use protocol::{Digest, Incarnation, RunId, StageName, TaskId, WorkerId};

use super::State;
use super::execution::{ExecutionState, StageExecution};
use super::queue::Rank;
use super::run::{self, Run};
use super::task::Task;
use super::worker::Worker;
use crate::policy::Policy;
use crate::rejected::Rejected;

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

    /// The keys of executions that a running run waits for, in the order of service within each group: by priority, by
    /// submission of the run, then by stage. Recomputed inputs precede their readers.
    pub fn wanted(&self) -> Vec<Digest> {
        let mut ranks: BTreeMap<Digest, Vec<Rank>> = BTreeMap::new();
        for (number, run) in &self.runs {
            for (stage, key) in run.active() {
                let rank = self.rank(*number, stage);
                ranks.entry(key).or_default().push(rank);
                for (mended, input) in self.mended_for(key).into_iter().enumerate() {
                    ranks.entry(input).or_default().push(Rank { mended, ..rank });
                }
            }
        }
        let mut wanted: Vec<(Rank, Digest)> =
            ranks.into_iter().filter_map(|(key, ranks)| Some((self.first_of(&ranks)?, key))).collect();
        wanted.sort_unstable();
        wanted.into_iter().map(|(_, key)| key).collect()
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
