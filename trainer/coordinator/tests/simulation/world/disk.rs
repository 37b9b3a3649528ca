//! The coordinator's batches on a slow disk. Requests wait in the queue while a transaction is in flight, and an answer
//! reveals only stored data.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use coordinator::batch::{Ask, Done, Turn};
use coordinator::state::task::Part;
use coordinator::state::worker::Presence;
use coordinator::{Effect, Event, Millis, Moment, Refused, State};
use protocol::message::{Member, TaskOutcome};
use protocol::{Digest, Incarnation, TaskId, WorkerId};
use registry::{Write, WriteError};

use super::World;
use crate::random::Random;
use crate::store::{FakeStore, Refusal};
use crate::worker::{Answer, Call, Saving};

/// Longest duration of a transaction.
const SLOW_MS: u64 = 4_000;

/// The transaction in flight.
#[derive(Debug, Default)]
pub(super) enum Disk {
    #[default]
    Idle,
    /// Decided; nothing is on the disk.
    Writing { until: Millis, writes: Vec<Write> },
    /// Visible to other processes, but a loss of power would restore `before`.
    Written { until: Millis, before: Box<FakeStore> },
}

impl Disk {
    /// Completes the current phase at once.
    pub(super) fn hurry(&mut self) {
        match self {
            Self::Idle => {}
            Self::Writing { until, .. } | Self::Written { until, .. } => *until = Millis(0),
        }
    }

    /// Removes and returns the transaction in flight.
    pub(super) fn lose(&mut self) -> Self {
        std::mem::take(self)
    }
}

/// The source of a request.
#[derive(Debug)]
pub(super) enum Ticket {
    /// A worker; `stale` is set if its report was outdated on arrival.
    Call { i: usize, process: u32, call: Box<Call>, at: Millis, stale: bool },
    /// A client, which repeats its request until it is answered.
    Submission(Box<Event>),
    /// The coordinator itself, for an effect.
    Effect(Box<Effect>),
    /// The coordinator's timer.
    Tick { at: Millis },
    /// The caller that waits in [`World::happen`].
    Caller,
    /// A caller that does not wait for the answer.
    Nobody,
}

fn moment(now: Millis, random: &mut Random) -> impl FnMut() -> Moment {
    move || Moment { now, entropy: random.digest() }
}

/// Uploaded blobs that the writes name.
fn named(writes: &[Write]) -> Vec<Digest> {
    let named = writes.iter().flat_map(|write| match write {
        Write::Checkpoint { manifest, .. } => vec![*manifest],
        Write::Shard { output, .. } => vec![*output],
        Write::StageResult { grant: Some(_), outputs, .. } => outputs.values().copied().collect(),
        _ => Vec::new(),
    });
    named.collect()
}

impl World {
    pub(super) fn ask(&mut self, ask: Ask, ticket: Ticket) {
        if !matches!(self.disk, Disk::Idle) {
            self.count("an ask that came while a commit was in flight");
        }
        self.tickets += 1;
        self.asked.insert(self.tickets, ticket);
        self.batches.ask(ask, self.tickets);
    }

    /// Completes all work of the coordinator and its disk that is due.
    pub(super) fn advance(&mut self) {
        while self.up && self.turn() {}
        let now = self.now;
        let (due, later): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.snapshots).into_iter().partition(|(at, _)| *at <= now);
        self.snapshots = later;
        for (_, state) in due {
            // If snapshots overtake each other, the newest one stays, as in the real store.
            let newest = self.store.recovery.snapshot.as_ref().map_or(0, |(seq, _)| *seq);
            if self.up && state.seq > newest {
                if state.seq < self.store.seq() {
                    self.count("a snapshot that was overtaken by facts");
                }
                self.store.snapshot(&state);
            }
        }
    }

    /// Performs one action of the coordinator or its disk; returns `false` if none is due.
    pub(super) fn turn(&mut self) -> bool {
        let now = self.now;
        match std::mem::take(&mut self.disk) {
            Disk::Idle => {
                if !self.batches.is_idle() {
                    self.heard_then.clone_from(&self.heard);
                }
                let turn = self.batches.decide(moment(now, &mut self.random));
                self.take(turn)
            }
            Disk::Writing { until, writes } if until <= now => self.write(writes),
            Disk::Written { until, .. } if until <= now => self.conclude(Ok(())),
            busy @ (Disk::Writing { .. } | Disk::Written { .. }) => {
                self.disk = busy;
                false
            }
        }
    }

    fn take(&mut self, turn: Turn<u64>) -> bool {
        match turn {
            Turn::Idle => return false,
            Turn::Store(writes) => {
                let until = if self.chaos() && self.random.chance(15) {
                    self.now.after(self.random.below(SLOW_MS))
                } else {
                    self.now
                };
                self.disk = Disk::Writing { until, writes };
            }
            Turn::Done(done) => self.done(done),
        }
        true
    }

    fn write(&mut self, writes: Vec<Write>) -> bool {
        if self.chaos() && self.random.chance(1) {
            self.count("a full disk");
            return self.conclude(Err(WriteError::Storage("full".into())));
        }
        if self.chaos() && self.random.chance(1) {
            // The database rolls back an interrupted write, even if a part of it is on the disk.
            self.disk = Disk::Writing { until: self.now, writes };
            self.crash();
            return false;
        }
        if self.chaos() && self.random.chance(1) {
            let loose = named(&writes).into_iter().filter(|digest| !self.store.is_rooted(*digest));
            let loose: Vec<Digest> = loose.collect();
            if !loose.is_empty() {
                self.count("a collection of what was not named yet");
                self.store.collected.extend(loose);
            }
        }
        let is_slow = self.chaos() && self.random.chance(3);
        let before = is_slow.then(|| Box::new(self.store.clone()));
        let written = self.store.write(&writes).map_err(|refusal| match refusal {
            Refusal::Gate => WriteError::Gate("a gate does not hold".into()),
            Refusal::Missing(digest) => WriteError::NotFound(format!("blob {digest} is not in the store")),
        });
        match (written, before) {
            (Ok(()), Some(before)) => {
                self.disk = Disk::Written { until: self.now.after(self.random.below(SLOW_MS)), before };
                if self.random.chance(20) {
                    self.crash();
                }
                true
            }
            (written, _) => self.conclude(written),
        }
    }

    fn conclude(&mut self, written: Result<(), WriteError>) -> bool {
        if let Err(WriteError::Gate(_)) = &written {
            self.count("a gate that does not hold");
        }
        let stored = written.is_ok();
        let turn = self.batches.stored(written, moment(self.now, &mut self.random));
        match &turn {
            Turn::Done(done) if stored && done.answers.len() > 1 => self.count("a batch of several"),
            Turn::Done(done) if !stored && done.answers.is_empty() => {
                self.count("a batch that the store refused, each tried alone");
            }
            Turn::Done(_) | Turn::Store(_) | Turn::Idle => {}
        }
        self.take(turn)
    }

    /// The data that would survive a loss of power now.
    pub(super) fn synced(&self) -> &FakeStore {
        match &self.disk {
            Disk::Written { before, .. } => before,
            Disk::Idle | Disk::Writing { .. } => &self.store,
        }
    }

    /// Simulates a loss of power: all processes on the machine end, and unsynced writes are undone.
    pub(super) fn lose_power(&mut self) {
        if let Disk::Written { before, .. } = self.disk.lose() {
            self.store = *before;
            self.count("a loss of power before the commit was synced");
        } else {
            self.count("a loss of power that spared what was synced");
        }
        for worker in &mut self.workers {
            worker.alive = false;
        }
        self.calls.clear();
        self.answers.clear();
        if self.up {
            self.crash();
        }
    }

    fn done(&mut self, done: Done<u64>) {
        let tickets =
            done.answers.into_iter().filter_map(|(ticket, answer)| Some((self.asked.remove(&ticket)?, answer)));
        let answers: Vec<(Ticket, Result<Vec<Effect>, Refused>)> = tickets.collect();
        self.events += answers.len() as u64;
        self.check_leases(&answers);
        self.present = self.present_now();
        self.check_steps();
        let state = self.state();
        let suspected = |presence| matches!(presence, Presence::Suspect { since } if since == state.now);
        if done.durable && state.workers.values().any(|worker| suspected(worker.presence)) {
            self.count("a member whom its peers could not reach");
        }
        if done.durable {
            self.stored += 1;
            if self.chaos() && self.random.chance(2) {
                let at = self.now.after(self.random.below(2_000));
                self.snapshots.push((at, Arc::clone(self.batches.state())));
            }
            if self.is_killed_now(&answers) {
                return;
            }
        }
        for effect in done.effects {
            if let Effect::Lookup { .. } | Effect::Register { .. } = effect {
                let at = self.now.after(self.random.below(if self.chaos() { 3000 } else { 10 }));
                self.effects.push((at, effect));
            }
        }
        for (ticket, answer) in answers {
            self.answer(ticket, answer);
        }
    }

    /// Checks that a polling member that must leave its gang costs the gang at most the step in progress.
    fn check_steps(&mut self) {
        let state = Arc::clone(self.batches.state());
        let mut gangs = BTreeMap::new();
        for task in state.executions.values().flat_map(|execution| &execution.tasks) {
            if task.part == Part::Gang && task.is_held() {
                gangs.insert(task.id.clone(), (task.attempt, task.holders().to_vec()));
            }
        }
        let preempted = |state: &State| -> BTreeSet<TaskId> {
            let tasks = state.executions.values().flat_map(|execution| &execution.tasks);
            tasks.filter(|task| task.is_preempted()).map(|task| task.id.clone()).collect()
        };
        for _ in preempted(&state).difference(&std::mem::replace(&mut self.preempted, preempted(&state))) {
            self.count("a training that made way for a higher priority");
        }
        for (task, (attempt, before)) in std::mem::replace(&mut self.gangs, gangs) {
            let Some((now, after)) = self.gangs.get(&task).filter(|(now, _)| *now == attempt) else { continue };
            let process = |member: &Member| self.workers.iter().find(|worker| worker.is(member));
            // A member may have died since its last poll.
            if !after.iter().all(|member| process(member).is_some()) {
                continue;
            }
            let live = |member: &Member| process(member).and_then(|worker| worker.live_of(&task, *now));
            // A member's report is believed. The coordinator cannot know that a late answer made it discard the state.
            let kept =
                |member: &Member| process(member).and_then(|worker| worker.has_or_was_misled_out_of(&task, *now));
            let reported =
                state.task(&task).ok().and_then(|(_, task)| Some(task.reported.as_ref()?.grant.worker.clone()));
            let had_to_leave = |member: &&Member| {
                if reported.as_ref() == Some(&member.worker) {
                    return false;
                }
                let process = state.workers.get(&member.worker).filter(|w| w.incarnation == member.incarnation);
                let is_out =
                    matches!(process.map(|w| w.presence), Some(Presence::Suspect { since }) if since == state.now);
                let heard = state.heard.workers.get(&member.worker);
                is_out && heard.is_some_and(|heard| state.now.since(*heard) < state.policy.hearing_ms)
            };
            let left =
                before.iter().filter(|member| !after.contains(member)).filter(had_to_leave).filter_map(live).max();
            // Members without the state continue from the newest checkpoint, and without one from the beginning.
            let saved = state.task(&task).ok().and_then(|(_, task)| task.newest()).map_or(0, |saved| saved.step);
            let kept = after.iter().filter_map(kept).max().unwrap_or(saved);
            assert!(
                left.is_none_or(|left| kept + 1 >= left),
                "`{task}` went from step {left:?} to {kept:?} at {}: {before:#?} to {after:#?}; reports: {:#?}, workers: {:#?}",
                self.now.0,
                state.heard.words,
                self.workers
            );
        }
    }

    /// Kills the coordinator if the test requests this after the current batch.
    fn is_killed_now(&mut self, answers: &[(Ticket, Result<Vec<Effect>, Refused>)]) -> bool {
        // Joins are spared: a worker that never gets the answer would join forever.
        let joins = |ticket: &Ticket| matches!(ticket, Ticket::Call { call, .. } if matches!(**call, Call::Join(_)));
        let spared = answers.iter().any(|(ticket, _)| matches!(ticket, Ticket::Caller) || joins(ticket) && !self.once);
        let Some((every, from)) = self.kills else { return false };
        if spared || self.stored < from || !self.stored.is_multiple_of(every) {
            return false;
        }
        if self.once {
            self.kills = None;
        }
        for (ticket, _) in answers {
            if let Ticket::Submission(event) = ticket {
                self.submissions.push((self.now.after(500), Event::clone(event)));
            }
        }
        self.forget();
        self.recovered();
        // Recovery usually replays facts, but not always all of them.
        if self.stored.is_multiple_of(40) {
            let state = Arc::clone(self.batches.state());
            self.store.snapshot(&state);
        }
        self.happen(Event::Started { alone: false, park: false }).expect("starts again");
        true
    }

    fn answer(&mut self, ticket: Ticket, answer: Result<Vec<Effect>, Refused>) {
        match ticket {
            Ticket::Call { i, process, call, at, stale } => self.answer_call((i, process), *call, (at, stale), answer),
            Ticket::Submission(event) => match answer {
                Ok(effects) => {
                    for effect in effects {
                        if let Effect::Submitted(run) = effect {
                            assert!(self.synced().runs.contains_key(&run), "{run} was promised and is not stored");
                        }
                    }
                }
                Err(Refused::Write(_)) => self.submissions.push((self.now.after(500), *event)),
                Err(_) => {}
            },
            Ticket::Effect(effect) => {
                if let Err(Refused::Write(WriteError::Storage(_))) = answer {
                    self.effects.push((self.now.after(1000), *effect));
                }
            }
            Ticket::Caller => self.answered = Some(answer),
            Ticket::Tick { .. } | Ticket::Nobody => {}
        }
    }

    /// Checks that an answer reveals nothing that a loss of power would undo.
    pub(super) fn acknowledge(&self, answer: &Answer) {
        let (synced, told) = (self.synced(), self.batches.front().state());
        assert!(told.seq <= synced.seq(), "decision {} is told and not stored", told.seq);
        match answer {
            Answer::DesiredAssignments(desired, _) => {
                for assignment in &desired.assignments {
                    let (task, fence) = (&assignment.grant.task, assignment.grant.fence);
                    let stored = synced.fences.get(task);
                    assert!(stored.is_some_and(|stored| *stored >= fence), "{fence} of {task} is told, not {stored:?}");
                }
            }
            Answer::Done(Saving::Commit(commit)) => {
                let at = (commit.grant.task.clone(), commit.step);
                assert_eq!(synced.checkpoints.get(&at), Some(&commit.manifest), "a checkpoint is told and not stored");
            }
            Answer::Done(Saving::Report(report)) => {
                let is_finished = matches!(report.outcome, TaskOutcome::Finished { .. });
                let stored = synced.accepted.contains_key(&report.grant.task);
                assert!(stored || !is_finished, "the end of {} is told and not stored", report.grant.task);
            }
            Answer::Joined(_) | Answer::Done(_) | Answer::Refused(_) | Answer::Later => {}
        }
    }

    /// Checks that a worker with answered polls keeps its lease, with or without the queue.
    fn check_leases(&mut self, answers: &[(Ticket, Result<Vec<Effect>, Refused>)]) {
        let ticks = answers.iter().filter_map(|(ticket, _)| match ticket {
            Ticket::Tick { at } => Some(*at),
            _ => None,
        });
        let Some(at) = ticks.max() else { return };
        let state = Arc::clone(self.batches.state());
        let present = std::mem::take(&mut self.present);
        let was_here = |name: &WorkerId, incarnation| present.get(name) == Some(&incarnation);
        let silent = state.workers.iter().filter(|(_, worker)| worker.presence == Presence::Silent);
        for (name, worker) in silent.filter(|(name, worker)| was_here(name, worker.incarnation)) {
            self.count("a lease that expired");
            let heard = self.heard_then.get(&(name.clone(), worker.incarnation)).copied().unwrap_or_default();
            let silent = at.since(heard);
            assert!(silent > self.policy.lease_ms, "`{name}` was heard {silent} ms before its lease ended");
        }
    }

    /// Processes with a lease.
    pub(super) fn present_now(&self) -> BTreeMap<WorkerId, Incarnation> {
        let here = self.state().workers.iter().filter(|(_, worker)| !worker.is_away());
        here.map(|(name, worker)| (name.clone(), worker.incarnation)).collect()
    }
}
