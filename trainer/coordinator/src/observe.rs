//! Processing of observations. Heartbeats change only [`Heard`](crate::state::Heard); their consequences are returned
//! as events, to be decided one by one.

use std::collections::BTreeSet;
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

/// Notes `observation`, made at `at`, and returns the resulting events.
pub fn observe(state: &mut State, at: Millis, observation: Observation) -> Result<Vec<Event>, Rejected> {
    match observation {
        Observation::Poll { worker, poll } => heard(state, at, worker, poll),
        Observation::Tick { overslept } => Ok(tick(state, at, overslept)),
    }
}

/// Returns true if `poll` reports only liveness and progress, so that nothing follows from it.
pub fn is_quiet(state: &State, worker: &WorkerId, poll: &Poll) -> Result<bool, Rejected> {
    let known = state.process(worker, poll.incarnation)?;
    let complains = poll.doing.iter().any(|doing| !doing.lost.is_empty());
    let divided = || poll.doing.iter().any(|doing| is_of_a_divided_gang(state, doing));
    let may_join = known.presence == Presence::Here && known.shunned.is_none();
    let leaves = poll.leaving && !known.leaving;
    Ok(may_join && !leaves && !complains && !is_ready_for_more(state, known, poll) && !divided())
}

/// Returns true if the gang of a reporting member is being heard about a complaint.
fn is_of_a_divided_gang(state: &State, doing: &Doing) -> bool {
    let Ok((_, task)) = state.task(&doing.grant.task) else { return false };
    task.part == Part::Gang && task.check(&doing.grant).is_ok() && evidence::is_divided(&state.heard.words, task)
}

/// Returns true if the worker newly has the inputs of a known task.
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
    if poll.leaving && !known.leaving {
        events.push(Event::WorkerLeaves { worker: worker.clone(), incarnation: poll.incarnation });
    }
    if is_ready_for_more(state, known, &poll) {
        let worker = worker.clone();
        let incarnation = poll.incarnation;
        events.push(Event::WorkerReady { worker, incarnation, tasks: poll.ready });
    }
    let before = state.heard.workers.get(&worker).copied().unwrap_or_default();
    state.heard.workers.insert_mut(worker.clone(), now.max(before));
    for mut said in poll.doing {
        if (&said.grant.worker, said.grant.incarnation) != (&worker, poll.incarnation) {
            // A worker may report only on its own grants.
            continue;
        }
        let Ok((execution, task)) = state.task(&said.grant.task) else { continue };
        let Ok(rank) = task.check(&said.grant) else { continue };
        let is_gang = task.part == Part::Gang;
        let known_peak = state.heard.memory.get(&said.grant.task).copied();
        let new_peak = said.peak_memory.filter(|peak| known_peak.is_none_or(|known| *peak > known));
        // Progress of shards is only counted, not shown one by one.
        if rank == 0 && execution.tasks.len() == 1 {
            let progress = Arc::new(std::mem::take(&mut said.progress));
            state.heard.progress.insert_mut(said.grant.task.clone(), progress);
        }
        if let Some(peak) = new_peak {
            state.heard.memory.insert_mut(said.grant.task.clone(), peak);
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

/// Handles a tick of the timer, which fired at `at`. A slow disk may delay the handling. Leases are measured at `at`,
/// because polls were received until then.
fn tick(state: &mut State, at: Millis, overslept: u64) -> Vec<Event> {
    let now = at.max(state.now);
    // If this process overslept, it could not receive polls, which is not the workers' fault: their deadlines move by
    // the same time. Workers that polled meanwhile get at most one full lease from `at`. Polls received after `at`,
    // while this tick waited for the disk, stay unchanged.
    let later = |then: Millis| then.after(overslept).min(at).max(then);
    if overslept > state.policy.lease_ms / 3 {
        state.heard.workers = state.heard.workers.iter().map(|(name, heard)| (name.clone(), later(*heard))).collect();
        for word in Arc::make_mut(&mut state.heard.words).values_mut() {
            word.complained = word.complained.map(later);
            word.moved = later(word.moved);
        }
    }
    let mut events = Vec::new();
    let mut unheard = Vec::new();
    for (name, worker) in state.workers.iter() {
        let Some(heard) = state.heard.workers.get(name) else {
            unheard.push(name.clone());
            continue;
        };
        let (silent, incarnation) = (at.since(*heard), worker.incarnation);
        match worker.presence {
            Presence::Here | Presence::Suspect { .. } if silent > state.policy.lease_ms => {
                events.push(Event::LeaseExpired { worker: name.clone(), incarnation });
            }
            Presence::Silent | Presence::Gone if silent > state.policy.forget_ms => {
                events.push(Event::WorkerForgotten { worker: name.clone(), incarnation });
            }
            Presence::Here | Presence::Suspect { .. } | Presence::Silent | Presence::Gone => {}
        }
    }
    for name in unheard {
        state.heard.workers.insert_mut(name, at);
    }
    let due = state.queue.due(now).filter_map(|key| state.executions.get(&key));
    let due = due.flat_map(|execution| execution.tasks.due(now).map(|i| &execution.tasks[i]));
    for task in due {
        match task.lease {
            Lease::Waiting { not_before: Some(time) } if time <= now => {
                events.push(Event::BackoffOver { task: task.id.clone() });
            }
            Lease::Held { drain_by: Some(deadline), .. } if deadline <= now => {
                events.push(Event::GraceOver { task: task.id.clone(), fence: task.fence });
            }
            Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. } => {}
        }
    }
    if state.next_move(now).is_some() || state.share_is_over(now) {
        events.push(Event::Unshared);
    }
    // Gangs come from the reports of their members, so that waiting runs cost nothing here.
    let reported: BTreeSet<&TaskId> = state.heard.words.values().map(|word| &word.grant.task).collect();
    for id in reported {
        let Ok((_, task)) = state.task(id) else { continue };
        let is_over = |drain_by: Option<Millis>| drain_by.is_some_and(|deadline| deadline <= now);
        if task.part == Part::Gang && matches!(task.lease, Lease::Held { drain_by, .. } if !is_over(drain_by)) {
            events.extend(gang_event(state, task, now));
        }
    }
    events
}

/// The event due for a gang: a hearing may be over, or a member may be hung.
fn gang_event(state: &State, task: &Task, now: Millis) -> Option<Event> {
    let (id, fence, words): (TaskId, _, _) = (task.id.clone(), task.fence, &state.heard.words);
    if evidence::is_divided(words, task) {
        return Some(Event::GangDivided { task: id, fence });
    }
    evidence::hung(words, task, now, state.policy.stall_ms).map(|_| Event::GangStalled { task: id, fence })
}
