//! Numbered invariants that hold after every event. Debug builds of the server check them after each event, the
//! simulation after each step. `ARCHITECTURE.md` refers to the numbers.
//!
//! | | invariant |
//! |---|---|
//! | C1 | A worker holds at most one task. |
//! | C2 | The holder of a task is the newest process of its name and has presence `Here`. It computes on the execution's backend, with the instruction set of the other holders. |
//! | C3 | Only tasks of open executions are held; a held task has an attempt and a fence. |
//! | C4 | A gang has at most `max` members, each once, and at least one; other tasks have one holder. |
//! | C5 | Fences, attempts and incarnations never decrease; a change of a task's holders raises its fence. |
//! | C6 | An accepted artifact of a task, and a done stage of a run, never change. |
//! | C7 | A merge is held only after all shards are done. |
//! | C8 | Tasks that no running run waits for are asked to drain. |
//! | C9 | A stage is active or done only if all of its inputs are done; an active stage has an execution that is not over, and what is made again for it is in memory. |
//! | C10 | A run is finished exactly if all requested stages are done, and failed only with a failed stage. |
//! | C11 | While a small task is ready and not in back-off, no worker of its backend that is in its group's share is idle. |
//! | C12 | The steps of a task's checkpoints increase. |
//! | C13 | A stage in state `Sweeping` has a searcher that is not over, and an index for each of its tickets. |
//! | C14 | Derived data agrees with its source: held and waiting tasks, indexes of tasks, tasks of workers, unused workers, active stages, users of executions, order of service. |
//! | C15 | Memory has no ended run, and no execution that is both idle and unused by runs. |
//! | C16 | Data that must survive a restart changes only together with a write. |
//! | C17 | A gang with a polling member that holds the state keeps such a member, unless a member reports or the gang was asked to drain. |

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use protocol::message::{Member, RunState};

use crate::decide::schedule;
use crate::decide::shares::Shares;
use crate::state::State;
use crate::state::evidence;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::run::{Run, Status};
use crate::state::shared::Map;
use crate::state::task::{Lease, Part, Task};
use crate::state::worker::{Presence, Worker};

/// Invariants that `state` violates, each with its number; empty if there are none.
pub fn check(state: &State) -> Vec<String> {
    let mut broken = check_index(state);
    let shares = Shares::of(state, state.now);
    let mut busy = BTreeSet::new();
    let wanted: BTreeSet<_> = state.wanted().into_iter().collect();
    for execution in state.executions.values() {
        for task in &execution.tasks {
            check_task(state, execution, task, &mut broken);
            for member in task.holders() {
                if !busy.insert(&member.worker) {
                    broken.push(format!("C1: worker `{}` holds `{}` and another task", member.worker, task.id));
                }
            }
            let drain_by = match task.lease {
                Lease::Held { drain_by, .. } => drain_by.is_some(),
                Lease::Waiting { .. } | Lease::Done { .. } => true,
            };
            if !drain_by && (!wanted.contains(&execution.key) || state.draining) {
                broken.push(format!("C8: no run waits for `{}`, which is not draining", task.id));
            }
            let small =
                task.part != Part::Gang && execution.state == ExecutionState::Open && wanted.contains(&execution.key);
            if small && !state.draining && task.is_free(state.now) && execution.is_ready(task) {
                let idle: Vec<_> = schedule::allowed(state, &shares, execution).collect();
                if !idle.is_empty() {
                    broken.push(format!("C11: `{}` is ready and {idle:?} idle", task.id));
                }
            }
        }
    }
    for run in state.runs.values() {
        check_run(state, run, &mut broken);
    }
    broken
}

/// Checks a run and its stages: C9, C10, C13 and C15.
fn check_run(state: &State, run: &Run, broken: &mut Vec<String>) {
    if run.state.is_final() {
        broken.push(format!("C15: `{}` is {:?} and still in memory", run.id, run.state));
    }
    for (i, status) in run.stages.iter().enumerate() {
        if matches!(status, Status::Active { .. } | Status::Done { .. }) && run.inputs(i).is_none() {
            broken.push(format!("C9: stage {i} of `{}` runs without its inputs", run.id));
        }
        if let Status::Active { key } = status
            && state.executions.get(key).is_none_or(|execution| execution.is_over())
        {
            broken.push(format!("C9: stage {i} of `{}` is active and its execution is over", run.id));
        }
    }
    let failed = run.failed().is_some();
    let open = |status: &Status| matches!(status, Status::Waiting | Status::Sweeping | Status::Active { .. });
    let open = run.stages.iter().any(open);
    for (i, status) in run.stages.iter().enumerate().filter(|(_, status)| **status == Status::Sweeping) {
        if run.sweep(i).is_none_or(|sweep| sweep.search.is_over() || sweep.places.len() != sweep.search.tickets().len())
        {
            broken.push(format!("C13: stage {i} of `{}` is {status:?}, and its searcher is not", run.id));
        }
    }
    let fits = match run.state {
        RunState::Running | RunState::Paused => !failed && open,
        RunState::Finished => !failed && !open,
        RunState::Failed => failed && !open,
        RunState::Cancelled => !open,
    };
    if !fits {
        broken.push(format!("C10: `{}` is {:?} with stages {:?}", run.id, run.state, run.stages));
    }
}

/// C14: indexes agree with the tasks, workers and runs that they index.
fn check_index(state: &State) -> Vec<String> {
    let mut broken = Vec::new();
    let mut places = BTreeMap::new();
    let mut holds = BTreeMap::new();
    for (key, execution) in &state.executions {
        if execution.users.is_empty() && !execution.is_busy() {
            broken.push(format!("C15: execution {key} is unused and idle, and still in memory"));
        }
        if let ExecutionState::Mending { inputs } = &execution.state
            && let Some(input) = inputs.iter().find(|input| !state.executions.contains_key(input))
        {
            broken.push(format!("C9: execution {key} waits for {input}, which is not in memory"));
        }
        if !execution.tasks.is_indexed() {
            broken.push(format!("C14: the index of execution {key} is not that of {:?}", execution.tasks));
        }
        for (i, task) in execution.tasks.iter().enumerate() {
            places.insert(&task.id, (*key, i));
            holds.extend(task.holders().iter().map(|member| (&member.worker, (*key, i))));
        }
    }
    for run in state.runs.values() {
        if !run.is_indexed() {
            broken.push(format!("C14: the index of `{}` is wrong", run.id));
        }
        for (stage, key) in run.all_active() {
            if state.executions.get(&key).is_none_or(|execution| !execution.users.contains(&(run.number, stage))) {
                broken.push(format!("C14: stage {stage} of `{}` waits for {key}, which does not list it", run.id));
            }
        }
    }
    for (key, execution) in &state.executions {
        for (number, stage) in &execution.users {
            let status = state.runs.get(number).and_then(|run| run.stages.get(*stage));
            if status.and_then(Status::key) != Some(*key) {
                broken.push(format!(
                    "C14: execution {key} is used by stage {stage} of run {number}, which is {status:?}"
                ));
            }
        }
    }
    if !places.iter().map(|(task, place)| (*task, place)).eq(state.tasks.iter()) {
        broken.push("C14: tasks are not where the index says".to_owned());
    }
    broken.extend(check_queue(state));
    for (name, worker) in state.workers.iter() {
        let found = holds.get(name).copied();
        if worker.holds != found || state.unused.contains(name) != found.is_none() {
            broken.push(format!("C14: worker `{name}` holds {found:?}, known is {:?}", worker.holds));
        }
    }
    broken
}

/// Checks C14 for the queue and its order of service.
fn check_queue(state: &State) -> Vec<String> {
    let mut broken = Vec::new();
    let mut rebuilt = state.clone();
    rebuilt.index();
    let indices = |state: &State| {
        (state.queue.clone(), state.mends.clone(), state.idempotent.clone(), state.parked.clone(), state.groups.clone())
    };
    if indices(state) != indices(&rebuilt) {
        broken.push(format!("C14: the queue is {:?}, and should be {:?}", indices(state), indices(&rebuilt)));
    }
    let ranked = state.executions.keys().filter_map(|key| Some((state.queue.rank(key)?, *key)));
    let in_order: BTreeSet<_> = ranked.collect();
    let known = state.wanted().into_iter().filter(|key| state.executions.contains_key(key));
    if !in_order.iter().map(|(_, key)| *key).eq(known) {
        broken.push(format!("C14: the queue has {in_order:?}, and runs wait for {:?}", state.wanted()));
    }
    broken
}

fn check_task(state: &State, execution: &StageExecution, task: &Task, broken: &mut Vec<String>) {
    if !task.checkpoints.is_sorted_by(|a, b| a.step < b.step) {
        broken.push(format!("C12: checkpoints of `{}` are {:?}", task.id, task.checkpoints));
    }
    if !task.is_held() {
        return;
    }
    let holders = task.holders();
    for member in holders {
        let good = state.workers.get(&member.worker).is_some_and(|worker| {
            worker.incarnation == member.incarnation && worker.presence == Presence::Here && execution.takes(worker)
        });
        if !good {
            broken.push(format!("C2: `{}` is held by {member:?}", task.id));
        }
    }
    if execution.state != ExecutionState::Open || task.attempt.0 == 0 || task.fence.0 == 0 {
        broken.push(format!("C3: `{}` is held while its execution is {:?}", task.id, execution.state));
    }
    let names: BTreeSet<_> = holders.iter().map(|member| &member.worker).collect();
    let range = execution.range();
    let fits = match task.part {
        // A draining gang keeps its members, even if another run has changed the limits.
        Part::Gang => {
            let drain_by = matches!(task.lease, Lease::Held { drain_by: Some(_), .. });
            let fits = holders.len() <= range.max;
            !holders.is_empty() && (fits || drain_by || state.draining)
        }
        Part::Alone | Part::Resolve | Part::Shard { .. } | Part::Merge => holders.len() == 1,
    };
    if !fits || names.len() != holders.len() {
        broken.push(format!("C4: `{}` is held by {holders:?}, with room for {range:?}", task.id));
    }
    if task.part == Part::Merge && execution.shards().is_none() {
        broken.push(format!("C7: `{}` is held before its shards are there", task.id));
    }
}

/// Invariants violated by the step from `before` to `after`, or by `after` itself.
pub fn check_change(before: &State, after: &State) -> Vec<String> {
    let mut broken = check(after);
    for (name, worker) in before.workers.iter() {
        match after.workers.get(name) {
            Some(now) if now.incarnation >= worker.incarnation => {}
            // A later process of this name gets a number that was never used.
            None if after.incarnation >= worker.incarnation => {}
            other => broken.push(format!("C5: worker `{name}` lost its incarnation {}: {other:?}", worker.incarnation)),
        }
    }
    for (key, execution) in &before.executions {
        let Some(now) = after.executions.get(key) else {
            // A later execution of this key starts above all fences so far.
            if execution.tasks.iter().any(|task| task.fence > after.fence) {
                broken.push(format!("C5: execution {key} is forgotten, with fences above {}", after.fence));
            }
            continue;
        };
        for task in &execution.tasks {
            let Some(now) = now.tasks.iter().find(|t| t.id == task.id) else {
                broken.push(format!("C5: task `{}` is forgotten", task.id));
                continue;
            };
            if now.fence < task.fence || now.attempt < task.attempt {
                broken.push(format!("C5: `{}` went from {:?} to {:?}", task.id, task.fence, now.fence));
            }
            let changed_hands = now.is_held() && now.holders() != task.holders();
            if changed_hands && now.fence == task.fence {
                broken.push(format!("C5: `{}` changed hands under fence {}", task.id, task.fence));
            }
            check_state_is_kept(before, after, task, now, &mut broken);
        }
        if let (ExecutionState::Open, ExecutionState::Open) = (&execution.state, &now.state) {
            for task in execution.tasks.iter().filter(|task| task.output().is_some()) {
                if now.tasks.iter().any(|t| t.id == task.id && t.output() != task.output()) {
                    broken.push(format!("C6: the artifact of `{}` changed", task.id));
                }
            }
        }
    }
    if before.submitted > after.submitted {
        broken.push(format!("C5: run numbers went from {} to {}", before.submitted, after.submitted));
    }
    for (run, now) in before.runs.iter().filter_map(|(number, run)| Some((run, after.runs.get(number)?))) {
        for (i, status) in run.stages.iter().enumerate() {
            if matches!(status, Status::Done { .. }) && now.stages[i] != *status {
                broken.push(format!("C6: stage {i} of `{}` was done and changed", run.id));
            }
        }
    }
    broken
}

/// C17: a gang keeps a polling member that holds its state.
fn check_state_is_kept(before: &State, after: &State, task: &Task, now: &Task, broken: &mut Vec<String>) {
    let Lease::Held { holders, drain_by: None, .. } = &task.lease else { return };
    let reporter = now.reported.as_ref().filter(|_| now.reported != task.reported).map(|report| &report.grant.worker);
    let is_left = |member: &&Member| {
        let is_here = |worker: &Worker| {
            worker.presence == Presence::Here
                || matches!(worker.presence, Presence::Suspect { since } if since == after.now)
        };
        let process = after.workers.get(&member.worker).filter(|worker| worker.incarnation == member.incarnation);
        process.is_some_and(is_here) && reporter != Some(&member.worker)
    };
    let holds = |member: &&Member| evidence::holds(&before.heard.words, task, member).is_some();
    if task.part != Part::Gang || now.output().is_some() || !holders.iter().filter(is_left).any(|member| holds(&member))
    {
        return;
    }
    let goes_on =
        now.attempt == task.attempt && holders.iter().filter(holds).any(|member| now.holders().contains(member));
    // The lead reported that it has yielded, or the failure is final.
    let reported = reporter.is_some() && (now.attempt == task.attempt && !now.is_held());
    let execution = after.task(&task.id).map(|(execution, _)| execution);
    let is_over = execution.is_ok_and(|execution| execution.state != ExecutionState::Open);
    if !goes_on && !reported && !is_over {
        broken.push(format!("C17: `{}` goes from {holders:?} to {now:?} and loses its state", task.id));
    }
}

/// Checks C16 for an event that was refused or writes nothing: all durable data of `before` is unchanged in `after`.
pub fn check_unchanged(before: &State, after: &State) -> Vec<String> {
    let numbers =
        |state: &State| (state.draining, state.now, state.seq, state.submitted, state.incarnation, state.fence);
    let mut broken = Vec::new();
    let mut same = |what: &str, is_same: bool| {
        if !is_same {
            broken.push(format!("C16: {what} changed without a write"));
        }
    };
    same("numbers", numbers(before) == numbers(after));
    same("workers", before.workers.ptr_eq(&after.workers) || before.workers == after.workers);
    same("unused workers", before.unused.ptr_eq(&after.unused) || before.unused == after.unused);
    same("runs", is_same_map(&before.runs, &after.runs));
    same("executions", is_same_map(&before.executions, &after.executions));
    same("tasks", before.tasks.ptr_eq(&after.tasks) || before.tasks == after.tasks);
    broken
}

fn is_same_map<K: Ord, V: PartialEq>(before: &Map<K, Arc<V>>, after: &Map<K, Arc<V>>) -> bool {
    let pairs = || before.iter().zip(after);
    before.size() == after.size() && pairs().all(|(a, b)| a.0 == b.0 && (Arc::ptr_eq(a.1, b.1) || a.1 == b.1))
}
