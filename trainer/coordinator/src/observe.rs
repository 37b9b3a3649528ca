//! What is heard, and what it means. Heartbeats change only [`Heard`](crate::state::Heard); what follows from them
//! is returned as events, to be decided one by one.

use std::sync::Arc;

use protocol::message::{Doing, Poll};
use protocol::{TaskId, WorkerId};

use crate::event::{Event, Observation};
use crate::rejected::Rejected;
use crate::state::State;
use crate::state::evidence::{self, Word};
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::{Presence, Worker};
use crate::time::Millis;

/// Takes note of `observation`, which was made at `at`, and says which events follow from it.
pub fn observe(state: &mut State, at: Millis, observation: Observation) -> Result<Vec<Event>, Rejected> {
    match observation {
        Observation::Poll { worker, poll } => heard(state, at, worker, poll),
        Observation::Tick { overslept } => Ok(tick(state, at, overslept)),
    }
}

/// Whether `poll` says no more than that its worker lives and how far it is: nothing follows from it.
pub fn is_quiet(state: &State, worker: &WorkerId, poll: &Poll) -> Result<bool, Rejected> {
    let known = state.process(worker, poll.incarnation)?;
    let complains = poll.doing.iter().any(|doing| !doing.lost.is_empty());
    let divided = || poll.doing.iter().any(|doing| is_of_a_divided_gang(state, doing));
    let may_join = known.presence == Presence::Here && known.shunned.is_none();
    Ok(may_join && !complains && !is_ready_for_more(state, known, poll) && !divided())
}

/// Whether a member speaks while its gang is heard about a complaint.
fn is_of_a_divided_gang(state: &State, doing: &Doing) -> bool {
    let Ok((_, task)) = state.task(&doing.grant.task) else { return false };
    task.part == Part::Gang && task.check(&doing.grant).is_ok() && evidence::is_divided(&state.heard.words, task)
}

/// Whether the worker has what it needs for a task of which that was not known.
fn is_ready_for_more(state: &State, known: &Worker, poll: &Poll) -> bool {
    poll.ready.iter().any(|task| !known.ready.contains(task) && state.tasks.contains_key(task))
}

fn heard(state: &mut State, now: Millis, worker: WorkerId, poll: Poll) -> Result<Vec<Event>, Rejected> {
    let known = state.process(&worker, poll.incarnation)?;
    let mut events = Vec::new();
    match known.presence {
        Presence::Here if known.shunned.is_some_and(|until| until <= now) => {
            events.push(Event::WorkerBack { worker: worker.clone() });
        }
        Presence::Here => {}
        Presence::Silent => events.push(Event::WorkerBack { worker: worker.clone() }),
        Presence::Suspect { since } => {
            if now.since(since) >= state.policy.penalty_ms {
                events.push(Event::WorkerBack { worker: worker.clone() });
            }
        }
        Presence::Gone => {
            return Err(Rejected::Conflict(format!(
                "worker `{worker}` (incarnation {}) was reported gone; join again",
                poll.incarnation
            )));
        }
    }
    if is_ready_for_more(state, known, &poll) {
        let (worker, incarnation) = (worker.clone(), poll.incarnation);
        events.push(Event::WorkerReady { worker, incarnation, tasks: poll.ready });
    }
    let heard = Arc::make_mut(&mut state.heard.workers).entry(worker.clone()).or_default();
    *heard = now.max(*heard);
    for mut said in poll.doing {
        if (&said.grant.worker, said.grant.incarnation) != (&worker, poll.incarnation) {
            // A worker speaks for its own grants alone.
            continue;
        }
        let Ok((execution, task)) = state.task(&said.grant.task) else { continue };
        let Ok(rank) = task.check(&said.grant) else { continue };
        let is_gang = task.part == Part::Gang;
        // Shards are counted, not looked into.
        if rank == 0 && execution.tasks.len() == 1 {
            let progress = Arc::new(std::mem::take(&mut said.progress));
            Arc::make_mut(&mut state.heard.progress).insert(said.grant.task.clone(), progress);
        }
        if is_gang {
            let word = Word::after(state.heard.words.get(&worker), &said, now);
            Arc::make_mut(&mut state.heard.words).insert(worker.clone(), word);
            if is_of_a_divided_gang(state, &said) {
                events.push(Event::GangDivided { task: said.grant.task, fence: said.grant.fence });
            }
        }
    }
    Ok(events)
}

/// What the clock means, looked at `at`. It may be taken up later than that, when the disk is slow: a lease is measured by when it was
/// looked at, for until then polls were heard.
fn tick(state: &mut State, at: Millis, overslept: u64) -> Vec<Event> {
    let now = at.max(state.now);
    // Who sleeps through his own alarm was not listening either: that is not the workers' fault. Who was heard meanwhile all the same
    // gets no more than a lease from now. What was heard after the clock was looked at, while that waited for the disk, stays.
    let later = |then: Millis| then.after(overslept).min(at).max(then);
    if overslept > state.policy.lease_ms / 3 {
        for heard in Arc::make_mut(&mut state.heard.workers).values_mut() {
            *heard = later(*heard);
        }
        for word in Arc::make_mut(&mut state.heard.words).values_mut() {
            word.complained = word.complained.map(later);
            word.moved = later(word.moved);
        }
    }
    let mut events = Vec::new();
    let unheard: Vec<WorkerId> =
        state.workers.keys().filter(|name| !state.heard.workers.contains_key(*name)).cloned().collect();
    if !unheard.is_empty() {
        Arc::make_mut(&mut state.heard.workers).extend(unheard.into_iter().map(|name| (name, at)));
    }
    for (name, worker) in state.workers.iter() {
        let (worker, incarnation, silent) = (name.clone(), worker.incarnation, at.since(state.heard.workers[name]));
        match state.workers[name].presence {
            Presence::Here | Presence::Suspect { .. } if silent > state.policy.lease_ms => {
                events.push(Event::LeaseExpired { worker, incarnation });
            }
            Presence::Silent | Presence::Gone if silent > state.policy.forget_ms => {
                events.push(Event::WorkerForgotten { worker, incarnation });
            }
            Presence::Here | Presence::Suspect { .. } | Presence::Silent | Presence::Gone => {}
        }
    }
    let open = state
        .executions
        .values()
        .flat_map(|execution| execution.tasks.held().chain(execution.tasks.waiting()).map(|i| &execution.tasks[i]));
    for task in open {
        match task.lease {
            Lease::Waiting { not_before: Some(time) } if time <= now => {
                events.push(Event::BackoffOver { task: task.id.clone() });
            }
            Lease::Held { drain_by: Some(deadline), .. } if deadline <= now => {
                events.push(Event::GraceOver { task: task.id.clone(), fence: task.fence });
            }
            Lease::Held { .. } if task.part == Part::Gang => events.extend(gang_event(state, task, now)),
            Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. } => {}
        }
    }
    events
}

/// What the clock means for a gang: a hearing may be over, and a member may be hung.
fn gang_event(state: &State, task: &Task, now: Millis) -> Option<Event> {
    let (id, fence, words): (TaskId, _, _) = (task.id.clone(), task.fence, &state.heard.words);
    if evidence::is_divided(words, task) {
        return Some(Event::GangDivided { task: id, fence });
    }
    evidence::hung(words, task, now, state.policy.stall_ms).map(|_| Event::GangStalled { task: id, fence })
}
