//! An index of the executions that running runs wait for, in the order of service and by their needs, and of the
//! deadlines of tasks.
//!
//! The index is derived from the facts: [`State::apply`](super::State::apply) updates the entry of each affected
//! execution. A decision finds grantable work here without inspecting the executions that wait. Invariant C14 checks
//! the index.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use protocol::stage::Backend;
use protocol::{Digest, Group, Labels};

use super::execution::StageExecution;
use super::gang;
use super::shared::{Map, Set};
use super::task::{Lease, Part, Task};
use super::worker::Worker;
use crate::time::Millis;

/// A position in the order of service of a group.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Rank {
    /// The priority of the run; the highest comes first.
    pub priority: Reverse<i32>,
    /// The run's number, in order of submission.
    pub run: u64,
    /// The stage's index in the pipeline.
    pub stage: usize,
    /// The index in [`State::mended_for`] of a recomputed input, which precedes its reader; `usize::MAX` for the stage
    /// itself.
    pub mended: usize,
}

/// A position in the order of submission: run, stage and recomputed input, as in [`Rank`]. It orders the work of different
/// groups, because a priority counts only within a group.
pub type Turn = (u64, usize, usize);

impl Rank {
    /// The position without the priority.
    pub fn turn(&self) -> Turn {
        (self.run, self.stage, self.mended)
    }
}

/// The runs of a group that have the same priority.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Claimant {
    /// Empty where groups are not told apart.
    pub group: Group,
    pub priority: i32,
}

impl Claimant {
    /// Returns true if `other` is of the same group and has a lower priority.
    pub fn precedes(&self, other: &Self) -> bool {
        self.group == other.group && self.priority > other.priority
    }
}

/// Merges the work of several groups into one order. Each group keeps the turns of its work; a higher priority gets an
/// earlier turn of the same group.
pub fn in_turn<'a>(work: impl IntoIterator<Item = (&'a Group, Rank, Digest)>) -> Vec<Digest> {
    let mut groups: BTreeMap<&Group, BTreeSet<(Rank, Digest)>> = BTreeMap::new();
    for (group, rank, key) in work {
        groups.entry(group).or_default().insert((rank, key));
    }
    let mut in_order: BTreeSet<(Turn, Digest)> = BTreeSet::new();
    for ranks in groups.into_values() {
        let mut turns: Vec<Turn> = ranks.iter().map(|(rank, _)| rank.turn()).collect();
        turns.sort_unstable();
        in_order.extend(turns.into_iter().zip(ranks.into_iter().map(|(_, key)| key)));
    }
    in_order.into_iter().map(|(_, key)| key).collect()
}

/// The kind of workers that an execution needs.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Need {
    /// Set for members of a gang; otherwise one worker for a ready task is needed.
    pub gang: bool,
    /// The backend that computes the execution.
    pub backend: Backend,
    /// The instruction set that the execution requires.
    pub instruction_set: Option<String>,
    /// The labels that each worker must have.
    pub requires: Labels,
    /// The runs that wait.
    pub claimant: Claimant,
}

impl Need {
    /// Returns true if a worker fits.
    pub fn takes(&self, worker: &Worker) -> bool {
        let set = self.instruction_set.as_ref();
        worker.backend == self.backend
            && worker.labels.have(&self.requires)
            && set.is_none_or(|set| worker.instruction_set == *set)
    }
}

/// The indexed properties of one execution.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Entry {
    /// `None` if no running run waits for it.
    pub(super) rank: Option<Rank>,
    pub(super) need: Option<Need>,
    /// Set if the execution may need these workers, which a lookup in the store decides.
    pub(super) is_looking: bool,
    /// The backend, if shards are held.
    pub(super) sharding: Option<Backend>,
    /// The earliest deadline of a task.
    pub(super) due: Option<Millis>,
}

/// Entries by key, with indexes by need, backend and deadline.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Queue {
    entries: Map<Digest, Entry>,
    by_need: Map<Need, Set<(Rank, Digest)>>,
    /// The same for executions that are being looked up.
    looking: Map<Need, Set<(Rank, Digest)>>,
    /// The number of wanted executions with held shards.
    sharding: Map<Backend, usize>,
    due: Set<(Millis, Digest)>,
}

impl Queue {
    /// The needs of at least one execution.
    pub fn needs(&self) -> impl Iterator<Item = &Need> {
        self.by_need.keys()
    }

    /// Executions with a need, in the order of service.
    pub fn with(&self, need: &Need) -> impl Iterator<Item = (Rank, Digest)> + '_ {
        self.by_need.get(need).into_iter().flat_map(|set| set.iter().copied())
    }

    /// The first execution of each need that is being looked up.
    pub fn looked_up(&self) -> impl Iterator<Item = (&Need, Rank, Digest)> {
        self.looking.iter().filter_map(|(need, set)| set.first().map(|(rank, key)| (need, *rank, *key)))
    }

    /// The position of an execution that a running run waits for.
    pub fn rank(&self, key: &Digest) -> Option<Rank> {
        self.entries.get(key)?.rank
    }

    /// The runs that wait for an execution's workers.
    pub fn claimant(&self, key: &Digest) -> Option<&Claimant> {
        self.entries.get(key)?.need.as_ref().map(|need| &need.claimant)
    }

    /// An execution that needs gang members: its group and position.
    pub fn gang(&self, key: &Digest) -> Option<(&Group, Rank)> {
        let entry = self.entries.get(key).filter(|entry| !entry.is_looking)?;
        let need = entry.need.as_ref().filter(|need| need.gang)?;
        Some((&need.claimant.group, entry.rank?))
    }

    /// Returns true if a worker holds a shard of an execution on `backend`.
    pub fn is_sharding(&self, backend: Backend) -> bool {
        self.sharding.contains_key(&backend)
    }

    /// Executions with a task deadline at `now` or before.
    pub fn due(&self, now: Millis) -> impl Iterator<Item = Digest> + '_ {
        self.due.iter().take_while(move |(time, _)| *time <= now).map(|(_, key)| *key)
    }

    /// Replaces the entry of an execution; `None` removes it.
    pub(super) fn set(&mut self, key: Digest, entry: Option<Entry>) {
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
            let sets = if entry.is_looking { &mut self.looking } else { &mut self.by_need };
            let mut set = sets.get(need).cloned().unwrap_or_default();
            set.insert_mut((rank, key));
            sets.insert_mut(need.clone(), set);
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
        let sets = if entry.is_looking { &mut self.looking } else { &mut self.by_need };
        if let (Some(rank), Some(need)) = (entry.rank, &entry.need)
            && let Some(set) = sets.get_mut(need)
        {
            set.remove_mut(&(rank, key));
            if set.is_empty() {
                sets.remove_mut(need);
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

/// The first gang task of an execution that could admit a worker.
pub(crate) fn open_member(execution: &StageExecution) -> Option<usize> {
    let has_room = |task: &Task| match &task.lease {
        Lease::Waiting { .. } => true,
        Lease::Held { holders, drain_by: None, .. } => gang::has_room(holders.len(), execution.range()),
        Lease::Held { drain_by: Some(_), .. } | Lease::Done { .. } => false,
    };
    execution.tasks.iter().position(|task| task.part == Part::Gang && has_room(task))
}
