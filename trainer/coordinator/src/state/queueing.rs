//! Keeps the index of executions that need workers up to date with the state.

use std::cmp::Reverse;
use std::collections::BTreeSet;

use protocol::Digest;
use protocol::stage::Shape;

use super::State;
use super::execution::{ExecutionState, StageExecution};
use super::queue::{Claimant, Entry, Need, Queue, Rank, open_member};
use super::run::Status;
use super::shared::Map;

/// Number of runs whose priorities count for an execution that they share. Thousands of runs may wait for one data set.
const COUNTED: usize = 64;

impl State {
    /// Updates the entry of an execution.
    pub(super) fn requeue(&mut self, key: Digest) {
        let entry = self.executions.get(&key).map(|execution| self.entry(execution));
        self.queue.set(key, entry);
    }

    fn entry(&self, execution: &StageExecution) -> Entry {
        let rank = self.rank_now(execution);
        let is_wanted = rank.is_some();
        let is_looking = execution.state == ExecutionState::Looking;
        let needed = match rank.and_then(|rank| self.claimant(rank)) {
            Some(claimant) if execution.state == ExecutionState::Open => need(execution, claimant),
            Some(claimant) if is_looking => possible_need(execution, claimant),
            Some(_) | None => None,
        };
        let sharding = is_wanted && execution.tasks.is_any_shard_held();
        Entry {
            rank,
            need: needed,
            is_looking,
            sharding: sharding.then_some(execution.backend),
            due: execution.tasks.first_deadline(),
        }
    }

    /// The runs at a position in the order of service.
    pub(crate) fn claimant(&self, rank: Rank) -> Option<Claimant> {
        let run = self.runs.get(&rank.run)?;
        Some(Claimant { group: run.owner.group(), priority: run.submitted.priority })
    }

    /// The position at which running runs wait for an execution or for one of its waiting readers.
    fn rank_now(&self, execution: &StageExecution) -> Option<Rank> {
        let mut ranks: Vec<Rank> = self.waits_at(execution).collect();
        for key in self.waiting_for(execution.key) {
            let Some(waiting) = self.executions.get(&key) else { continue };
            let place = self.mended_for(key).iter().position(|input| *input == execution.key);
            if let Some(mended) = place {
                ranks.extend(self.waits_at(waiting).map(|rank| Rank { mended, ..rank }));
            }
        }
        self.first_of(&ranks)
    }

    /// The position of an execution that waits at all of `ranks`. It belongs to the group that waited first, at the
    /// highest priority of this group.
    pub(crate) fn first_of(&self, ranks: &[Rank]) -> Option<Rank> {
        let first = ranks.iter().min_by_key(|rank| rank.turn())?;
        let group = |rank: &Rank| self.runs.get(&rank.run).map(|run| run.owner.group());
        let higher = ranks.iter().filter(|rank| rank.priority < first.priority && group(rank) == group(first));
        higher.min().or(Some(first)).copied()
    }

    /// Executions that wait directly or indirectly for the recomputation of `input`.
    pub(crate) fn waiting_for(&self, input: Digest) -> BTreeSet<Digest> {
        let mut all = BTreeSet::new();
        let mut found = vec![input];
        while let Some(key) = found.pop() {
            for waiting in self.mends.get(&key).into_iter().flatten() {
                if all.insert(*waiting) {
                    found.push(*waiting);
                }
            }
        }
        all
    }

    /// The positions of the first running runs that wait for an execution.
    fn waits_at(&self, execution: &StageExecution) -> impl Iterator<Item = Rank> {
        let is_active = |(run, stage): &&(u64, usize)| {
            self.runs
                .get(run)
                .is_some_and(|run| run.is_at_work() && matches!(run.stages.get(*stage), Some(Status::Active { .. })))
        };
        execution.users.iter().filter(is_active).take(COUNTED).map(|(run, stage)| self.rank(*run, *stage))
    }

    pub(crate) fn rank(&self, run: u64, stage: usize) -> Rank {
        let priority = self.runs.get(&run).map_or(0, |run| run.submitted.priority);
        Rank { priority: Reverse(priority), run, stage, mended: usize::MAX }
    }

    /// Rebuilds the index.
    pub(super) fn index_queue(&mut self) {
        self.mends = Map::default();
        self.queue = Queue::default();
        let executions: Vec<_> = self.executions.values().cloned().collect();
        for execution in &executions {
            self.note_mending(execution.key, &execution.state, true);
        }
        for execution in &executions {
            self.requeue(execution.key);
        }
    }

    /// Adds or removes an execution as waiting for recomputed inputs.
    pub(super) fn note_mending(&mut self, key: Digest, state: &ExecutionState, waits: bool) {
        let ExecutionState::Mending { inputs } = state else { return };
        for input in inputs {
            let mut waiting = self.mends.get(input).cloned().unwrap_or_default();
            if waits {
                waiting.insert_mut(key);
            } else {
                waiting.remove_mut(&key);
            }
            if waiting.is_empty() {
                self.mends.remove_mut(input);
            } else {
                self.mends.insert_mut(*input, waiting);
            }
        }
    }
}

fn need(execution: &StageExecution, claimant: Claimant) -> Option<Need> {
    let gang = execution.is_gang();
    let is_needed = if gang { open_member(execution).is_some() } else { execution.tasks.first_ready().is_some() };
    is_needed.then(|| need_of(execution, gang, claimant))
}

/// The need of an execution if the store does not have its value.
fn possible_need(execution: &StageExecution, claimant: Claimant) -> Option<Need> {
    match execution.settings.shape() {
        Shape::Registry => None,
        shape => Some(need_of(execution, shape == Shape::Gang && !execution.resolves, claimant)),
    }
}

fn need_of(execution: &StageExecution, gang: bool, claimant: Claimant) -> Need {
    Need {
        gang,
        backend: execution.backend,
        instruction_set: execution.bound_to().map(str::to_owned),
        requires: execution.placement.requires.clone(),
        claimant,
    }
}
