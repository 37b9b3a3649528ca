//! Who gets what. Deterministic in state and moment.
//!
//! Works are served in the order of [`State::wanted`](crate::state::State::wanted). Gangs that have become
//! too large give up members. Then plain tasks, shards and merges
//! that are ready, one worker each: they are short, and much waits for them. Then gangs that are under way take in whoever
//! is left, up to their `max`; then gangs that wait start with everybody who is left. A gang does not start while a map
//! stage that its workers could merge is almost done (its last shards are out), or the merge would wait for the whole
//! training; one that takes a single worker leaves the others to it.

use std::collections::HashSet;

use protocol::message::Member;
use protocol::stage::Backend;
use protocol::{Digest, WorkerId};

use crate::decide::Deciding;
use crate::state::State;
use crate::state::gang::{self, Change};
use crate::state::task::{Hold, Part};
use crate::state::work::WorkState;
use crate::state::worker::Presence;

/// Gives idle workers what is ready.
pub(crate) fn schedule(cx: &mut Deciding<'_>) {
    if cx.state.draining {
        return;
    }
    let is_open = |key: &Digest| cx.state.works[key].state == WorkState::Open;
    let wanted: Vec<Digest> = cx.state.wanted().into_iter().filter(is_open).collect();
    for key in &wanted {
        change_gangs(cx, *key, |_, _| Vec::new());
    }
    // Backends whose workers are all busy: with a thousand of them one does not look again for each work.
    let mut spent: Vec<Backend> = Vec::new();
    for key in &wanted {
        let backend = cx.state.works[key].backend;
        if !spent.contains(&backend) && !small_tasks(cx, *key) {
            spent.push(backend);
        }
    }
    let mut backends: Vec<Backend> = wanted.iter().map(|key| cx.state.works[key].backend).collect();
    backends.dedup();
    for backend in backends {
        if !spent.contains(&backend) && idle(cx.state, backend).is_empty() {
            spent.push(backend);
        }
    }
    let left: Vec<Digest> = wanted.into_iter().filter(|key| !spent.contains(&cx.state.works[key].backend)).collect();
    for key in &left {
        change_gangs(cx, *key, idle);
    }
    for key in &left {
        start_gangs(cx, *key);
    }
}

/// Workers of a backend that can be given work and have none, by name.
pub(crate) fn idle(state: &State, backend: Backend) -> Vec<Member> {
    let busy: HashSet<&WorkerId> = state
        .works
        .values()
        .flat_map(|work| &work.tasks)
        .flat_map(|task| task.holders())
        .map(|member| &member.worker)
        .collect();
    state
        .workers
        .iter()
        .filter(|(name, w)| w.presence == Presence::Here && w.backend == backend && !busy.contains(name))
        .map(|(name, worker)| worker.member(name))
        .collect()
}

/// `false`: there is nobody left to give anything to.
fn small_tasks(cx: &mut Deciding<'_>, key: Digest) -> bool {
    let now = cx.now();
    for i in 0..cx.state.works[&key].tasks.len() {
        let work = &cx.state.works[&key];
        let task = &work.tasks[i];
        if task.part == Part::Gang || !task.is_free(now) || !work.is_ready(task) {
            continue;
        }
        let Some(worker) = idle(cx.state, work.backend).into_iter().next() else { return false };
        grant(cx, key, i, vec![worker]);
    }
    true
}

fn change_gangs(cx: &mut Deciding<'_>, key: Digest, joiners: impl Fn(&State, Backend) -> Vec<Member>) {
    for i in 0..cx.state.works[&key].tasks.len() {
        let work = &cx.state.works[&key];
        let task = &work.tasks[i];
        let under_way = matches!(task.hold, Hold::Held { winding: None, .. });
        if task.part == Part::Gang && under_way {
            match gang::with(task.holders(), &joiners(cx.state, work.backend), work.placement.workers) {
                Change::Keep | Change::Disband => {}
                Change::Regroup(members) => cx.regroup(key, i, members),
            }
        }
    }
}

fn start_gangs(cx: &mut Deciding<'_>, key: Digest) {
    let now = cx.now();
    for i in 0..cx.state.works[&key].tasks.len() {
        let work = &cx.state.works[&key];
        let task = &work.tasks[i];
        if task.part == Part::Gang
            && task.is_free(now)
            && (work.placement.workers.max == 1 || !merge_is_near(cx.state, work.backend))
            && let Some(members) = gang::start(&idle(cx.state, work.backend), work.placement.workers)
        {
            grant(cx, key, i, members);
        }
    }
}

/// Whether some map stage has only shards out that are being done.
fn merge_is_near(state: &State, backend: Backend) -> bool {
    state.works.values().filter(|work| work.backend == backend).any(|work| {
        work.tasks.iter().any(|task| matches!(task.part, Part::Shard { .. }) && task.is_held())
            && state.wanted().contains(&work.key)
    })
}

fn grant(cx: &mut Deciding<'_>, key: Digest, i: usize, holders: Vec<Member>) {
    let secret = cx.secret(&cx.state.works[&key].tasks[i]);
    let work = cx.state.work_mut(key);
    let task = &mut work.tasks[i];
    work.resumed |= task.newest().is_some();
    let fence = task.grant(holders, secret);
    cx.fences.push(fence);
}
