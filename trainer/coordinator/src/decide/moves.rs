//! Busy workers that waiting work gets: those of a group with more workers, and those of a lower priority in the same group.
//!
//! 1. A gang above its minimum gives up one member at a time, which costs a regroup. The gang is of a group that has at
//!    least two workers more than the waiting one, or it is of the same group and of a lower priority.
//! 2. A training that cannot spare a member is preempted: it saves, yields and continues later. It is of the same group
//!    and of a lower priority than a stage that no worker computes.
//!
//! Work of an equal or a higher priority keeps its workers, so two runs never take a worker from each other in turn. A
//! priority has no effect on other groups. Shards and other short tasks are not stopped, because they would lose their
//! work. A group with as many workers as its limit allows gets only those of its own lower priorities.
//! [`Shares`](super::shares::Shares) keeps the freed worker for the work that it was freed for.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use protocol::{Digest, WorkerId};

use super::deciding::Deciding;
use super::shares::{Claim, Division, claims};
use crate::state::State;
use crate::state::queue::{Claimant, Rank};
use crate::state::task::{Lease, Part};
use crate::state::worker::Worker;
use crate::time::Millis;

/// A way to free workers for waiting work.
#[derive(Debug)]
pub(crate) enum Move {
    /// A member leaves its gang, which continues.
    Leave { key: Digest, task: usize, worker: WorkerId },
    /// A training saves and yields.
    Yield { key: Digest, task: usize },
}

/// A training that could be preempted for a claim.
struct Preemptible {
    rank: Rank,
    key: Digest,
    task: usize,
    /// Number of its workers that the claim could use.
    workers: usize,
}

impl Deciding<'_> {
    /// Frees workers for waiting work. Returns true if it freed one, or if an idle worker is no longer kept.
    pub(crate) fn share(&mut self) -> bool {
        let mut moved = self.state.share_is_over(self.now());
        while let Some(next) = self.state.next_move(self.now()) {
            moved = true;
            self.state.visits += 1;
            match next {
                Move::Leave { key, task: i, worker } => {
                    let task = &self.state.executions[&key].tasks[i];
                    let left = task.holders().iter().filter(|member| member.worker != worker).cloned().collect();
                    tracing::info!(%worker, task = %task.id, "leaves its gang for other work");
                    self.regroup(key, i, left);
                }
                Move::Yield { key, task: i } => {
                    let task = &self.state.executions[&key].tasks[i];
                    tracing::info!(task = %task.id, "makes way for a run of a higher priority");
                    let deadline = self.now().after(self.state.policy.yield_ms);
                    self.change(key, i, |task| task.preempt(deadline));
                }
            }
        }
        moved
    }
}

impl State {
    /// The next worker, or the next training, that waiting work should get at `now`.
    pub(crate) fn next_move(&self, now: Millis) -> Option<Move> {
        let mut waiting = claims(self);
        waiting.retain(|claim| !self.declines(|of| *of == claim.need.claimant, now));
        if waiting.is_empty() {
            return None;
        }
        let mut division = Division::of(self, waiting);
        if !division.claims.iter().any(|claim| division.is_short(claim)) {
            return None;
        }
        // Idle workers count as those of the group that is going to use them.
        let kept = division.divide(now);
        division.sort();
        division
            .claims
            .iter()
            .filter(|claim| claim.room > 0)
            .find_map(|claim| self.move_for(claim, &division, &kept, now))
    }

    fn move_for(
        &self,
        claim: &Claim<'_>,
        division: &Division<'_>,
        kept: &BTreeMap<WorkerId, Claimant>,
        now: Millis,
    ) -> Option<Move> {
        let is_usable = |name: &WorkerId| self.workers.get(name).is_some_and(|worker| claim.execution.takes(worker));
        let idle = kept.iter().filter(|(name, owner)| **owner == claim.need.claimant && is_usable(name)).count();
        let coming = idle + self.yielding(claim, division);
        let wanted = if claim.need.gang { claim.execution.range().min.max(1) } else { 1 };
        // Frees one worker at a time, or as many as the work needs to begin.
        if coming >= wanted {
            return None;
        }
        if let Some(leave) = self.spare_member(claim, division, now) {
            return Some(leave);
        }
        let is_computed = claim.need.gang && claim.execution.tasks.is_any_held();
        let preemptible = if is_computed { Vec::new() } else { self.preemptible(claim, division, now) };
        let workers: usize = preemptible.iter().map(|training| training.workers).sum();
        let last = preemptible.into_iter().max_by_key(|training| training.rank);
        last.filter(|_| coming + workers >= wanted)
            .map(|training| Move::Yield { key: training.key, task: training.task })
    }

    /// Number of workers that preempted trainings of the claim's group are about to leave.
    fn yielding(&self, claim: &Claim<'_>, division: &Division<'_>) -> usize {
        let leaves = |worker: &&Worker| {
            let Some((key, i)) = worker.holds else { return false };
            self.executions[&key].tasks[i].is_preempted()
                && claim.execution.takes(worker)
                && division.claimant(&key).is_some_and(|claimant| claimant.group == claim.need.claimant.group)
        };
        self.workers.values().filter(leaves).count()
    }

    /// A member that a gang can spare for `claim`: of the group with the most workers, and there of the lowest priority.
    fn spare_member(&self, claim: &Claim<'_>, division: &Division<'_>, now: Millis) -> Option<Move> {
        let own = division.count(claim);
        // Another priority is no way to get a worker of another group again.
        let is_entitled = !division.is_full(claim) && !self.declines(|of| of.group == claim.need.claimant.group, now);
        let can_leave = |(name, worker): (&WorkerId, &Worker)| {
            let (key, i) = worker.holds.filter(|_| worker.is_available())?;
            let execution = &self.executions[&key];
            let task = &execution.tasks[i];
            let claimant = division.claimant(&key)?;
            let count = division.held.get(&claimant.group).copied().unwrap_or_default();
            let is_spare = task.part == Part::Gang
                && matches!(task.lease, Lease::Held { drain_by: None, .. })
                && task.holders().len() > execution.range().min.max(1)
                && self.goes_on_without(task, name);
            let is_behind = match claimant.group == claim.need.claimant.group {
                true => claim.need.claimant.precedes(claimant),
                false => is_entitled && count >= own + 2,
            };
            let place = (count, Reverse(claimant.priority), task.holders().len(), key, i, name.clone());
            (is_spare && is_behind && claim.execution.takes(worker)).then_some(place)
        };
        let last = self.workers.iter().filter_map(can_leave).max();
        last.map(|(.., key, task, worker)| Move::Leave { key, task, worker })
    }

    /// Trainings of a lower priority in the claim's group. A training that has just been resumed is left out.
    fn preemptible(&self, claim: &Claim<'_>, division: &Division<'_>, now: Millis) -> Vec<Preemptible> {
        let mut found: BTreeMap<(Digest, usize), Preemptible> = BTreeMap::new();
        for worker in self.workers.values().filter(|worker| worker.is_available() && claim.execution.takes(worker)) {
            let Some((key, i)) = worker.holds else { continue };
            let execution = &self.executions[&key];
            let task = &execution.tasks[i];
            let has_stayed =
                task.attempt.0 <= 1 || execution.busy_since.is_none_or(|since| now.since(since) >= self.policy.stay_ms);
            let can_yield = task.part == Part::Gang && matches!(task.lease, Lease::Held { drain_by: None, .. });
            let Some(rank) = self.queue.rank(&key).filter(|_| can_yield && has_stayed) else { continue };
            if division.claimant(&key).is_some_and(|claimant| claim.need.claimant.precedes(claimant)) {
                let training = Preemptible { rank, key, task: i, workers: 0 };
                found.entry((key, i)).or_insert(training).workers += 1;
            }
        }
        found.into_values().collect()
    }
}
