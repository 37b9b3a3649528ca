//! Assignment of work to workers. Deterministic in state and moment. A later build with other rules does not change
//! existing assignments.
//!
//! Executions of a group are served in the order of [`State::wanted`](crate::state::State::wanted), as
//! [`Queue`](crate::state::queue::Queue) stores them. [`in_turn`] merges the groups. Work that no idle worker can take is skipped. The order within
//! one decision:
//! 1. Gangs that have become too large release members.
//! 2. Plain tasks, shards and merges that are ready get one worker each: they are short, and much waits for them. After
//!    a failure, a worker on which fewer attempts failed comes first.
//! 3. Running gangs admit idle workers, up to their `max`.
//! 4. Waiting gangs start with all remaining workers.
//!
//! With work of several groups or priorities, each of them may take only its [share](crate::decide::shares) of the idle
//! workers.
//!
//! A gang admits only workers that have reported its inputs as fetched and its members as reachable.
//! [`State::open_gangs`] tells idle workers which inputs to fetch; the gang does not wait for slow ones. All workers of
//! an execution have the same instruction set.
//!
//! A gang does not start while a map stage that its workers could merge is almost done (its last shards are out).
//! Otherwise the merge would wait for the whole training. A gang of at most one worker may start, because it leaves the
//! other workers to the merge.

use std::sync::Arc;

use protocol::message::Member;
use protocol::{Digest, Group, WorkerId};

use crate::decide::deciding::Deciding;
use crate::decide::shares::Shares;
use crate::fact::Fact;
use crate::policy::GrantOrder;
use crate::state::evidence;
use crate::state::execution::{ExecutionState, StageExecution};
use crate::state::gang::{self, Change};
use crate::state::queue::{Need, Rank, in_turn, open_member};
use crate::state::shared::Map;
use crate::state::task::{Lease, Task};
use crate::state::worker::{Arithmetic, Worker};
use crate::state::{Idle, State};

/// Maximum number of gangs that idle workers prepare for. More than that occur in sweeps, where the remaining gangs get
/// their turn later.
const OPEN_GANGS: usize = 64;

/// Assigns ready work to idle workers.
pub(crate) fn schedule(cx: &mut Deciding<'_>) {
    if cx.state.draining {
        return;
    }
    // A gang becomes too large only if another run asks for fewer workers, which touches its execution.
    for key in cx.touched.clone() {
        let execution = cx.state.executions.get(&key);
        if execution.is_some_and(|execution| execution.state == ExecutionState::Open) {
            change_gangs(cx, key, None);
        }
    }
    end_backoffs(cx);
    cx.share();
    // Usually all workers are busy, and nothing else needs checking.
    cx.state.open_gangs = Arc::default();
    if !cx.state.unused.iter().any(|name| cx.state.workers.get(name).is_some_and(Worker::is_available)) {
        return;
    }
    loop {
        let mut shares = Shares::of(cx.state, cx.now());
        note_idle(cx, &shares);
        let before = cx.facts.len();
        assign(cx, &mut shares);
        // Each assignment changes the shares of the workers that are left.
        if cx.facts.len() == before || !shares.are_divided() {
            break;
        }
    }
    cx.state.open_gangs = Arc::new(open_gangs(cx.state));
    cx.state.visits += cx.state.open_gangs.len() as u64;
}

/// Assigns idle workers within the shares of their groups.
fn assign(cx: &mut Deciding<'_>, shares: &mut Shares) {
    while let Some(key) = next_small(cx.state, shares) {
        cx.state.visits += 1;
        small_tasks(cx, key, shares);
    }
    let prepared = prepared_gangs(cx.state);
    cx.state.visits += prepared.len() as u64;
    for key in &prepared {
        change_gangs(cx, *key, Some(&mut *shares));
    }
    for key in &prepared {
        start_gangs(cx, *key, shares);
    }
}

/// Makes tasks ready whose back-off has ended.
fn end_backoffs(cx: &mut Deciding<'_>) {
    let now = cx.now();
    let due: Vec<Digest> = cx.state.queue.due(now).collect();
    for key in due {
        cx.state.visits += 1;
        for i in cx.state.executions[&key].tasks.due(now).collect::<Vec<_>>() {
            cx.change(key, i, |task| task.end_backoff(now));
        }
    }
}

/// Notes since when workers are idle, while they are divided.
fn note_idle(cx: &mut Deciding<'_>, shares: &Shares) {
    let now = cx.now();
    let State { unused, heard, policy, .. } = cx.state;
    if !shares.are_divided() {
        heard.idle = Map::default();
        return;
    }
    let busy: Vec<WorkerId> = heard.idle.keys().filter(|name| !unused.contains(*name)).cloned().collect();
    for name in busy {
        heard.idle.remove_mut(&name);
    }
    for name in unused.iter() {
        let known = heard.idle.get(name).cloned().unwrap_or(Idle { since: now, kept_for: None });
        if let Some(claimant) = &known.kept_for
            && now.since(known.since) > policy.share_ms
        {
            heard.declined.insert_mut(claimant.clone(), now);
        }
        let kept_for = shares.owner(name).cloned().or(known.kept_for);
        heard.idle.insert_mut(name.clone(), Idle { since: known.since, kept_for });
    }
}

/// The first execution with a ready task that an idle worker can take.
fn next_small(state: &State, shares: &Shares) -> Option<Digest> {
    let is_met = |need: &Need| {
        idle_that(state, |worker| need.takes(worker)).any(|member| shares.allow(&member.worker, &need.claimant))
    };
    let needs = state.queue.needs().filter(|need| !need.gang && is_met(need));
    in_turn(needs.flat_map(|need| waiting(state, need, 1))).first().copied()
}

/// The first executions with a need.
fn waiting<'a>(state: &'a State, need: &'a Need, count: usize) -> impl Iterator<Item = (&'a Group, Rank, Digest)> {
    state.queue.with(need).take(count).map(|(rank, key)| (&need.claimant.group, rank, key))
}

fn is_met(state: &State, need: &Need) -> bool {
    idle_that(state, |worker| need.takes(worker)).next().is_some()
}

/// Executions that need members and whose inputs an idle worker has.
fn prepared_gangs(state: &State) -> Vec<Digest> {
    let tasks = idle_that(state, |_| true).flat_map(|member| &state.workers[&member.worker].ready);
    let keys = tasks.filter_map(|task| state.place(task).ok()).map(|(key, _)| key);
    in_turn(keys.filter_map(|key| state.queue.gang(&key).map(|(group, rank)| (group, rank, key))))
}

/// The first gang tasks that an idle worker could join.
fn open_gangs(state: &State) -> Vec<(Digest, usize)> {
    let needs = state.queue.needs().filter(|need| need.gang && is_met(state, need));
    let first = in_turn(needs.flat_map(|need| waiting(state, need, OPEN_GANGS)));
    let keys = first.into_iter().take(OPEN_GANGS);
    keys.filter_map(|key| Some((key, open_member(&state.executions[&key])?))).collect()
}

/// Idle workers that can take work of an execution, in the order of assignment.
fn idle<'a>(state: &'a State, execution: &'a StageExecution) -> impl Iterator<Item = Member> + 'a {
    idle_that(state, move |worker| execution.takes(worker))
}

/// Those of them that work of the execution's group may take.
pub(crate) fn allowed<'a>(
    state: &'a State,
    shares: &'a Shares,
    execution: &'a StageExecution,
) -> impl Iterator<Item = Member> + 'a {
    let claimant = state.queue.claimant(&execution.key);
    idle(state, execution).filter(move |member| claimant.is_none_or(|own| shares.allow(&member.worker, own)))
}

fn idle_that<'a>(state: &'a State, takes: impl Fn(&Worker) -> bool + 'a) -> impl Iterator<Item = Member> + 'a {
    let mut names = state.unused.iter();
    let in_order = std::iter::from_fn(move || match state.policy.grants {
        GrantOrder::ByName => names.next(),
        GrantOrder::ByNameBackwards => names.next_back(),
    });
    let known = in_order.filter_map(|name| Some((name, state.workers.get(name)?)));
    let fit = known.filter(move |(_, worker)| worker.is_available() && takes(worker));
    fit.map(|(name, worker)| worker.member(name))
}

/// Idle workers that have the inputs of a task and, as far as known, enough memory for it. All have the same instruction
/// set and code: those of the gang's members, or else the most common ones. The instruction set is also that of the
/// execution's earlier work. A shunned worker never joins others. If only shunned workers are left, one of them starts alone, or as many as the minimum requires.
fn fit(state: &State, shares: &Shares, execution: &StageExecution, task: &Task) -> Vec<Member> {
    let fits = |member: &Member| {
        state.workers[&member.worker].ready.contains(&task.id) && !task.too_small.contains(&member.worker)
    };
    let is_shunned = |member: &Member| state.workers[&member.worker].shunned.is_some();
    let arithmetic = |member: &Member| state.workers[&member.worker].arithmetic();
    let given = task.holders().first().map(arithmetic);
    let mut alike: Vec<(Arithmetic<'_>, Vec<Member>)> = Vec::new();
    for member in allowed(state, shares, execution).filter(fits).filter(|member| !task.is_held() || !is_shunned(member))
    {
        let own = arithmetic(&member);
        match alike.iter_mut().find(|(known, _)| *known == own) {
            Some((_, members)) => members.push(member),
            None if given.is_none_or(|given| given == own) => alike.push((own, vec![member])),
            None => {}
        }
    }
    // In a tie, the first ones win, which have the first worker in the order of assignment.
    let of_most = alike.into_iter().rev().max_by_key(|(_, members)| members.len());
    let (shunned, mut welcome): (Vec<Member>, Vec<Member>) =
        of_most.map(|(_, members)| members).unwrap_or_default().into_iter().partition(is_shunned);
    let missing = execution.range().min.max(1).saturating_sub(welcome.len());
    welcome.extend(shunned.into_iter().take(missing));
    welcome.truncate(state.queue.claimant(&execution.key).map_or(usize::MAX, |claimant| shares.room(&claimant.group)));
    welcome
}

/// The idle worker for task `i`. A worker that is too slow for a task, or dies of it, would be the first one each time.
fn next_worker(state: &State, shares: &Shares, execution: &StageExecution, i: usize) -> Option<Member> {
    let task = &execution.tasks[i];
    let mut idle = allowed(state, shares, execution);
    if task.failed_on.is_empty() { idle.next() } else { idle.min_by_key(|member| task.failures_on(&member.worker)) }
}

fn small_tasks(cx: &mut Deciding<'_>, key: Digest, shares: &mut Shares) {
    while let Some(i) = cx.state.executions[&key].tasks.first_ready() {
        let Some(worker) = next_worker(cx.state, shares, &cx.state.executions[&key], i) else { return };
        grant(cx, shares, key, i, vec![worker]);
    }
}

/// Removes members of gangs that are too large. With `shares`, gangs also admit idle workers.
fn change_gangs(cx: &mut Deciding<'_>, key: Digest, mut shares: Option<&mut Shares>) {
    if !cx.state.executions[&key].is_gang() {
        return;
    }
    for i in 0..cx.state.executions[&key].tasks.len() {
        let execution = &cx.state.executions[&key];
        let task = &execution.tasks[i];
        if matches!(task.lease, Lease::Held { drain_by: None, .. }) {
            let holds = |member: &Member| evidence::holds(&cx.state.heard.words, task, member).is_some();
            let joiners = shares.as_deref().map(|shares| fit(cx.state, shares, execution, task)).unwrap_or_default();
            match gang::with(task.holders(), &joiners, execution.range(), holds) {
                Change::Keep | Change::Disband => {}
                Change::Regroup(members) => {
                    if let (Some(shares), Some(claimant)) = (&mut shares, cx.state.claimant_of(execution)) {
                        shares.took(&claimant.group, members.len().saturating_sub(task.holders().len()));
                    }
                    cx.regroup(key, i, members);
                }
            }
        }
    }
}

fn start_gangs(cx: &mut Deciding<'_>, key: Digest, shares: &mut Shares) {
    let now = cx.now();
    if !cx.state.executions[&key].is_gang() {
        return;
    }
    for i in 0..cx.state.executions[&key].tasks.len() {
        let execution = &cx.state.executions[&key];
        let task = &execution.tasks[i];
        if task.is_free(now)
            && (execution.range().max == 1 || !cx.state.queue.is_sharding(execution.backend))
            && let Some(members) = gang::start(&fit(cx.state, shares, execution, task), execution.range())
        {
            grant(cx, shares, key, i, members);
        }
    }
}

fn grant(cx: &mut Deciding<'_>, shares: &mut Shares, key: Digest, i: usize, holders: Vec<Member>) {
    if let Some(claimant) = cx.state.claimant_of(&cx.state.executions[&key]) {
        shares.took(&claimant.group, holders.len());
    }
    let secret = cx.secret(&cx.state.executions[&key].tasks[i]);
    if cx.state.executions[&key].tasks[i].newest().is_some() {
        cx.resumed(key);
    }
    let set = &cx.state.workers[&holders[0].worker].instruction_set;
    if cx.state.executions[&key].instruction_set.as_ref() != Some(set) {
        let instruction_set = set.clone();
        cx.record(Fact::ExecutionInstructions { key, instruction_set });
    }
    let fence = cx.change(key, i, |task| task.grant(holders, secret));
    cx.fences.push(fence);
}
