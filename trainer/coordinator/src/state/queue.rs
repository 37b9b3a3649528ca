//! Executions that running runs wait for, in the order in which they are served, by what they need; and when a task's wait ends.
//!
//! All of it follows from the facts: [`State::apply`](super::State::apply) brings the entry of each execution up to date that a fact
//! concerns. A decision finds here what workers can be given and looks at no execution that waits. Invariant C14.

use std::collections::BTreeSet;

use protocol::Digest;
use protocol::message::RunState;
use protocol::stage::Backend;

use super::State;
use super::execution::{ExecutionState, StageExecution};
use super::gang;
use super::run::Status;
use super::shared::{Map, Set};
use super::task::{Lease, Part, Task};
use super::worker::Worker;
use crate::time::Millis;

/// A place in the order of service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Rank {
    /// Runs as submitted.
    pub run: u64,
    /// Stages as in the pipeline.
    pub stage: usize,
    /// The place in [`State::mended_for`] of an input that is made again, which comes before its reader; `usize::MAX` for the stage itself.
    pub mended: usize,
}

/// The workers that an execution needs.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Need {
    /// Members of a gang rather than one worker for a task that is ready.
    pub gang: bool,
    /// The backend that computes it.
    pub backend: Backend,
    /// The instruction set that it is bound to.
    pub instruction_set: Option<String>,
}

impl Need {
    /// Returns true if a worker fits.
    pub fn takes(&self, worker: &Worker) -> bool {
        let set = self.instruction_set.as_ref();
        worker.backend == self.backend && set.is_none_or(|set| worker.instruction_set == *set)
    }
}

/// The indexed properties of one execution.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Entry {
    /// `None`: no running run waits for it.
    rank: Option<Rank>,
    need: Option<Need>,
    /// The backend, if shards are held.
    sharding: Option<Backend>,
    /// The time at which the first wait of a task ends.
    due: Option<Millis>,
}

/// The index.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Queue {
    entries: Map<Digest, Entry>,
    by_need: Map<Need, Set<(Rank, Digest)>>,
    /// The number of wanted executions with held shards.
    sharding: Map<Backend, usize>,
    due: Set<(Millis, Digest)>,
}

impl Queue {
    /// The needs that there are.
    pub fn needs(&self) -> impl Iterator<Item = &Need> {
        self.by_need.keys()
    }

    /// Executions with a need, in order.
    pub fn with(&self, need: &Need) -> impl Iterator<Item = (Rank, Digest)> + '_ {
        self.by_need.get(need).into_iter().flat_map(|set| set.iter().copied())
    }

    /// The place of an execution, if a running run waits for it.
    pub fn rank(&self, key: &Digest) -> Option<Rank> {
        self.entries.get(key)?.rank
    }

    /// The place of an execution that needs members of a gang.
    pub fn rank_of_gang(&self, key: &Digest) -> Option<Rank> {
        let entry = self.entries.get(key)?;
        entry.need.as_ref().filter(|need| need.gang).and(entry.rank)
    }

    /// Returns true if shards of some execution are held.
    pub fn is_sharding(&self, backend: Backend) -> bool {
        self.sharding.contains_key(&backend)
    }

    /// Executions of which a task's wait ends at `now` or before.
    pub fn due(&self, now: Millis) -> impl Iterator<Item = Digest> + '_ {
        self.due.iter().take_while(move |(time, _)| *time <= now).map(|(_, key)| *key)
    }

    fn set(&mut self, key: Digest, entry: Option<Entry>) {
        if self.entries.get(&key) == entry.as_ref() {
            return;
        }
        if let Some(old) = self.entries.get(&key).cloned() {
            self.take_out(key, &old);
        }
        if let Some(new) = entry {
            self.put_in(key, &new);
            self.entries.insert_mut(key, new);
        } else {
            self.entries.remove_mut(&key);
        }
    }

    fn put_in(&mut self, key: Digest, entry: &Entry) {
        if let (Some(rank), Some(need)) = (entry.rank, &entry.need) {
            let mut set = self.by_need.get(need).cloned().unwrap_or_default();
            set.insert_mut((rank, key));
            self.by_need.insert_mut(need.clone(), set);
        }
        if let Some(backend) = entry.sharding {
            let count = self.sharding.get(&backend).copied().unwrap_or_default();
            self.sharding.insert_mut(backend, count + 1);
        }
        if let Some(due) = entry.due {
            self.due.insert_mut((due, key));
        }
    }

    fn take_out(&mut self, key: Digest, entry: &Entry) {
        if let (Some(rank), Some(need)) = (entry.rank, &entry.need)
            && let Some(set) = self.by_need.get_mut(need)
        {
            set.remove_mut(&(rank, key));
            if set.is_empty() {
                self.by_need.remove_mut(need);
            }
        }
        if let Some(backend) = entry.sharding
            && let Some(count) = self.sharding.get_mut(&backend)
        {
            *count -= 1;
            if *count == 0 {
                self.sharding.remove_mut(&backend);
            }
        }
        if let Some(due) = entry.due {
            self.due.remove_mut(&(due, key));
        }
    }
}

impl State {
    /// Brings the entry of an execution up to date.
    pub(super) fn requeue(&mut self, key: Digest) {
        let entry = self.executions.get(&key).map(|execution| self.entry(execution));
        self.queue.set(key, entry);
    }

    fn entry(&self, execution: &StageExecution) -> Entry {
        let rank = self.rank_now(execution);
        let is_wanted = rank.is_some();
        let need = (is_wanted && execution.state == ExecutionState::Open).then(|| need(execution)).flatten();
        let sharding = is_wanted && execution.tasks.is_any_shard_held();
        Entry { rank, need, sharding: sharding.then_some(execution.backend), due: execution.tasks.first_deadline() }
    }

    /// The first of the places at which running runs wait for an execution, or for what it is made again for.
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

    /// Executions that wait for one to be made again, and those that wait for them.
    pub(super) fn waiting_for(&self, input: Digest) -> BTreeSet<Digest> {
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

    /// Makes the index anew.
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

    /// Takes note that an execution waits for its inputs to be made again, or does so no longer.
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

fn need(execution: &StageExecution) -> Option<Need> {
    let gang = execution.is_gang();
    let is_needed = if gang { open_member(execution).is_some() } else { execution.tasks.first_ready().is_some() };
    is_needed.then(|| Need {
        gang,
        backend: execution.backend,
        instruction_set: execution.bound_to().map(str::to_owned),
    })
}

/// A gang task of an execution that could take in a worker.
pub(crate) fn open_member(execution: &StageExecution) -> Option<usize> {
    let has_room = |task: &Task| match &task.lease {
        Lease::Waiting { .. } => true,
        Lease::Held { holders, drain_by: None, .. } => gang::has_room(holders.len(), execution.range()),
        Lease::Held { drain_by: Some(_), .. } | Lease::Done { .. } => false,
    };
    execution.tasks.iter().position(|task| task.part == Part::Gang && has_room(task))
}
