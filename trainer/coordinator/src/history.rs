//! Entries of the store's history: facts, worded for later readers.
//!
//! An entry follows from a fact and the state before it, so every state change has an entry.

use std::collections::BTreeSet;

use protocol::WorkerId;
use protocol::message::{Member, RunState};
use registry::{HistoryEntry, HistoryKind};

use crate::fact::{Fact, TaskChange};
use crate::state::State;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::task::{Lease, Task};
use crate::state::worker::{Presence, Worker};

/// Entries of a fact that is about to become true in `state`. `why` is the reason that the decision gives, where it has one.
pub(crate) fn of(state: &State, fact: &Fact, why: Option<&str>) -> Vec<HistoryEntry> {
    match fact {
        // One that had ended is taken up again; its new state follows.
        Fact::Run { run } if run.state.is_final() => Vec::new(),
        Fact::Run { run } => {
            let entry = HistoryEntry::new(HistoryKind::Submitted);
            vec![HistoryEntry { run: Some(run.id.clone()), actor: Some(run.owner.to_string()), ..entry }]
        }
        Fact::RunState { run, state: now, parked } => {
            let Some(run) = state.runs.get(run).filter(|run| run.state != *now) else { return Vec::new() };
            let (kind, why) = match now {
                RunState::Running => (HistoryKind::Resumed, None),
                RunState::Paused if *parked => (HistoryKind::Paused, Some("the server was started again")),
                RunState::Paused => (HistoryKind::Paused, None),
                RunState::Finished => (HistoryKind::Ended, Some("finished")),
                RunState::Failed => (HistoryKind::Ended, Some("failed")),
                RunState::Cancelled => (HistoryKind::Ended, Some("cancelled")),
            };
            vec![HistoryEntry { run: Some(run.id.clone()), why: why.map(str::to_owned), ..HistoryEntry::new(kind) }]
        }
        Fact::Worker { worker, process } => {
            let entry = of_worker(state.workers.get(worker), process);
            entry.map(|entry| HistoryEntry { worker: Some(worker.clone()), ..entry }).into_iter().collect()
        }
        Fact::Task { key, task, change } => {
            let Some(execution) = state.executions.get(key) else { return Vec::new() };
            of_task(execution, &execution.tasks[*task], change, why)
        }
        Fact::ExecutionState { key, state: now } => {
            let Some(execution) = state.executions.get(key) else { return Vec::new() };
            let (kind, why) = match now {
                ExecutionState::Done { cached: false, .. } if !execution.resolves => (HistoryKind::Finished, None),
                ExecutionState::Failed { message, .. } => (HistoryKind::Failed, Some(message.clone())),
                ExecutionState::Done { .. }
                | ExecutionState::Looking
                | ExecutionState::Open
                | ExecutionState::Mending { .. }
                | ExecutionState::Bundling => return Vec::new(),
            };
            vec![HistoryEntry { why, ..about(execution, kind) }]
        }
        Fact::Stages { .. }
        | Fact::RunQueued { .. }
        | Fact::Resolved { .. }
        | Fact::StagesAdded { .. }
        | Fact::SweepBegun { .. }
        | Fact::SweepMoved { .. }
        | Fact::RunForgotten { .. }
        | Fact::Execution { .. }
        | Fact::ExecutionPlacement { .. }
        | Fact::ExecutionSource { .. }
        | Fact::ExecutionTime { .. }
        | Fact::ExecutionResumed { .. }
        | Fact::ExecutionInstructions { .. }
        | Fact::Tasks { .. }
        | Fact::ExecutionForgotten { .. }
        | Fact::WorkerForgotten { .. }
        | Fact::Draining { .. } => Vec::new(),
    }
}

pub(crate) fn about(execution: &StageExecution, kind: HistoryKind) -> HistoryEntry {
    let run = Some(execution.run.clone());
    let stage = Some(execution.stage.clone());
    HistoryEntry { run, stage, ..HistoryEntry::new(kind) }
}

fn of_worker(before: Option<&Worker>, after: &Worker) -> Option<HistoryEntry> {
    let entry = |kind, why: Option<&str>| Some(HistoryEntry { why: why.map(str::to_owned), ..HistoryEntry::new(kind) });
    let Some(before) = before.filter(|before| before.incarnation == after.incarnation) else {
        let actor = after.identity.as_ref().map(|identity| identity.caller.clone());
        return Some(HistoryEntry { actor, ..HistoryEntry::new(HistoryKind::Joined) });
    };
    match (before.presence, after.presence) {
        (Presence::Here | Presence::Suspect { .. }, Presence::Silent) => {
            entry(HistoryKind::Lost, Some("it was silent until its lease expired"))
        }
        (Presence::Here, Presence::Suspect { .. }) => {
            entry(HistoryKind::Lost, Some("its peers reported it as unusable"))
        }
        (Presence::Here | Presence::Suspect { .. } | Presence::Silent, Presence::Gone) => {
            entry(HistoryKind::Left, None)
        }
        (Presence::Suspect { .. } | Presence::Silent | Presence::Gone, Presence::Here) => {
            entry(HistoryKind::Returned, None)
        }
        (Presence::Here, Presence::Here)
        | (Presence::Suspect { .. } | Presence::Silent, Presence::Suspect { .. })
        | (Presence::Silent, Presence::Silent)
        | (Presence::Gone, Presence::Suspect { .. } | Presence::Silent | Presence::Gone) => None,
    }
}

fn of_task(execution: &StageExecution, task: &Task, change: &TaskChange, why: Option<&str>) -> Vec<HistoryEntry> {
    let attempt = Some(change.attempt.unwrap_or(task.attempt).0);
    let entry = |kind| HistoryEntry { task: Some(task.id.clone()), attempt, ..about(execution, kind) };
    let of = |kind, worker: &WorkerId| HistoryEntry { worker: Some(worker.clone()), ..entry(kind) };
    let mut entries = Vec::new();
    for saved in &change.saved {
        entries.push(HistoryEntry { step: Some(saved.step), ..entry(HistoryKind::Checkpoint) });
    }
    match (&task.lease, &change.now) {
        (Lease::Waiting { .. }, Some(Lease::Held { holders, .. })) => {
            let step = task.checkpoints.iter().map(|saved| saved.step).max();
            let granted = |member: &Member| HistoryEntry { step, ..of(HistoryKind::Granted, &member.worker) };
            entries.extend(holders.iter().map(granted));
        }
        (Lease::Held { holders: before, .. }, Some(Lease::Held { holders: after, .. })) => {
            let names = |members: &[Member]| members.iter().map(|m| m.worker.clone()).collect::<BTreeSet<_>>();
            let before = names(before);
            let after = names(after);
            let join = |names: Vec<&WorkerId>| names.iter().map(|name| name.as_str()).collect::<Vec<_>>().join(", ");
            let (gone, come) =
                (before.difference(&after).collect::<Vec<_>>(), after.difference(&before).collect::<Vec<_>>());
            entries.extend(come.iter().map(|worker| of(HistoryKind::Adopted, worker)));
            let why = match (gone.is_empty(), come.is_empty()) {
                (true, true) => return entries,
                (true, false) => format!("with {}", join(come)),
                (false, true) => format!("without {}", join(gone)),
                (false, false) => format!("without {}, with {}", join(gone), join(come)),
            };
            entries.push(HistoryEntry { why: Some(why), ..entry(HistoryKind::Regrouped) });
        }
        // The stage's failure says it.
        (Lease::Held { .. }, Some(Lease::Waiting { .. }))
            if matches!(execution.state, ExecutionState::Failed { .. }) => {}
        (Lease::Held { holders, .. }, Some(Lease::Waiting { .. })) => {
            let kind = if why.is_some() { HistoryKind::Retried } else { HistoryKind::Released };
            let why = why.or(task.is_preempted().then_some("made way for a run of a higher priority"));
            let worker = holders.first().filter(|_| holders.len() == 1).map(|member| member.worker.clone());
            entries.push(HistoryEntry { worker, why: why.map(str::to_owned), ..entry(kind) });
        }
        (
            Lease::Waiting { .. } | Lease::Held { .. } | Lease::Done { .. },
            None | Some(Lease::Waiting { .. } | Lease::Done { .. }),
        )
        | (Lease::Done { .. }, Some(Lease::Held { .. })) => {}
    }
    entries
}
