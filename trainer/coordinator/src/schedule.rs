//! Who gets what. Deterministic in state and moment.
//!
//! Works are served in the order of [`State::wanted`](crate::state::State::wanted). Gangs that have become
//! too large give up members. Then plain tasks, shards and merges
//! that are ready, one worker each: they are short, and much waits for them. Then gangs that are under way take in whoever
//! is left, up to their `max`; then gangs that wait start with everybody who is left. A gang does not start while a map
//! stage that its workers could merge is almost done (its last shards are out), or the merge would wait for the whole
//! training; one that takes a single worker leaves the others to it.

use protocol::Digest;
use protocol::message::Member;
use protocol::stage::Backend;

use crate::decide::Deciding;
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::gang::{self, Change};
use crate::state::task::{Lease, Part};
use crate::state::worker::Presence;

/// Gives idle workers what is ready.
pub(crate) fn schedule(cx: &mut Deciding<'_>) {
    if cx.state.draining {
        return;
    }
    let is_open = |key: &Digest| cx.state.executions[key].state == ExecutionState::Open;
    let wanted: Vec<Digest> = cx.state.wanted().into_iter().filter(is_open).collect();
    for key in &wanted {
        change_gangs(cx, *key, |_, _| Vec::new());
    }
    for key in &wanted {
        small_tasks(cx, *key);
    }
    // With a thousand workers at work one does not look for an idle one again for each gang.
    let some_idle = |key: &Digest| idle(cx.state, cx.state.executions[key].backend).next().is_some();
    let left: Vec<Digest> = wanted.into_iter().filter(some_idle).collect();
    for key in &left {
        change_gangs(cx, *key, |state, backend| idle(state, backend).collect());
    }
    for key in &left {
        start_gangs(cx, *key);
    }
}

/// Workers of a backend that can be given work and have none, by name.
pub(crate) fn idle(state: &State, backend: Backend) -> impl Iterator<Item = Member> + '_ {
    let known = state.unused.iter().filter_map(|name| Some((name, state.workers.get(name)?)));
    let fit = known.filter(move |(_, worker)| worker.presence == Presence::Here && worker.backend == backend);
    fit.map(|(name, worker)| worker.member(name))
}

fn small_tasks(cx: &mut Deciding<'_>, key: Digest) {
    let now = cx.now();
    if is_gang(&cx.state.executions[&key]) || idle(cx.state, cx.state.executions[&key].backend).next().is_none() {
        return;
    }
    let waiting: Vec<usize> = cx.state.executions[&key].tasks.waiting().collect();
    for i in waiting {
        let execution = &cx.state.executions[&key];
        let task = &execution.tasks[i];
        if !task.is_free(now) || !execution.is_ready(task) {
            continue;
        }
        let Some(worker) = idle(cx.state, execution.backend).next() else { return };
        grant(cx, key, i, vec![worker]);
    }
}

fn is_gang(execution: &StageExecution) -> bool {
    execution.tasks.first().is_some_and(|task| task.part == Part::Gang)
}

fn change_gangs(cx: &mut Deciding<'_>, key: Digest, joiners: impl Fn(&State, Backend) -> Vec<Member>) {
    if !is_gang(&cx.state.executions[&key]) {
        return;
    }
    for i in 0..cx.state.executions[&key].tasks.len() {
        let execution = &cx.state.executions[&key];
        let task = &execution.tasks[i];
        if matches!(task.lease, Lease::Held { drain_by: None, .. }) {
            match gang::with(task.holders(), &joiners(cx.state, execution.backend), execution.placement.workers) {
                Change::Keep | Change::Disband => {}
                Change::Regroup(members) => cx.regroup(key, i, members),
            }
        }
    }
}

fn start_gangs(cx: &mut Deciding<'_>, key: Digest) {
    let now = cx.now();
    if !is_gang(&cx.state.executions[&key]) {
        return;
    }
    for i in 0..cx.state.executions[&key].tasks.len() {
        let execution = &cx.state.executions[&key];
        let task = &execution.tasks[i];
        if task.is_free(now)
            && (execution.placement.workers.max == 1 || !merge_is_near(cx.state, execution.backend))
            && let Some(members) =
                gang::start(&idle(cx.state, execution.backend).collect::<Vec<_>>(), execution.placement.workers)
        {
            grant(cx, key, i, members);
        }
    }
}

/// Whether some map stage has only shards out that are being done.
fn merge_is_near(state: &State, backend: Backend) -> bool {
    let executions =
        state.wanted().into_iter().map(|key| &state.executions[&key]).filter(|execution| execution.backend == backend);
    executions
        .flat_map(|execution| execution.tasks.held().map(|i| &execution.tasks[i]))
        .any(|task| matches!(task.part, Part::Shard { .. }))
}

fn grant(cx: &mut Deciding<'_>, key: Digest, i: usize, holders: Vec<Member>) {
    let secret = cx.secret(&cx.state.executions[&key].tasks[i]);
    let resumed = cx.state.executions[&key].tasks[i].newest().is_some();
    cx.state.execution_mut(key).resumed |= resumed;
    let fence = cx.state.change(key, i, |task| task.grant(holders, secret));
    cx.fences.push(fence);
}
