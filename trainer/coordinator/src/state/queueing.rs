//! Keeps the index of executions that need workers up to date with the state.

use std::collections::BTreeSet;

use protocol::message::RunState;
use protocol::{Digest, Group};

use super::State;
use super::execution::{ExecutionState, StageExecution};
use super::queue::{Entry, Need, Queue, Rank, open_member};
use super::run::Status;
use super::shared::Map;

impl State {
    /// Updates the entry of an execution.
    pub(super) fn requeue(&mut self, key: Digest) {
        let entry = self.executions.get(&key).map(|execution| self.entry(execution));
        self.queue.set(key, entry);
    }

    fn entry(&self, execution: &StageExecution) -> Entry {
        let rank = self.rank_now(execution);
        let is_wanted = rank.is_some();
        let group = rank.and_then(|rank| self.runs.get(&rank.run)).map(|run| run.owner.group()).unwrap_or_default();
        let need = (is_wanted && execution.state == ExecutionState::Open).then(|| need(execution, group)).flatten();
        let sharding = is_wanted && execution.tasks.is_any_shard_held();
        Entry { rank, need, sharding: sharding.then_some(execution.backend), due: execution.tasks.first_deadline() }
    }

    /// The first position at which running runs wait for an execution or for one of its waiting readers.
    fn rank_now(&self, execution: &StageExecution) -> Option<Rank> {
        let mut first = self.first_active(execution);
        for key in self.waiting_for(execution.key) {
            let rank = self.executions.get(&key).and_then(|waiting| self.first_active(waiting));
            let place = self.mended_for(key).iter().position(|input| *input == execution.key);
            if let (Some(rank), Some(mended)) = (rank, place) {
                let rank = Rank { mended, ..rank };
                first = Some(first.map_or(rank, |first| first.min(rank)));
            }
        }
        first
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

    fn first_active(&self, execution: &StageExecution) -> Option<Rank> {
        let is_active = |(run, stage): &&(u64, usize)| {
            self.runs.get(run).is_some_and(|run| {
                run.state == RunState::Running && matches!(run.stages.get(*stage), Some(Status::Active { .. }))
            })
        };
        let (run, stage) = execution.users.iter().find(is_active)?;
        Some(Rank { run: *run, stage: *stage, mended: usize::MAX })
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

fn need(execution: &StageExecution, group: Group) -> Option<Need> {
    let gang = execution.is_gang();
    let is_needed = if gang { open_member(execution).is_some() } else { execution.tasks.first_ready().is_some() };
    is_needed.then(|| Need {
        gang,
        backend: execution.backend,
        instruction_set: execution.bound_to().map(str::to_owned),
        requires: execution.placement.requires.clone(),
        group,
    })
}
