//! A step of 250 ms: faults, calls and actions of the coordinator, then calls and work of the workers.

use std::sync::Arc;

use coordinator::batch::Ask;
use coordinator::state::execution::StageExecution;
use coordinator::state::run::Status;
use coordinator::state::worker::Identity;
use coordinator::{Control, Effect, Event, Millis, Moment, Observation, Refused, Rejected, State, decide, invariants};
use protocol::message::{Poll, RunState};
use protocol::{Digest, Incarnation, WorkerId};
use registry::WriteError;

use super::disk::{Disk, Ticket};
use super::{Cut, World, durable};
use crate::wild;
use crate::worker::{Answer, Call, FakeWorker, Saving};

impl World {
    fn deliver(&mut self, i: usize, process: u32, call: Call) {
        let name = self.workers[i].name.clone();
        let ask = match &call {
            Call::Join(join) => {
                let secret = Digest::of(format!("{name} {process}").as_bytes());
                let by = Identity { caller: "t".into(), secret };
                Ask::Event(Box::new(Event::Join { join: join.clone(), by }))
            }
            Call::Poll(poll) => match self.poll(&name, poll) {
                Ok(Some(ask)) => ask,
                Ok(None) => return self.send_desired(i, process, poll.incarnation),
                Err(_) => return self.send_away(i, process),
            },
            Call::Commit(commit) => {
                self.checkpoint_steps.insert(commit.manifest, commit.step);
                Ask::Event(Box::new(Event::Checkpoint { commit: commit.clone() }))
            }
            Call::Report(report) => Ask::Event(Box::new(Event::Outcome { report: report.clone() })),
        };
        let stale = match &call {
            Call::Report(report) => {
                matches!(self.state().check_write(&report.grant), Err(Rejected::StaleFence { .. }))
            }
            _ => false,
        };
        let ticket = Ticket::Call { i, process, call: Box::new(call), at: self.now, stale };
        self.ask(ask, ticket);
    }

    /// Passes a poll to the front, which answers it without the queue if it has no consequences.
    fn poll(&mut self, name: &WorkerId, poll: &Poll) -> Result<Option<Ask>, Rejected> {
        let asked = self.batches.front().poll(self.now, name.clone(), poll.clone())?;
        if asked.is_none() {
            self.heard.insert((name.clone(), poll.incarnation), self.now);
            if !matches!(self.disk, Disk::Idle) {
                self.count("a quiet poll answered while a commit was in flight");
            }
        }
        Ok(asked)
    }

    /// Answers the sender of a call.
    pub(super) fn answer_call(
        &mut self,
        (i, process): (usize, u32),
        call: Call,
        (at, stale): (Millis, bool),
        answer: Result<Vec<Effect>, Refused>,
    ) {
        let saving = match &call {
            Call::Join(_) | Call::Poll(_) => Saving::No,
            Call::Commit(commit) => Saving::Commit(commit.clone()),
            Call::Report(report) => Saving::Report(report.clone()),
        };
        let answer = match (call, answer) {
            (Call::Poll(poll), Ok(_)) => {
                let name = self.workers[i].name.clone();
                let heard = self.heard.entry((name, poll.incarnation)).or_default();
                *heard = at.max(*heard);
                return self.send_desired(i, process, poll.incarnation);
            }
            (Call::Join(_), Ok(effects)) => {
                let joined = effects.into_iter().find_map(|effect| match effect {
                    Effect::Joined(incarnation) => Some(Answer::Joined(incarnation)),
                    _ => None,
                });
                joined.expect("a join gives an incarnation")
            }
            (Call::Commit(_), Ok(_)) => Answer::Done(saving),
            (Call::Report(_), Ok(effects)) => {
                assert!(!stale || effects.is_empty(), "a stale report counted");
                if stale { Answer::Refused(saving) } else { Answer::Done(saving) }
            }
            // The process is no longer known.
            (Call::Join(_) | Call::Poll(_), Err(Refused::Rejected(_))) => return self.send_away(i, process),
            (Call::Commit(_) | Call::Report(_), Err(Refused::Rejected(_))) => Answer::Refused(saving),
            // A named blob is missing, so the attempt has failed.
            (call, Err(Refused::Write(WriteError::NotFound(_)))) => {
                self.count(match call {
                    Call::Commit(_) => "a checkpoint refused for a missing blob",
                    _ => "an outcome refused for a missing blob",
                });
                // The next attempt uploads it again.
                self.store.collected.clear();
                Answer::Refused(saving)
            }
            (_, Err(_)) => Answer::Later,
        };
        self.acknowledge(&answer);
        self.send_answer(i, process, answer);
    }

    fn send_desired(&mut self, i: usize, process: u32, incarnation: Incarnation) {
        let name = self.workers[i].name.clone();
        let desired = self.batches.front().state().desired(&name, incarnation);
        match desired {
            Ok(desired) => {
                let answer = Answer::DesiredAssignments(desired, self.batches.front().state().seq);
                self.acknowledge(&answer);
                self.send_answer(i, process, answer);
            }
            Err(_) => self.send_away(i, process),
        }
    }

    /// Makes the worker join again.
    fn send_away(&mut self, i: usize, process: u32) {
        if self.workers[i].process == process {
            self.workers[i].forget();
        }
    }

    fn send_answer(&mut self, i: usize, process: u32, answer: Answer) {
        if self.chaos() && self.random.chance(8) {
            return self.count("a call that was lost");
        }
        let delay = self.delay();
        self.answers.push((self.now.after(delay), i, process, answer));
    }

    fn delay(&mut self) -> u64 {
        match self.random.below(100) {
            0..3 if self.chaos() => self.random.below(25_000),
            3..20 if self.chaos() => self.random.below(3_000),
            _ => self.random.below(50),
        }
    }

    fn mischief(&mut self) {
        let i = self.random.below(self.workers.len() as u64) as usize;
        match self.random.below(1000) {
            0..12 => {
                let was_alive = self.workers[i].alive;
                self.workers[i].alive = false;
                if was_alive {
                    self.count("a worker that died");
                }
                if was_alive && self.up && self.random.chance(50) {
                    let worker = self.workers[i].name.clone();
                    // If the launcher's report is lost, the lease expires instead.
                    self.ask(Ask::Event(Box::new(Event::WorkerGone { worker, incarnation: None })), Ticket::Nobody);
                }
            }
            70..78 if self.workers[i].alive => {
                self.workers[i].leaving.get_or_insert(self.now);
                self.count("a worker that was asked to end");
            }
            40..48 => {
                let other = self.random.below(self.workers.len() as u64) as usize;
                if other != i {
                    let until = self.now.after(self.random.below(20_000));
                    let (from, to) = (self.workers[i].name.clone(), self.workers[other].name.clone());
                    let one_way = self.random.chance(50);
                    self.cuts.push(Cut { from, to, one_way, until });
                    self.count(match one_way {
                        true => "a cut that only one of two peers notices",
                        false => "a cut between peers that both reach the coordinator",
                    });
                }
            }
            60..66 => {
                self.workers[i].refuses_until = self.now.after(self.random.below(40_000));
                self.count("a refused peer port");
            }
            66..70 => {
                self.workers[i].stuck_until = self.now.after(self.random.below(80_000));
                self.count("a stage that hangs while its worker polls");
            }
            12..20 => {
                self.workers[i].hung_until = self.now.after(self.random.below(40_000));
                self.count("a worker that was stopped");
            }
            20..24 if self.up => self.crash(),
            24..40 if self.up && !self.store.runs.is_empty() => {
                let run = self.random.below(self.store.runs.len() as u64) as usize;
                let run = self.store.runs.keys().nth(run).expect("there are so many").clone();
                let action = match self.random.below(5) {
                    0 | 1 => Control::Pause,
                    2 | 3 => Control::Resume,
                    _ => Control::Cancel,
                };
                if action == Control::Cancel {
                    self.cancelled.push(run.clone());
                }
                let event = self.control_event(&run, action);
                self.ask(Ask::Event(Box::new(event)), Ticket::Nobody);
            }
            48 => self.lose_power(),
            50..60 => self.collect(),
            _ => {}
        }
        for i in 0..self.workers.len() {
            if !self.workers[i].alive && self.random.chance(4) {
                self.launch(i);
            }
        }
    }

    fn launch(&mut self, i: usize) {
        if self.workers[i].launch() {
            self.count("a slow joiner");
        }
    }

    /// Runs the garbage collector, which deletes uploads in transit that no stored row names.
    fn collect(&mut self) {
        let named: Vec<Digest> = self.calls.iter().filter_map(|(.., call)| call.uploaded()).collect();
        let loose: Vec<Digest> = named.into_iter().filter(|digest| !self.store.is_rooted(*digest)).collect();
        if !loose.is_empty() {
            self.count("a collection of what was not named yet");
            self.store.collected.extend(loose);
        }
    }

    pub(crate) fn step(&mut self) {
        self.now = self.now.after(250);
        if self.chaos() {
            self.mischief();
        } else {
            for i in 0..self.workers.len() {
                if !self.workers[i].alive {
                    self.launch(i);
                }
            }
            if self.up {
                let paused = self.state().runs.values().filter(|run| run.state == RunState::Paused);
                for run in paused.map(|run| run.id.clone()).collect::<Vec<_>>() {
                    // The run may end meanwhile.
                    drop(self.control(&run, Control::Resume));
                }
            }
        }
        if !self.up && self.now >= self.back_at {
            self.recover();
        }
        if self.up {
            self.coordinator_step();
        }
        let now = self.now;
        for (_, i, process, answer) in extract(&mut self.answers, now) {
            self.workers[i].hear(process, answer);
        }
        self.workers_step();
        if self.wild && self.now.0.is_multiple_of(7000) {
            self.try_everything();
        }
    }

    fn coordinator_step(&mut self) {
        let now = self.now;
        self.advance();
        let (due, later) = std::mem::take(&mut self.submissions).into_iter().partition(|(at, _)| *at <= now);
        self.submissions = later;
        for (_, event) in due {
            // The shell looks for the key in the tables first.
            if let Event::Submit { idempotency_key: Some(key), .. } = &event
                && self.synced().keys.contains_key(key)
            {
                continue;
            }
            if self.up {
                self.ask(Ask::Event(Box::new(event.clone())), Ticket::Submission(Box::new(event)));
            } else {
                self.submissions.push((now.after(500), event));
            }
        }
        let (due, later): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.effects).into_iter().partition(|(at, _)| *at <= now);
        self.effects = later;
        for (_, effect) in due {
            // The effects of a killed coordinator are lost; the next one requests them again.
            if self.up {
                self.perform(effect);
            }
        }
        for (_, i, process, call) in extract(&mut self.calls, now) {
            if self.up {
                self.deliver(i, process, call);
                // Calls that arrive together are sometimes decided together.
                if self.random.chance(30) {
                    self.advance();
                }
            }
        }
        self.clock();
        self.advance();
    }

    /// Ticks once a second, unless the process oversleeps or the tick waits for the disk.
    fn clock(&mut self) {
        let now = self.now;
        if self.chaos() && self.asleep.is_none() && self.random.chance(1) {
            self.asleep = Some((now.after(self.random.below(12_000)), now));
        }
        let overslept = match self.asleep {
            Some((until, _)) if now < until => return,
            Some((_, since)) => {
                self.asleep = None;
                // The delay is a stopped process or a slow disk; the timer can tell which.
                let is_stopped = self.random.chance(50);
                self.count(match is_stopped {
                    true => "a late tick of a clock that overslept",
                    false => "a late tick of a slow disk",
                });
                if is_stopped { now.since(since) } else { 0 }
            }
            None if now.0.is_multiple_of(1000) => 0,
            None => return,
        };
        if self.up {
            self.ask(Ask::Observation(Observation::Tick { overslept }, now), Ticket::Tick { at: now });
        }
    }

    fn perform(&mut self, effect: Effect) {
        let event = match &effect {
            Effect::Lookup { key } => self.store.look_up(*key),
            Effect::Register { key, candidates, .. } => Event::Bundled {
                key: *key,
                bundles: candidates.iter().map(|c| Digest::of(c.stage.as_str().as_bytes())).collect(),
            },
            _ => return,
        };
        self.ask(Ask::Event(Box::new(event)), Ticket::Effect(Box::new(effect)));
    }

    /// Tries every event on copies of the state: none panics, and the invariants hold.
    fn try_everything(&mut self) {
        for event in wild::events(self.state(), &self.runs()) {
            let moment = Moment { now: self.now, entropy: Digest::of(b"wild") };
            let mut next = self.state().clone();
            let result = decide(&mut next, moment, event.clone());
            let broken = invariants::check_change(self.state(), &next);
            assert!(broken.is_empty(), "after {event:?}: {broken:#?}");
            if !matches!(result.as_ref().map(|effects| effects.first()), Ok(Some(Effect::Store(_)))) {
                assert_eq!(durable(&next), durable(self.state()), "{event:?} gave {result:?} and changed the state");
            }
        }
    }

    fn workers_step(&mut self) {
        let now = self.now;
        for i in 0..self.workers.len() {
            if self.workers[i].has_left(now) {
                self.workers[i].alive = false;
                let worker = self.workers[i].name.clone();
                if self.up {
                    self.ask(Ask::Event(Box::new(Event::WorkerGone { worker, incarnation: None })), Ticket::Nobody);
                }
            }
        }
        self.cuts.retain(|cut| cut.until > now);
        let cuts = self.cuts.clone();
        let refusing: Vec<WorkerId> =
            self.workers.iter().filter(|worker| worker.refuses_until > now).map(|worker| worker.name.clone()).collect();
        let notices = |a: &WorkerId, b: &WorkerId| {
            let cut = |cut: &Cut| (&cut.from, &cut.to) == (a, b) || (!cut.one_way && (&cut.to, &cut.from) == (a, b));
            a != b && (refusing.contains(b) || cuts.iter().any(cut))
        };
        let is_cut = |a: &WorkerId, b: &WorkerId| notices(a, b) || notices(b, a);
        let is_stuck = |worker: &&FakeWorker| worker.is_stuck(now);
        let stuck: Vec<WorkerId> = self.workers.iter().filter(is_stuck).map(|worker| worker.name.clone()).collect();
        for i in 0..self.workers.len() {
            let (process, own) = (self.workers[i].process, self.workers[i].name.clone());
            let unreachable: Vec<WorkerId> = self
                .workers
                .iter()
                .filter(|other| !other.runs(now) || notices(&own, &other.name))
                .map(|other| other.name.clone())
                .collect();
            let lies = self.chaos() && self.workers[i].lies;
            for call in self.workers[i].speak(now, &unreachable, &stuck, lies) {
                if lies && matches!(&call, Call::Poll(poll) if poll.doing.iter().any(|doing| !doing.lost.is_empty())) {
                    self.count("a false complaint");
                }
                let twice = self.chaos() && self.random.chance(8);
                if twice {
                    self.count("a call that came twice");
                }
                for _ in 0..1 + usize::from(twice) {
                    if self.chaos() && self.random.chance(8) {
                        self.count("a call that was lost");
                    } else {
                        let delay = self.delay();
                        self.calls.push((now.after(delay), i, process, call.clone()));
                    }
                }
            }
            let Some(grant) = self.workers[i].grant().cloned() else { continue };
            let task = self.state().task(&grant.task).ok().map(|(_, task)| task);
            let members = task.map(|task| task.holders().to_vec()).unwrap_or_default();
            let peers: Vec<&FakeWorker> =
                self.workers.iter().filter(|w| members.iter().any(|member| member.worker == w.name)).collect();
            let apart = |peer: &&FakeWorker| peers.iter().any(|other| is_cut(&peer.name, &other.name));
            let hangs = peers.len() > 1 && peers.iter().any(|peer| peer.is_stuck(now));
            let in_step = |peer: &&FakeWorker| peer.runs(now) && peer.grant().is_some_and(|g| g.fence == grant.fence);
            let ended = peers.len() > 1 && peers.iter().any(|peer| peer.has_reported());
            let together =
                !hangs && !ended && !peers.is_empty() && !peers.iter().any(apart) && peers.iter().all(in_step);
            let furthest = together.then(|| peers.iter().filter_map(|peer| peer.live(&grant)).max());
            let saved = task.and_then(|task| task.newest()).map_or(0, |saved| saved.step);
            let chaos = self.chaos();
            // Values from before the end and resumption of a run are not recomputed within it.
            let state = Arc::clone(self.batches.state());
            let reader = state.task(&grant.task).ok().map(|(execution, _)| execution);
            let can_be = |input| reader.is_some_and(|reader| is_given_here(&state, reader, input));
            if chaos
                && self.random.chance(1)
                && let Some(input) = self.workers[i].finds_damage(now, can_be)
            {
                self.store.damage(input);
                self.count("an input that was found damaged");
                continue;
            }
            self.workers[i].work(now, furthest, saved, &mut self.random, chaos);
        }
    }
}

/// Returns true if the producer of an input is in memory, in a run of its reader.
fn is_given_here(state: &State, reader: &StageExecution, input: Digest) -> bool {
    let runs = reader.users.iter().filter_map(|(number, _)| state.runs.get(number));
    let gave = |status: &Status| status.known().is_some_and(|known| known.outputs.values().any(|it| *it == input));
    let mut givers = runs.flat_map(|run| &run.stages).filter(|status| gave(status)).filter_map(Status::key);
    givers.any(|giver| state.executions.contains_key(&giver))
}

fn extract<T>(queue: &mut Vec<(Millis, usize, u32, T)>, now: Millis) -> Vec<(Millis, usize, u32, T)> {
    let (mut due, later): (Vec<_>, Vec<_>) = std::mem::take(queue).into_iter().partition(|message| message.0 <= now);
    *queue = later;
    due.sort_by_key(|message| message.0);
    due
}
