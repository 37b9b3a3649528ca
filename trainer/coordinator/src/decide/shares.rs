//! Fair shares: workers are divided evenly among the groups whose work waits for them, and by priority within a group.
//!
//! A group is a project, or a token without one. Each idle worker belongs to the group with the fewest workers that
//! could use it, and there to the waiting work of the highest priority. [`moves`](super::moves) frees workers that are
//! busy. The work of one group with one priority is served in its order, without shares.
//!
//! Runs whose worker stays idle for longer than [`Policy::share_ms`](crate::policy::Policy::share_ms), for instance
//! because it cannot fetch the inputs, lose their claim to it. For [`Policy::share_again_ms`](crate::policy::Policy::share_again_ms),
//! no other work gives up a worker for them.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{Digest, Group, WorkerId};

use crate::demand::slots;
use crate::policy::Policy;
use crate::state::execution::StageExecution;
use crate::state::queue::{Claimant, Need, Rank, Turn};
use crate::state::worker::Worker;
use crate::state::{Idle, State};
use crate::time::Millis;

/// Executions of one need whose room for workers is added up.
const COUNTED: usize = 64;

/// The idle workers of each group and priority.
#[derive(Debug, Default)]
pub(crate) struct Shares {
    /// Work of several groups or priorities waits.
    are_divided: bool,
    kept_for: BTreeMap<WorkerId, Claimant>,
    /// Number of further workers of each group with a limit.
    room: BTreeMap<Group, usize>,
}

/// Work that waits for workers, all of one group and priority.
pub(super) struct Claim<'a> {
    pub(super) need: &'a Need,
    pub(super) rank: Rank,
    pub(super) execution: &'a StageExecution,
    /// Number of workers that it could use now.
    pub(super) room: u64,
}

impl Shares {
    /// Divides the workers that are idle at `now`.
    pub(crate) fn of(state: &State, now: Millis) -> Self {
        let mut claims = claims(state);
        let coming = looked_up(state, &claims);
        claims.extend(coming);
        let claimants: BTreeSet<&Claimant> = claims.iter().map(|claim| &claim.need.claimant).collect();
        let are_divided = claimants.len() > 1;
        let is_limited = claimants.iter().any(|claimant| state.policy.limits_of(&claimant.group).workers.is_some());
        if !are_divided && !is_limited {
            return Self::default();
        }
        let mut division = Division::of(state, claims);
        let room = division.room();
        let kept_for = if are_divided { division.divide(now) } else { BTreeMap::new() };
        Self { are_divided, kept_for, room }
    }

    /// Number of further workers that a group may have.
    pub(crate) fn room(&self, group: &Group) -> usize {
        self.room.get(group).copied().unwrap_or(usize::MAX)
    }

    /// Notes that a group has got workers.
    pub(crate) fn took(&mut self, group: &Group, workers: usize) {
        if let Some(room) = self.room.get_mut(group) {
            *room = room.saturating_sub(workers);
        }
    }

    /// Returns true if workers are divided.
    pub(crate) fn are_divided(&self) -> bool {
        self.are_divided
    }

    /// The runs that a worker is kept for.
    pub(crate) fn owner(&self, worker: &WorkerId) -> Option<&Claimant> {
        self.kept_for.get(worker)
    }

    /// Returns true if work of `claimant` may take an idle worker.
    pub(crate) fn allow(&self, worker: &WorkerId, claimant: &Claimant) -> bool {
        self.room(&claimant.group) > 0
            && self.kept_for.get(worker).is_none_or(|owner| owner == claimant || claimant.precedes(owner))
    }
}

/// The waiting work, and the workers that each group has.
pub(super) struct Division<'a> {
    state: &'a State,
    pub(super) claims: Vec<Claim<'a>>,
    /// The first turn of each group's waiting work. A tie of groups goes to the earliest one.
    turns: BTreeMap<&'a Group, Turn>,
    /// Number of workers of each group.
    pub(super) held: BTreeMap<Group, usize>,
    /// The lowest priority of each group's work under way.
    lowest: BTreeMap<Group, i32>,
    /// The runs that work under way is for.
    claimants: BTreeMap<Digest, Claimant>,
}

impl<'a> Division<'a> {
    pub(super) fn of(state: &'a State, claims: Vec<Claim<'a>>) -> Self {
        let mut turns: BTreeMap<&Group, Turn> = BTreeMap::new();
        for claim in &claims {
            let turn = claim.rank.turn();
            turns.entry(&claim.need.claimant.group).and_modify(|first| *first = turn.min(*first)).or_insert(turn);
        }
        let mut held = BTreeMap::new();
        let mut lowest = BTreeMap::new();
        let mut claimants = BTreeMap::new();
        for (key, count) in state.held() {
            let Some(claimant) = state.claimant_of(&state.executions[&key]) else { continue };
            let Claimant { group, priority } = claimant.clone();
            lowest.entry(group.clone()).and_modify(|least: &mut i32| *least = priority.min(*least)).or_insert(priority);
            *held.entry(group).or_default() += count;
            claimants.insert(key, claimant);
        }
        Self { state, claims, turns, held, lowest, claimants }
    }

    /// The runs that an execution under way is for.
    pub(super) fn claimant(&self, key: &Digest) -> Option<&Claimant> {
        self.claimants.get(key)
    }

    /// Number of workers of a claim's group.
    pub(super) fn count(&self, claim: &Claim<'_>) -> usize {
        self.held.get(&claim.need.claimant.group).copied().unwrap_or_default()
    }

    /// Number of further workers of each group with a limit.
    fn room(&self) -> BTreeMap<Group, usize> {
        let mut room = BTreeMap::new();
        for claim in &self.claims {
            let group = &claim.need.claimant.group;
            if let Some(most) = self.state.policy.limits_of(group).workers {
                room.insert(group.clone(), most.saturating_sub(self.count(claim)));
            }
        }
        room
    }

    /// Returns true if a claim's group has as many workers as it may have.
    pub(super) fn is_full(&self, claim: &Claim<'_>) -> bool {
        let most = self.state.policy.limits_of(&claim.need.claimant.group).workers;
        most.is_some_and(|most| self.count(claim) >= most)
    }

    /// The order in which claims get workers: the groups with few workers first, and within a group by priority.
    fn place(&self, claim: &Claim<'_>) -> (usize, Option<Turn>, Rank) {
        (self.count(claim), self.turns.get(&claim.need.claimant.group).copied(), claim.rank)
    }

    /// Returns true if busy workers could be freed for a claim: those of a group with more workers, or of the same group
    /// with a lower priority.
    pub(super) fn is_short(&self, claim: &Claim<'_>) -> bool {
        let Claimant { group, priority } = &claim.need.claimant;
        let most = self.held.values().copied().max().unwrap_or_default();
        self.count(claim) + 2 <= most || self.lowest.get(group).is_some_and(|lowest| lowest < priority)
    }

    /// Gives each idle worker to the first claim that it fits, and counts it as that group's.
    pub(super) fn divide(&mut self, now: Millis) -> BTreeMap<WorkerId, Claimant> {
        let mut given = BTreeMap::new();
        for name in &self.state.unused {
            let Some(worker) = self.state.workers.get(name).filter(|worker| worker.is_available()) else { continue };
            let idle_ms = self.state.heard.idle.get(name).map_or(0, |idle| now.since(idle.since));
            if idle_ms > self.state.policy.share_ms {
                continue;
            }
            let fits = |claim: &Claim<'_>| claim.room > 0 && claim.execution.takes(worker) && !self.is_full(claim);
            let fitting = (0..self.claims.len()).filter(|i| fits(&self.claims[*i]));
            let Some(first) = fitting.min_by_key(|i| self.place(&self.claims[*i])) else { continue };
            let claim = &mut self.claims[first];
            claim.room -= 1;
            *self.held.entry(claim.need.claimant.group.clone()).or_default() += 1;
            given.insert(name.clone(), claim.need.claimant.clone());
        }
        given
    }

    /// Sorts the claims in the order in which they get workers.
    pub(super) fn sort(&mut self) {
        let mut claims = std::mem::take(&mut self.claims);
        claims.sort_by_key(|claim| self.place(claim));
        self.claims = claims;
    }
}

impl State {
    /// Number of workers of each execution under way.
    fn held(&self) -> BTreeMap<Digest, usize> {
        let mut by_execution: BTreeMap<Digest, usize> = BTreeMap::new();
        for (key, _) in self.workers.values().filter_map(|worker| worker.holds) {
            *by_execution.entry(key).or_default() += 1;
        }
        by_execution
    }

    /// Number of workers of a group.
    pub(crate) fn workers_of(&self, group: &Group) -> usize {
        let is_its = |key: &Digest| self.claimant_of(&self.executions[key]).is_some_and(|of| of.group == *group);
        self.held().into_iter().filter(|(key, _)| is_its(key)).map(|(_, count)| count).sum()
    }

    /// Returns true if runs have let a worker idle for too long and this is not noted yet.
    pub(crate) fn share_is_over(&self, now: Millis) -> bool {
        self.kept_idle().any(|idle| {
            let end = idle.since.after(self.policy.share_ms);
            let is_noted = |claimant| self.heard.declined.get(claimant).is_some_and(|at| *at > end);
            now > end && idle.kept_for.as_ref().is_some_and(|claimant| !is_noted(claimant))
        })
    }

    /// The workers that are idle and here. One that fell silent is not at its group's disposal.
    fn kept_idle(&self) -> impl Iterator<Item = &Idle> {
        let is_here = |name: &&WorkerId| self.workers.get(name).is_some_and(Worker::is_available);
        self.unused.iter().filter(is_here).filter_map(|name| self.heard.idle.get(name))
    }

    /// Returns true if runs of these claimants have lately let a worker idle that was kept for them.
    pub(super) fn declines(&self, are_these: impl Fn(&Claimant) -> bool, now: Millis) -> bool {
        let Policy { share_ms, share_again_ms, .. } = self.policy;
        let lately = self.heard.declined.iter().any(|(of, at)| are_these(of) && now.since(*at) < share_again_ms);
        let is_unused =
            |idle: &Idle| idle.kept_for.as_ref().is_some_and(&are_these) && now.since(idle.since) > share_ms;
        lately || self.kept_idle().any(is_unused)
    }

    /// The runs for which an execution is computed: those whose group waits for it first, or else a paused one. Runs
    /// that have ended do not count, although this decision may still have them in memory.
    pub(crate) fn claimant_of(&self, execution: &StageExecution) -> Option<Claimant> {
        let waiting = self.queue.rank(&execution.key).and_then(|rank| self.claimant(rank));
        let is_live = |number: &u64| self.runs.get(number).is_some_and(|run| !run.state.is_final());
        let paused = || execution.users.iter().map(|(number, _)| *number).find(is_live);
        waiting.or_else(|| paused().and_then(|number| self.claimant(self.rank(number, 0))))
    }
}

/// The first waiting work of each need.
pub(super) fn claims(state: &State) -> Vec<Claim<'_>> {
    let first = |need| {
        let mut waiting = state.queue.with(need).take(COUNTED);
        let (rank, key) = waiting.next()?;
        let execution = &*state.executions[&key];
        let others = waiting.map(|(_, key)| &*state.executions[&key]);
        let room = others.chain([execution]).fold(0, |room: u64, execution| room.saturating_add(slots(execution)));
        Some(Claim { need, rank, execution, room })
    };
    state.queue.needs().filter_map(first).collect()
}

/// Work that may wait in a moment, once the store has been asked for its value. It keeps a worker from work of a lower
/// priority, which would otherwise begin between two stages of the higher one.
fn looked_up<'a>(state: &'a State, claims: &[Claim<'_>]) -> Vec<Claim<'a>> {
    let mut coming = Vec::new();
    for (need, rank, key) in state.queue.looked_up() {
        if claims.iter().any(|claim| need.claimant.precedes(&claim.need.claimant)) {
            let execution = &*state.executions[&key];
            coming.push(Claim { need, rank, execution, room: execution.range().min.max(1) as u64 });
        }
    }
    coming
}
