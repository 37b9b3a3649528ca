//! Facts put into the state. Total and without rules: nothing here asks whether a fact is wise, only whether what it is about is there.

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{Digest, WorkerId};

use super::State;
use super::execution::StageExecution;
use super::run::{Run, Status};
use super::task::Task;
use crate::fact::Fact;

/// A fact about something that is not there.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a fact is about {0}, which is not known")]
pub struct Misfit(String);

type Result<T = ()> = std::result::Result<T, Misfit>;

impl State {
    /// Makes the state what `fact` says. An error changes nothing.
    pub fn apply(&mut self, fact: &Fact) -> Result {
        match fact {
            Fact::Run { run } => {
                self.submitted = self.submitted.max(run.number);
                let run = Arc::new(Run::clone(run));
                run.stages.iter().for_each(|status| self.use_execution(run.number, status, true));
                self.runs.insert(run.number, run);
            }
            Fact::RunState { run, state, parked } => {
                let run = self.run_mut(*run)?;
                (run.state, run.parked) = (*state, *parked);
            }
            Fact::Stages { run: number, stages } => {
                let run = self.run_mut(*number)?;
                if let Some((i, _)) = stages.iter().find(|(i, _)| *i >= run.stages.len()) {
                    return Err(Misfit(format!("stage {i} of run {number}")));
                }
                let before: Vec<Status> = stages.iter().map(|(i, _)| run.stages[*i].clone()).collect();
                stages.iter().for_each(|(i, status)| run.set(*i, status.clone()));
                stages.iter().for_each(|(_, status)| self.use_execution(*number, status, true));
                before.iter().for_each(|status| self.use_execution(*number, status, false));
            }
            Fact::Resolved { run, stage, digests } => {
                let run = self.run_mut(*run)?;
                match digests.is_empty() {
                    true => drop(run.resolved.remove(stage)),
                    false => drop(run.resolved.insert(*stage, digests.clone())),
                }
            }
            Fact::StagesAdded { run, stages } => self.run_mut(*run)?.add_stages(stages.clone()),
            Fact::SweepBegun { run, sweep } => self.run_mut(*run)?.sweeps.push(Arc::new((**sweep).clone())),
            Fact::SweepMoved { run: number, stage, progress, places, failures } => {
                let run = self.run_mut(*number)?;
                let sweep = run.sweeps.iter_mut().find(|sweep| sweep.stage == *stage);
                let sweep = sweep.ok_or_else(|| Misfit(format!("the sweep of stage {stage} of run {number}")))?;
                let sweep = Arc::make_mut(sweep);
                sweep.search.follow(progress);
                sweep.places.extend(places);
                sweep.failures.extend(failures.iter().cloned());
            }
            Fact::RunForgotten { run: number } => {
                let run = self.runs.remove(number).ok_or_else(|| Misfit(format!("run {number}")))?;
                run.stages.iter().for_each(|status| self.use_execution(*number, status, false));
            }
            Fact::Execution { .. }
            | Fact::ExecutionState { .. }
            | Fact::ExecutionPlacement { .. }
            | Fact::ExecutionSource { .. }
            | Fact::ExecutionTime { .. }
            | Fact::ExecutionResumed { .. }
            | Fact::ExecutionInstructions { .. }
            | Fact::Tasks { .. }
            | Fact::Task { .. }
            | Fact::ExecutionForgotten { .. } => self.apply_to_execution(fact)?,
            Fact::Worker { worker: name, process } => {
                self.incarnation = self.incarnation.max(process.incarnation);
                let holds = self.workers.get(name).and_then(|worker| worker.holds);
                let mut process = process.clone();
                process.holds = holds;
                if holds.is_none() && !self.unused.contains(name) {
                    Arc::make_mut(&mut self.unused).insert(name.clone());
                }
                Arc::make_mut(&mut self.workers).insert(name.clone(), process);
            }
            Fact::WorkerForgotten { worker: name } => {
                if self.workers.get(name).is_none_or(|worker| worker.holds.is_some()) {
                    return Err(Misfit(format!("worker `{name}` without a task")));
                }
                Arc::make_mut(&mut self.workers).remove(name);
                Arc::make_mut(&mut self.unused).remove(name);
                Arc::make_mut(&mut self.heard.workers).remove(name);
            }
            Fact::Draining { draining } => self.draining = *draining,
        }
        Ok(())
    }

    fn apply_to_execution(&mut self, fact: &Fact) -> Result {
        match fact {
            Fact::Execution { execution } => {
                self.place_tasks(execution.key, &execution.tasks);
                self.executions.insert(execution.key, Arc::new((**execution).clone()));
            }
            Fact::ExecutionState { key, state } => self.execution_mut(*key)?.state = state.clone(),
            Fact::ExecutionPlacement { key, placement } => self.execution_mut(*key)?.placement = placement.clone(),
            Fact::ExecutionSource { key, run, stage } => {
                let execution = self.execution_mut(*key)?;
                (execution.run, execution.stage) = (run.clone(), stage.clone());
            }
            Fact::ExecutionTime { key, wall_ms, busy_since } => {
                let execution = self.execution_mut(*key)?;
                (execution.wall_ms, execution.busy_since) = (*wall_ms, *busy_since);
            }
            Fact::ExecutionInstructions { key, instruction_set } => {
                self.execution_mut(*key)?.instruction_set = Some(instruction_set.clone());
            }
            Fact::ExecutionResumed { key } => self.execution_mut(*key)?.resumed = true,
            Fact::Tasks { key, tasks } => {
                self.execution_mut(*key)?.tasks = tasks.clone().into();
                self.place_tasks(*key, tasks);
            }
            Fact::Task { key, task, change } => {
                let execution = self.execution_mut(*key)?;
                if *task >= execution.tasks.len() {
                    return Err(Misfit(format!("task {task} of execution {key}")));
                }
                self.fence = self.fence.max(change.fence.unwrap_or_default());
                self.change(*key, *task, |task| change.apply(task));
            }
            Fact::ExecutionForgotten { key } => {
                let known = self.executions.get(key).filter(|execution| !execution.tasks.is_any_held());
                let known = known.ok_or_else(|| Misfit(format!("execution {key} that nobody works on")))?;
                if !known.tasks.is_empty() {
                    let (tasks, heard) = (Arc::make_mut(&mut self.tasks), Arc::make_mut(&mut self.heard.progress));
                    for task in &known.tasks {
                        tasks.remove(&task.id);
                        heard.remove(&task.id);
                    }
                }
                self.executions.remove(key);
            }
            other => unreachable!("{other:?} is not about an execution"),
        }
        Ok(())
    }

    /// Makes anew what is known twice, after runs, executions and workers were put in as a whole.
    pub(crate) fn index(&mut self) {
        let mut tasks = BTreeMap::new();
        let workers = Arc::make_mut(&mut self.workers);
        for (key, execution) in &self.executions {
            for (i, task) in execution.tasks.iter().enumerate() {
                tasks.insert(task.id.clone(), (*key, i));
                for member in task.holders() {
                    if let Some(worker) = workers.get_mut(&member.worker) {
                        worker.holds = Some((*key, i));
                    }
                }
            }
        }
        let unused = workers.iter().filter(|(_, worker)| worker.holds.is_none()).map(|(name, _)| name.clone());
        self.unused = Arc::new(unused.collect());
        self.tasks = Arc::new(tasks);
    }

    fn run_mut(&mut self, number: u64) -> Result<&mut Run> {
        self.runs.get_mut(&number).map(Arc::make_mut).ok_or_else(|| Misfit(format!("run {number}")))
    }

    /// Changes an execution; other copies of the state keep theirs.
    fn execution_mut(&mut self, key: Digest) -> Result<&mut StageExecution> {
        self.executions.get_mut(&key).map(Arc::make_mut).ok_or_else(|| Misfit(format!("execution {key}")))
    }

    fn place_tasks(&mut self, key: Digest, tasks: &[Task]) {
        if let Some(fence) = tasks.iter().map(|task| task.fence).max() {
            self.fence = self.fence.max(fence);
            Arc::make_mut(&mut self.tasks)
                .extend(tasks.iter().enumerate().map(|(i, task)| (task.id.clone(), (key, i))));
        }
    }

    /// Takes note that a run has one stage more, or one less, with the key of `status`.
    fn use_execution(&mut self, run: u64, status: &Status, more: bool) {
        let Some(execution) = status.key().and_then(|key| self.executions.get_mut(&key)) else { return };
        let users = &mut Arc::make_mut(execution).users;
        let count = users.entry(run).or_default();
        *count = if more { *count + 1 } else { count.saturating_sub(1) };
        if *count == 0 {
            users.remove(&run);
        }
    }

    /// Changes a task; the only way to.
    fn change(&mut self, key: Digest, i: usize, change: impl FnOnce(&mut Task)) {
        let Some(execution) = self.executions.get_mut(&key).map(Arc::make_mut) else { return };
        let before = execution.tasks[i].holders().to_vec();
        execution.tasks.change(i, change);
        let after = execution.tasks[i].holders();
        if before != after {
            let (workers, unused) = (Arc::make_mut(&mut self.workers), Arc::make_mut(&mut self.unused));
            let mut set = |name: &WorkerId, holds| {
                let Some(worker) = workers.get_mut(name) else { return };
                worker.holds = holds;
                if holds.is_none() {
                    unused.insert(name.clone())
                } else {
                    unused.remove(name)
                };
            };
            before.iter().for_each(|member| set(&member.worker, None));
            if before.iter().any(|member| !after.contains(member) && self.heard.words.contains_key(&member.worker)) {
                let words = Arc::make_mut(&mut self.heard.words);
                before
                    .iter()
                    .filter(|member| !after.contains(member))
                    .for_each(|member| drop(words.remove(&member.worker)));
            }
            after.iter().for_each(|member| set(&member.worker, Some((key, i))));
        }
    }
}
