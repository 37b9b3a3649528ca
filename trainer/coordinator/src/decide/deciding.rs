//! A decision in progress: its facts, the writes that they imply, and the objects that they affect.
//! [`Deciding::record`] is the only way to change the state; every part of a decision uses it.

use std::collections::BTreeSet;
use std::sync::Arc;

use protocol::{Digest, TaskId};
use registry::{HistoryEntry, Write};

use crate::event::Effect;
use crate::fact::{Fact, TaskChange};
use crate::history;
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::run::{Run, Status};
use crate::state::task::Task;
use crate::time::{Millis, Moment};

/// A decision in progress.
#[derive(Debug)]
pub(crate) struct Deciding<'a> {
    pub(crate) state: &'a mut State,
    pub(crate) moment: Moment,
    pub(crate) facts: Vec<Fact>,
    pub(crate) writes: Vec<Write>,
    pub(crate) fences: Vec<Write>,
    pub(crate) effects: Vec<Effect>,
    /// Events for human readers, and the reason of the next fact, if there is one.
    pub(crate) history: Vec<HistoryEntry>,
    pub(crate) why: Option<String>,
    /// Changed runs that are not reconciled yet.
    pub(crate) unreconciled: BTreeSet<u64>,
    /// Runs that this decision has changed.
    pub(crate) runs: BTreeSet<u64>,
    /// Changed executions, and executions with a changed user.
    pub(crate) touched: BTreeSet<Digest>,
}

impl<'a> Deciding<'a> {
    pub(crate) fn new(state: &'a mut State, moment: Moment) -> Self {
        Self {
            state,
            moment,
            facts: Vec::new(),
            writes: Vec::new(),
            fences: Vec::new(),
            effects: Vec::new(),
            history: Vec::new(),
            why: None,
            unreconciled: BTreeSet::new(),
            runs: BTreeSet::new(),
            touched: BTreeSet::new(),
        }
    }

    /// Applies and records a fact. This is the only way to change the state.
    pub(crate) fn record(&mut self, fact: Fact) {
        self.touch(&fact);
        self.history.extend(history::of(self.state, &fact, self.why.as_deref()));
        if let Err(misfit) = self.state.apply(&fact) {
            panic!("{misfit}: {fact:?}");
        }
        self.facts.push(fact);
    }

    /// Notes the objects that `fact`, which is about to be applied, may affect.
    fn touch(&mut self, fact: &Fact) {
        let mut runs = Vec::new();
        match fact {
            Fact::Run { run } => runs.push(run.number),
            Fact::RunState { run, .. } | Fact::RunQueued { run, .. } => {
                runs.push(*run);
                let known = self.state.runs.get(run).into_iter();
                let active: Vec<Digest> = known.flat_map(|run| run.all_active()).map(|(_, key)| key).collect();
                self.touched.extend(active.iter().flat_map(|key| self.state.mended_for(*key)));
                self.touched.extend(active);
            }
            Fact::Stages { run, stages } => {
                runs.push(*run);
                if let Some(run) = self.state.runs.get(run) {
                    let before: Vec<Digest> = stages.iter().filter_map(|(i, _)| run.stages.get(*i)?.key()).collect();
                    self.touched.extend(before.iter().flat_map(|key| self.state.mended_for(*key)));
                    self.touched.extend(before);
                }
                self.touched.extend(stages.iter().filter_map(|(_, status)| status.key()));
            }
            Fact::Resolved { run, .. }
            | Fact::StagesAdded { run, .. }
            | Fact::SweepBegun { run, .. }
            | Fact::SweepMoved { run, .. } => runs.push(*run),
            Fact::RunForgotten { run } => {
                let known = self.state.runs.get(run).into_iter();
                self.touched.extend(known.flat_map(|run| &run.stages).filter_map(Status::key));
            }
            Fact::Execution { execution } => drop(self.touched.insert(execution.key)),
            Fact::ExecutionState { key, .. } => {
                self.touched.insert(*key);
                self.touched.extend(self.state.mended_for(*key));
                // Also the runs whose executions wait for the recomputation of its value.
                let waiting = self.state.waiting_for(*key);
                let executions = waiting.iter().chain([key]).filter_map(|key| self.state.executions.get(key));
                runs.extend(executions.flat_map(|execution| execution.users.iter()).map(|(run, _)| *run));
            }
            Fact::ExecutionPlacement { key, .. }
            | Fact::ExecutionSource { key, .. }
            | Fact::ExecutionTime { key, .. }
            | Fact::ExecutionResumed { key }
            | Fact::ExecutionInstructions { key, .. }
            | Fact::Tasks { key, .. }
            | Fact::Task { key, .. } => drop(self.touched.insert(*key)),
            Fact::Draining { .. } => {
                let held = self.state.workers.values().filter_map(|worker| worker.holds);
                self.touched.extend(held.map(|(key, _)| key));
            }
            Fact::ExecutionForgotten { .. } | Fact::Worker { .. } | Fact::WorkerForgotten { .. } => {}
        }
        self.unreconciled.extend(&runs);
        self.runs.extend(runs);
    }

    /// Changes a task and records the difference as a fact.
    pub(crate) fn change<T>(&mut self, key: Digest, i: usize, change: impl FnOnce(&mut Task) -> T) -> T {
        let before = &self.state.executions[&key].tasks[i];
        let mut after = before.clone();
        let made = change(&mut after);
        let new = TaskChange::between(before, &after);
        if !new.is_nothing() {
            self.record(Fact::Task { key, task: i, change: Box::new(new) });
        }
        debug_assert_eq!(self.state.executions[&key].tasks[i], after);
        made
    }

    /// Changes a run and records the differences as facts.
    pub(crate) fn change_run<T>(&mut self, number: u64, change: impl FnOnce(&mut Run) -> T) -> T {
        let before = Arc::clone(&self.state.runs[&number]);
        let mut after = Run::clone(&before);
        let made = change(&mut after);
        let stages = after.pipeline.stages[before.pipeline.stages.len()..].to_vec();
        if !stages.is_empty() {
            self.record(Fact::StagesAdded { run: number, stages });
        }
        for sweep in &after.sweeps {
            match before.sweep(sweep.stage) {
                Some(old) if Arc::ptr_eq(old, sweep) => {}
                Some(old) => {
                    let is_new = |(trial, why): &(&usize, &String)| old.failures.get(*trial) != Some(*why);
                    let failures = sweep.failures.iter().filter(is_new).map(|(trial, why)| (*trial, why.clone()));
                    self.record(Fact::SweepMoved {
                        run: number,
                        stage: sweep.stage,
                        progress: sweep.search.since(&old.search),
                        places: sweep.places[old.places.len()..].to_vec(),
                        failures: failures.collect(),
                    });
                }
                None => self.record(Fact::SweepBegun { run: number, sweep: Box::new(Clone::clone(&**sweep)) }),
            }
        }
        let places: BTreeSet<usize> = before.resolved.keys().chain(after.resolved.keys()).copied().collect();
        for stage in places.into_iter().filter(|place| before.resolved.get(place) != after.resolved.get(place)) {
            let digests = after.resolved.get(&stage).cloned().unwrap_or_default();
            self.record(Fact::Resolved { run: number, stage, digests });
        }
        let is_new = |(i, status): &(usize, &Status)| before.stages.get(*i).unwrap_or(&Status::Waiting) != *status;
        let stages: Vec<(usize, Status)> =
            after.stages.iter().enumerate().filter(is_new).map(|(i, status)| (i, status.clone())).collect();
        if !stages.is_empty() {
            self.record(Fact::Stages { run: number, stages });
        }
        if (before.state, before.parked) != (after.state, after.parked) {
            self.record(Fact::RunState { run: number, state: after.state, parked: after.parked });
        }
        debug_assert_eq!(*self.state.runs[&number], after);
        made
    }

    pub(crate) fn now(&self) -> Millis {
        self.moment.now
    }

    pub(crate) fn place(&self, task: &TaskId) -> Result<(Digest, usize), Rejected> {
        self.state.place(task)
    }
}
