//! Who gets what. Deterministic in state and moment; what was given stays given, whatever this file says in a later build.
//!
//! Executions are served in the order of [`State::wanted`](crate::state::State::wanted). Gangs that have become
//! too large give up members. Then plain tasks, shards and merges
//! that are ready, one worker each: they are short, and much waits for them. Then gangs that are under way take in whoever
//! is left, up to their `max`; then gangs that wait start with everybody who is left. A gang does not start while a map
//! stage that its workers could merge is almost done (its last shards are out), or the merge would wait for the whole
//! training; one that takes a single worker leaves the others to it.

use protocol::Digest;
use protocol::message::Member;
use protocol::stage::Backend;

use crate::decide::Deciding;
use crate::policy::GrantOrder;
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::gang::{self, Change};
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::Presence;

/// Gives idle workers what is ready.
pub(crate) fn schedule(cx: &mut Deciding<'_>) {
    if cx.state.draining {
        return;
    }
    let is_open = |state: &State, key: &Digest| {
        state.executions.get(key).is_some_and(|execution| execution.state == ExecutionState::Open)
    };
    // A gang is too large only once another run asks for fewer, which touches it.
    for key in cx.touched.clone() {
        if is_open(cx.state, &key) {
            change_gangs(cx, key, |_, _, _| Vec::new());
        }
    }
    // Mostly everybody is at work, and nothing else is looked at.
    if !cx.state.unused.iter().any(|name| cx.state.workers.get(name).is_some_and(|w| w.presence == Presence::Here)) {
        return;
    }
    let wanted: Vec<Digest> = cx.state.wanted().into_iter().filter(|key| is_open(cx.state, key)).collect();
    cx.state.visits += wanted.len() as u64;
    for key in &wanted {
        small_tasks(cx, *key);
    }
    // With a thousand workers at work one does not look for an idle one again for each gang.
    let some_idle = |key: &Digest| idle(cx.state, cx.state.executions[key].backend).next().is_some();
    let left: Vec<Digest> = wanted.into_iter().filter(some_idle).collect();
    for key in &left {
        change_gangs(cx, *key, fit);
    }
    for key in &left {
        start_gangs(cx, *key);
    }
}

/// Workers of a backend that can be given work and have none, in the order in which they are served.
pub(crate) fn idle(state: &State, backend: Backend) -> impl Iterator<Item = Member> + '_ {
    let mut names = state.unused.iter();
    let in_order = std::iter::from_fn(move || match state.policy.grants {
        GrantOrder::ByName => names.next(),
        GrantOrder::ByNameBackwards => names.next_back(),
    });
    let known = in_order.filter_map(|name| Some((name, state.workers.get(name)?)));
    let fit = known.filter(move |(_, worker)| worker.presence == Presence::Here && worker.backend == backend);
    fit.map(|(name, worker)| worker.member(name))
}

/// Those of them that have memory enough for a task, as far as is known.
fn fit(state: &State, backend: Backend, task: &Task) -> Vec<Member> {
    idle(state, backend).filter(|member| !task.too_small.contains(&member.worker)).collect()
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

fn change_gangs(cx: &mut Deciding<'_>, key: Digest, joiners: impl Fn(&State, Backend, &Task) -> Vec<Member>) {
    if !is_gang(&cx.state.executions[&key]) {
        return;
    }
    for i in 0..cx.state.executions[&key].tasks.len() {
        let execution = &cx.state.executions[&key];
        let task = &execution.tasks[i];
        if matches!(task.lease, Lease::Held { drain_by: None, .. }) {
            match gang::with(task.holders(), &joiners(cx.state, execution.backend, task), execution.range()) {
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
            && (execution.range().max == 1 || !merge_is_near(cx.state, execution.backend))
            && let Some(members) = gang::start(&fit(cx.state, execution.backend, task), execution.range())
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
    if cx.state.executions[&key].tasks[i].newest().is_some() {
        cx.resumed(key);
    }
    let fence = cx.change(key, i, |task| task.grant(holders, secret));
    cx.fences.push(fence);
}
