//! Fair shares: workers are divided evenly among the groups whose work waits for them.
//!
//! A group is a project, or a token without one. Each idle worker belongs to the group with the fewest workers that
//! could use it. A group that has at least two workers more than another one gives up a member of a gang, above the
//! gang's minimum. Gangs change their members without loss, so this costs a regroup. The work of one group alone is
//! served in its order, without shares.
//!
//! A group whose worker stays idle for longer than [`Policy::share_ms`](crate::policy::Policy::share_ms), for instance
//! because it cannot fetch the inputs, loses its claim to it. For [`Policy::share_again_ms`](crate::policy::Policy::share_again_ms),
//! no gang gives up a member for that group.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{Digest, Group, WorkerId};

use super::deciding::Deciding;
use crate::demand::slots;
use crate::policy::Policy;
use crate::state::execution::StageExecution;
use crate::state::queue::{Need, Rank};
use crate::state::task::{Lease, Part};
use crate::state::worker::Worker;
use crate::state::{Idle, State};
use crate::time::Millis;

/// Executions of one need whose room for workers is added up.
const COUNTED: usize = 64;

/// The idle workers of each group.
#[derive(Debug, Default)]
pub(crate) struct Shares {
    /// The work of several groups waits.
    are_divided: bool,
    kept_for: BTreeMap<WorkerId, Group>,
}

/// Work of a group that waits for workers.
struct Claim<'a> {
    need: &'a Need,
    rank: Rank,
    execution: &'a StageExecution,
    /// Number of workers that it could use now.
    room: u64,
}

impl Shares {
    /// Divides the workers that are idle at `now`.
    pub(crate) fn of(state: &State, now: Millis) -> Self {
        let mut claims = claims(state);
        let groups: BTreeSet<&Group> = claims.iter().map(|claim| &claim.need.group).collect();
        if groups.len() < 2 {
            return Self::default();
        }
        Self { are_divided: true, kept_for: divided(state, now, &mut claims, &mut held(state)) }
    }

    /// Returns true if workers are divided.
    pub(crate) fn are_divided(&self) -> bool {
        self.are_divided
    }

    /// The group that a worker is kept for.
    pub(crate) fn owner(&self, worker: &WorkerId) -> Option<&Group> {
        self.kept_for.get(worker)
    }

    /// Returns true if work of `group` may take an idle worker.
    pub(crate) fn allow(&self, worker: &WorkerId, group: &Group) -> bool {
        self.kept_for.get(worker).is_none_or(|owner| owner == group)
    }
}

impl Deciding<'_> {
    /// Takes members from gangs of groups with many workers, for groups with few. Returns true if it took one, or if an
    /// idle worker is no longer kept.
    pub(crate) fn share(&mut self) -> bool {
        let mut taken = self.state.share_is_over(self.now());
        while let Some((key, i, worker)) = self.state.member_to_give(self.now()) {
            taken = true;
            self.state.visits += 1;
            let members = self.state.executions[&key].tasks[i].holders().iter();
            let left = members.filter(|member| member.worker != worker).cloned().collect();
            tracing::info!(%worker, task = %self.state.executions[&key].tasks[i].id, "leaves its gang for another group's work");
            self.regroup(key, i, left);
        }
        taken
    }
}

impl State {
    /// The member of a gang that waiting work of another group should get.
    pub(crate) fn member_to_give(&self, now: Millis) -> Option<(Digest, usize, WorkerId)> {
        let mut claims = claims(self);
        claims.retain(|claim| !self.declines(&claim.need.group, now));
        if claims.is_empty() {
            return None;
        }
        let mut held = held(self);
        let most = held.values().copied().max().unwrap_or_default();
        let is_short = |claim: &Claim<'_>| held.get(&claim.need.group).copied().unwrap_or_default() + 2 <= most;
        if !claims.iter().any(is_short) {
            return None;
        }
        // Idle workers count as those of the group that is going to use them.
        let idle = divided(self, now, &mut claims, &mut held);
        claims.sort_by_key(|claim| (held.get(&claim.need.group).copied().unwrap_or_default(), claim.rank));
        claims.iter().filter(|claim| claim.room > 0).find_map(|claim| {
            let coming = idle.iter().filter(|(name, group)| {
                **group == claim.need.group
                    && self.workers.get(name).is_some_and(|worker| claim.execution.takes(worker))
            });
            // Gives one worker at a time, or as many as the work needs to begin.
            if coming.count() >= claim.execution.range().min.max(1) {
                return None;
            }
            let own = held.get(&claim.need.group).copied().unwrap_or_default();
            self.giver(claim, own, &held)
        })
    }

    /// Returns true if a group has let a worker idle for too long and this is not noted yet.
    pub(crate) fn share_is_over(&self, now: Millis) -> bool {
        self.kept_idle().any(|idle| {
            let end = idle.since.after(self.policy.share_ms);
            let is_noted = |group| self.heard.declined.get(group).is_some_and(|at| *at > end);
            now > end && idle.kept_for.as_ref().is_some_and(|group| !is_noted(group))
        })
    }

    /// The workers that are idle and here. One that fell silent is not at its group's disposal.
    fn kept_idle(&self) -> impl Iterator<Item = &Idle> {
        let is_here = |name: &&WorkerId| self.workers.get(name).is_some_and(Worker::is_available);
        self.unused.iter().filter(is_here).filter_map(|name| self.heard.idle.get(name))
    }

    /// Returns true if the group has lately let a worker idle that was kept for it.
    fn declines(&self, group: &Group, now: Millis) -> bool {
        let Policy { share_ms, share_again_ms, .. } = self.policy;
        let lately = self.heard.declined.get(group).is_some_and(|at| now.since(*at) < share_again_ms);
        let is_unused = |idle: &Idle| idle.kept_for.as_ref() == Some(group) && now.since(idle.since) > share_ms;
        lately || self.kept_idle().any(is_unused)
    }

    /// A member that a gang can spare for `claim`, whose group has `own` workers: of the group with the most workers.
    fn giver(&self, claim: &Claim<'_>, own: usize, held: &BTreeMap<Group, usize>) -> Option<(Digest, usize, WorkerId)> {
        let can_give = |(name, worker): (&WorkerId, &Worker)| {
            let (key, i) = worker.holds.filter(|_| worker.is_available())?;
            let execution = &self.executions[&key];
            let task = &execution.tasks[i];
            let group = self.group_of(execution)?;
            let count = held.get(&group).copied().unwrap_or_default();
            let spare = task.part == Part::Gang
                && matches!(task.lease, Lease::Held { drain_by: None, .. })
                && task.holders().len() > execution.range().min.max(1)
                && self.goes_on_without(task, name);
            let fits = group != claim.need.group && count >= own + 2 && claim.execution.takes(worker);
            (spare && fits).then(|| (count, task.holders().len(), key, i, name.clone()))
        };
        let given = self.workers.iter().filter_map(can_give).max();
        given.map(|(_, _, key, i, name)| (key, i, name))
    }

    /// The group for which an execution is computed: that of the first run that waits for it.
    fn group_of(&self, execution: &StageExecution) -> Option<Group> {
        let first = self.queue.rank(&execution.key).and_then(|rank| self.runs.get(&rank.run));
        first.or_else(|| self.registrant(execution)).map(|run| run.owner.group())
    }
}

/// The first waiting work of each need.
fn claims(state: &State) -> Vec<Claim<'_>> {
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

/// Number of workers of each group.
fn held(state: &State) -> BTreeMap<Group, usize> {
    let mut by_execution: BTreeMap<Digest, usize> = BTreeMap::new();
    for (key, _) in state.workers.values().filter_map(|worker| worker.holds) {
        *by_execution.entry(key).or_default() += 1;
    }
    let mut held = BTreeMap::new();
    for (key, count) in by_execution {
        if let Some(group) = state.group_of(&state.executions[&key]) {
            *held.entry(group).or_default() += count;
        }
    }
    held
}

/// Gives each idle worker to the claim of the group with the fewest workers, and counts it as that group's.
fn divided(
    state: &State,
    now: Millis,
    claims: &mut [Claim<'_>],
    held: &mut BTreeMap<Group, usize>,
) -> BTreeMap<WorkerId, Group> {
    let mut given = BTreeMap::new();
    for name in &state.unused {
        let Some(worker) = state.workers.get(name).filter(|worker| worker.is_available()) else { continue };
        let idle_ms = state.heard.idle.get(name).map_or(0, |idle| now.since(idle.since));
        if idle_ms > state.policy.share_ms {
            continue;
        }
        let fits = |claim: &&mut Claim<'_>| claim.room > 0 && claim.execution.takes(worker);
        let count = |claim: &Claim<'_>| held.get(&claim.need.group).copied().unwrap_or_default();
        let Some(claim) = claims.iter_mut().filter(fits).min_by_key(|claim| (count(claim), claim.rank)) else {
            continue;
        };
        claim.room -= 1;
        *held.entry(claim.need.group.clone()).or_default() += 1;
        given.insert(name.clone(), claim.need.group.clone());
    }
    given
}
