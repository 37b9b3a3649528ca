//! Application of facts to the state. It has no rules: it checks only that the objects of a fact exist.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::{Digest, WorkerId};

use super::State;
use super::execution::StageExecution;
use super::group_runs::GroupRuns;
use super::run::{Run, Status};
use super::shared::{Map, Set};
use super::task::Task;
use crate::fact::Fact;

/// A fact about an object that does not exist.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a fact refers to {0}, which does not exist")]
pub struct UnknownObject(String);

type Result<T = ()> = std::result::Result<T, UnknownObject>;

impl State {
    /// Applies `fact` to the state. An error changes nothing.
    pub fn apply(&mut self, fact: &Fact) -> Result {
        let mut concerned = self.concerned(fact);
        self.apply_alone(fact)?;
        concerned.append(&mut self.concerned(fact));
        for key in concerned {
            self.requeue(key);
        }
        Ok(())
    }

    /// Executions whose position or need in the queue `fact` may change.
    fn concerned(&self, fact: &Fact) -> BTreeSet<Digest> {
        let mut keys = BTreeSet::new();
        match fact {
            Fact::Run { run } => keys.extend(run.stages.iter().filter_map(Status::key)),
            Fact::RunState { run, .. } | Fact::RunQueued { run, .. } => {
                keys.extend(self.runs.get(run).into_iter().flat_map(|run| run.all_active()).map(|(_, key)| key));
            }
            Fact::Stages { run, stages } => {
                let known = |i: &usize| self.runs.get(run)?.stages.get(*i)?.key();
                keys.extend(stages.iter().filter_map(|(i, _)| known(i)));
            }
            Fact::RunForgotten { run } => {
                keys.extend(self.runs.get(run).into_iter().flat_map(|run| &run.stages).filter_map(Status::key));
            }
            Fact::Execution { execution } => drop(keys.insert(execution.key)),
            Fact::ExecutionState { key, .. }
            | Fact::ExecutionPlacement { key, .. }
            | Fact::ExecutionInstructions { key, .. }
            | Fact::Tasks { key, .. }
            | Fact::Task { key, .. }
            | Fact::ExecutionForgotten { key } => drop(keys.insert(*key)),
            Fact::Resolved { .. }
            | Fact::StagesAdded { .. }
            | Fact::SweepBegun { .. }
            | Fact::SweepMoved { .. }
            | Fact::ExecutionSource { .. }
            | Fact::ExecutionTime { .. }
            | Fact::ExecutionResumed { .. }
            | Fact::Worker { .. }
            | Fact::WorkerForgotten { .. }
            | Fact::Draining { .. } => {}
        }
        if !self.mends.is_empty() {
            // The position of a recomputed input depends on its readers and on their other inputs.
            let waiting: Vec<Digest> = keys.iter().flat_map(|key| self.waiting_for(*key)).collect();
            keys.extend(waiting);
            let mended: Vec<Digest> = keys.iter().flat_map(|key| self.mended_for(*key)).collect();
            keys.extend(mended);
        }
        keys
    }

    fn apply_alone(&mut self, fact: &Fact) -> Result {
        match fact {
            Fact::Run { .. }
            | Fact::RunState { .. }
            | Fact::RunQueued { .. }
            | Fact::Stages { .. }
            | Fact::Resolved { .. }
            | Fact::StagesAdded { .. }
            | Fact::SweepBegun { .. }
            | Fact::SweepMoved { .. }
            | Fact::RunForgotten { .. } => self.apply_to_run(fact),
            Fact::Execution { .. }
            | Fact::ExecutionState { .. }
            | Fact::ExecutionPlacement { .. }
            | Fact::ExecutionSource { .. }
            | Fact::ExecutionTime { .. }
            | Fact::ExecutionResumed { .. }
            | Fact::ExecutionInstructions { .. }
            | Fact::Tasks { .. }
            | Fact::Task { .. }
            | Fact::ExecutionForgotten { .. } => self.apply_to_execution(fact),
            Fact::Worker { .. } | Fact::WorkerForgotten { .. } => self.apply_to_worker(fact),
            Fact::Draining { draining } => {
                self.draining = *draining;
                Ok(())
            }
        }
    }

    fn apply_to_run(&mut self, fact: &Fact) -> Result {
        match fact {
            Fact::Run { run } => {
                self.submitted = self.submitted.max(run.number);
                let run = Arc::new(Run::clone(run));
                for (i, status) in run.stages.iter().enumerate() {
                    self.use_execution(run.number, i, status, true);
                }
                if let Some(key) = &run.idempotency_key {
                    self.idempotent.insert_mut(key.clone(), run.number);
                }
                self.note_parked(run.number, run.parked);
                let number = run.number;
                self.runs.insert_mut(number, run);
                self.count_run(number, true);
            }
            Fact::RunState { run: number, state, parked } => {
                self.change_count(*number, |run| (run.state, run.parked) = (*state, *parked))?;
                self.note_parked(*number, *parked);
            }
            Fact::RunQueued { run: number, queued } => self.change_count(*number, |run| run.queued = *queued)?,
            Fact::Stages { run: number, stages } => {
                let run = self.run_mut(*number)?;
                if let Some((i, _)) = stages.iter().find(|(i, _)| *i >= run.stages.len()) {
                    return Err(UnknownObject(format!("stage {i} of run {number}")));
                }
                let before: Vec<(usize, Status)> = stages.iter().map(|(i, _)| (*i, run.stages[*i].clone())).collect();
                stages.iter().for_each(|(i, status)| run.set(*i, status.clone()));
                before.iter().for_each(|(i, status)| self.use_execution(*number, *i, status, false));
                stages.iter().for_each(|(i, status)| self.use_execution(*number, *i, status, true));
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
                let sweep =
                    sweep.ok_or_else(|| UnknownObject(format!("the sweep of stage {stage} of run {number}")))?;
                let sweep = Arc::make_mut(sweep);
                sweep.search.follow(progress);
                sweep.places.extend(places);
                sweep.failures.extend(failures.iter().cloned());
            }
            Fact::RunForgotten { run: number } => self.forget_run(*number)?,
            other => unreachable!("{other:?} is not about a run"),
        }
        Ok(())
    }

    fn forget_run(&mut self, number: u64) -> Result {
        let run = self.runs.get(&number).cloned().ok_or_else(|| UnknownObject(format!("run {number}")))?;
        self.count_run(number, false);
        self.runs.remove_mut(&number);
        for (i, status) in run.stages.iter().enumerate() {
            self.use_execution(number, i, status, false);
        }
        if let Some(key) = &run.idempotency_key {
            self.idempotent.remove_mut(key);
        }
        self.note_parked(number, false);
        Ok(())
    }

    fn apply_to_worker(&mut self, fact: &Fact) -> Result {
        match fact {
            Fact::Worker { worker: name, process } => {
                self.incarnation = self.incarnation.max(process.incarnation);
                let holds = self.workers.get(name).and_then(|worker| worker.holds);
                let mut process = process.clone();
                process.holds = holds;
                if holds.is_none() && !self.unused.contains(name) {
                    self.unused.insert_mut(name.clone());
                }
                self.workers.insert_mut(name.clone(), process);
            }
            Fact::WorkerForgotten { worker: name } => {
                if self.workers.get(name).is_none_or(|worker| worker.holds.is_some()) {
                    return Err(UnknownObject(format!("worker `{name}` without a task")));
                }
                self.workers.remove_mut(name);
                self.unused.remove_mut(name);
                self.heard.workers.remove_mut(name);
            }
            other => unreachable!("{other:?} is not about a worker"),
        }
        Ok(())
    }

    fn apply_to_execution(&mut self, fact: &Fact) -> Result {
        match fact {
            Fact::Execution { execution } => {
                self.place_tasks(execution.key, &execution.tasks);
                self.executions.insert_mut(execution.key, Arc::new((**execution).clone()));
                self.note_mending(execution.key, &execution.state, true);
            }
            Fact::ExecutionState { key, state } => {
                let before = std::mem::replace(&mut self.execution_mut(*key)?.state, state.clone());
                self.note_mending(*key, &before, false);
                self.note_mending(*key, state, true);
            }
            Fact::ExecutionPlacement { key, placement } => self.execution_mut(*key)?.placement = placement.clone(),
            Fact::ExecutionSource { key, run, stage } => {
                let execution = self.execution_mut(*key)?;
                (execution.run, execution.stage) = (run.clone(), stage.clone());
            }
            Fact::ExecutionTime { key, wall_ms, busy_since, idle_since } => {
                let execution = self.execution_mut(*key)?;
                (execution.wall_ms, execution.busy_since) = (*wall_ms, *busy_since);
                execution.idle_since = *idle_since;
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
                    return Err(UnknownObject(format!("task {task} of execution {key}")));
                }
                self.fence = self.fence.max(change.fence.unwrap_or_default());
                self.change(*key, *task, |task| change.apply(task));
            }
            Fact::ExecutionForgotten { key } => {
                let known = self.executions.get(key).filter(|execution| !execution.tasks.is_any_held());
                let known = known.ok_or_else(|| UnknownObject(format!("an idle execution {key}")))?;
                let known = Arc::clone(known);
                for task in &known.tasks {
                    self.tasks.remove_mut(&task.id);
                    self.heard.progress.remove_mut(&task.id);
                    self.heard.memory.remove_mut(&task.id);
                }
                self.note_mending(*key, &known.state, false);
                self.executions.remove_mut(key);
            }
            other => unreachable!("{other:?} is not about an execution"),
        }
        Ok(())
    }

    /// Rebuilds all derived data after loading runs, executions and workers.
    pub(crate) fn index(&mut self) {
        self.tasks = Map::default();
        for (key, execution) in &self.executions {
            for (i, task) in execution.tasks.iter().enumerate() {
                self.tasks.insert_mut(task.id.clone(), (*key, i));
                for member in task.holders() {
                    if let Some(worker) = self.workers.get_mut(&member.worker) {
                        worker.holds = Some((*key, i));
                    }
                }
            }
        }
        let unused = self.workers.iter().filter(|(_, worker)| worker.holds.is_none()).map(|(name, _)| name.clone());
        self.unused = unused.collect();
        let keys = self.runs.values().filter_map(|run| Some((run.idempotency_key.clone()?, run.number)));
        self.idempotent = keys.collect();
        self.parked = self.runs.values().filter(|run| run.parked).map(|run| run.number).collect::<Set<u64>>();
        self.groups = Map::default();
        for number in self.runs.keys().copied().collect::<Vec<_>>() {
            self.count_run(number, true);
        }
        self.index_queue();
    }

    /// Changes a run and how it counts among those of its group.
    fn change_count(&mut self, number: u64, change: impl FnOnce(&mut Run)) -> Result {
        self.count_run(number, false);
        change(self.run_mut(number)?);
        self.count_run(number, true);
        Ok(())
    }

    /// Adds a run to those of its group, or removes it.
    fn count_run(&mut self, number: u64, is_there: bool) {
        let Some(run) = self.runs.get(&number) else { return };
        let group = run.owner.group();
        let mut runs = self.groups.get(&group).cloned().unwrap_or_default();
        runs.count(run, is_there);
        if runs == GroupRuns::default() {
            self.groups.remove_mut(&group);
        } else {
            self.groups.insert_mut(group, runs);
        }
    }

    fn note_parked(&mut self, run: u64, parked: bool) {
        if parked {
            self.parked.insert_mut(run);
        } else {
            self.parked.remove_mut(&run);
        }
    }

    fn run_mut(&mut self, number: u64) -> Result<&mut Run> {
        self.runs.get_mut(&number).map(Arc::make_mut).ok_or_else(|| UnknownObject(format!("run {number}")))
    }

    /// Changes an execution; other copies of the state keep theirs.
    fn execution_mut(&mut self, key: Digest) -> Result<&mut StageExecution> {
        self.executions.get_mut(&key).map(Arc::make_mut).ok_or_else(|| UnknownObject(format!("execution {key}")))
    }

    fn place_tasks<'a>(&mut self, key: Digest, tasks: impl IntoIterator<Item = &'a Task>) {
        for (i, task) in tasks.into_iter().enumerate() {
            self.fence = self.fence.max(task.fence);
            self.tasks.insert_mut(task.id.clone(), (key, i));
        }
    }

    /// Adds or removes a stage of a run as a user of the execution in `status`.
    fn use_execution(&mut self, run: u64, stage: usize, status: &Status, has: bool) {
        let Some(execution) = status.key().and_then(|key| self.executions.get_mut(&key)) else { return };
        let users = &mut Arc::make_mut(execution).users;
        if has {
            users.insert_mut((run, stage));
        } else {
            users.remove_mut(&(run, stage));
        }
    }

    /// Changes a task. This is the only way to change one.
    fn change(&mut self, key: Digest, i: usize, change: impl FnOnce(&mut Task)) {
        let Some(execution) = self.executions.get_mut(&key).map(Arc::make_mut) else { return };
        let before = execution.tasks[i].holders().to_vec();
        execution.tasks.change(i, change);
        let after = execution.tasks[i].holders();
        if before != after {
            let after = after.to_vec();
            before.iter().for_each(|member| self.set_held(&member.worker, None));
            if before.iter().any(|member| !after.contains(member) && self.heard.words.contains_key(&member.worker)) {
                let words = Arc::make_mut(&mut self.heard.words);
                before
                    .iter()
                    .filter(|member| !after.contains(member))
                    .for_each(|member| drop(words.remove(&member.worker)));
            }
            after.iter().for_each(|member| self.set_held(&member.worker, Some((key, i))));
        }
    }

    fn set_held(&mut self, name: &WorkerId, holds: Option<(Digest, usize)>) {
        let Some(worker) = self.workers.get_mut(name) else { return };
        worker.holds = holds;
        if holds.is_none() {
            self.unused.insert_mut(name.clone());
        } else {
            self.unused.remove_mut(name);
        }
    }
}
