//! What happens in a quarter of a second: mischief, what the coordinator hears and does, what the workers say and compute.

use coordinator::event::Observation;
use coordinator::{Control, Effect, Event, Millis, Moment, Rejected, decide, invariants};
use protocol::message::RunState;
use protocol::{Digest, WorkerId};

use super::{Refused, World, durable};
use crate::store::Refusal;
use crate::wild;
use crate::worker::{Answer, Call, FakeWorker, Saving};

impl World {
    fn deliver(&mut self, i: usize, process: u32, call: Call) {
        let name = self.workers[i].name.clone();
        let saving = match &call {
            Call::Join(_) | Call::Poll(_) => Saving::No,
            Call::Commit(commit) => Saving::Commit(commit.clone()),
            Call::Report(report) => Saving::Report(report.clone()),
        };
        let done = Answer::Done(saving.clone());
        let (lifetime, answer) = match call {
            Call::Join(join) => (
                true,
                self.happen(Event::Join { join }).map(|effects| {
                    let joined = effects.into_iter().find_map(|effect| match effect {
                        Effect::Joined(incarnation) => Some(Answer::Joined(incarnation)),
                        _ => None,
                    });
                    joined.expect("a join gives an incarnation")
                }),
            ),
            Call::Poll(poll) => {
                let incarnation = poll.incarnation;
                let heard = self.hear(Observation::Poll { worker: name.clone(), poll });
                let desired = self.state.desired(&name, incarnation).map_err(Refused::Rejected);
                (true, heard.and(desired).map(Answer::DesiredAssignments))
            }
            Call::Commit(commit) => {
                self.checkpoint_steps.insert(commit.manifest, commit.step);
                (false, self.happen(Event::Checkpoint { commit }).map(|_| done))
            }
            Call::Report(report) => {
                let known = self.state.check_write(&report.grant);
                let stored = self.happen(Event::Outcome { report });
                if let Err(Rejected::StaleFence { .. }) = known {
                    let counted = match stored {
                        Ok(effects) => !effects.is_empty(),
                        Err(Refused::Killed) => true,
                        Err(Refused::Rejected(_) | Refused::Store(_)) => false,
                    };
                    assert!(!counted, "a stale report counted");
                    (false, Err(Refused::Rejected(Rejected::Conflict("stale".into()))))
                } else {
                    (false, stored.map(|_| done))
                }
            }
        };
        let answer = match answer {
            Ok(answer) => answer,
            // What it named is gone; the try has failed.
            Err(Refused::Store(Refusal::Missing(_))) => Answer::Refused(saving),
            Err(Refused::Store(_)) => Answer::Later,
            // The connection is gone with whoever held it.
            Err(Refused::Killed) => return,
            Err(Refused::Rejected(_)) if lifetime => {
                if self.workers[i].process == process {
                    self.workers[i].forget();
                }
                return;
            }
            Err(Refused::Rejected(_)) => Answer::Refused(saving),
        };
        self.send_answer(i, process, answer);
    }

    fn send_answer(&mut self, i: usize, process: u32, answer: Answer) {
        if self.chaos() && self.random.chance(8) {
            return;
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
                if was_alive && self.up && self.random.chance(50) {
                    let worker = self.workers[i].name.clone();
                    // The launcher tells what it saw; if that is lost, the lease does.
                    let _ = self.happen(Event::WorkerGone { worker });
                }
            }
            40..48 => {
                let other = self.random.below(self.workers.len() as u64) as usize;
                if other != i {
                    let until = self.now.after(self.random.below(20_000));
                    self.cuts.push((self.workers[i].name.clone(), self.workers[other].name.clone(), until));
                }
            }
            12..20 => self.workers[i].hung_until = self.now.after(self.random.below(40_000)),
            20..24 if self.up => self.crash(),
            24..40 if self.up && !self.store.runs.is_empty() => {
                let run = self.random.below(self.store.runs.len() as u64) as usize;
                let run = self.store.runs.keys().nth(run).expect("there are so many").clone();
                let action = match self.random.below(5) {
                    0 | 1 => Control::Pause,
                    2 | 3 => Control::Resume,
                    _ => Control::Cancel,
                };
                // Whether it was taken shows in the state: a coordinator that is killed after the commit does not answer.
                let _ = self.control(&run, action);
                if action == Control::Cancel && self.store.runs[&run] == "cancelled" {
                    self.cancelled.push(run);
                }
            }
            _ => {}
        }
        for worker in &mut self.workers {
            if !worker.alive && self.random.chance(4) {
                worker.launch();
            }
        }
    }

    pub(crate) fn step(&mut self) {
        self.now = self.now.after(250);
        if self.chaos() {
            self.mischief();
        } else {
            for worker in &mut self.workers {
                if !worker.alive {
                    worker.launch();
                }
            }
            if self.up {
                for run in self.state.runs.values().cloned().collect::<Vec<_>>() {
                    if run.state == RunState::Paused && self.up {
                        self.control(&run.id, Control::Resume).expect("resumes");
                    }
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
        let (due, later) = std::mem::take(&mut self.submissions).into_iter().partition(|(at, _)| *at <= now);
        self.submissions = later;
        for (_, event) in due {
            if !self.up {
                self.submissions.push((now.after(500), event));
                continue;
            }
            // The shell looks for the key in the tables first.
            if let Event::Submit { idempotency_key: Some(key), .. } = &event
                && self.store.keys.contains_key(key)
            {
                continue;
            }
            match self.happen(event.clone()) {
                Err(Refused::Store(_)) => self.submissions.push((now.after(500), event)),
                // Whoever cannot know whether it was taken sends it again, under a key; without one, it may count twice.
                Err(Refused::Killed) => self.submissions.push((now.after(500), event)),
                Ok(_) | Err(Refused::Rejected(_)) => {}
            }
        }
        let (due, later): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.effects).into_iter().partition(|(at, _)| *at <= now);
        self.effects = later;
        for (_, effect) in due {
            // A killed coordinator's effects died with it; the next one asks for them again.
            if self.up {
                self.perform(effect);
            }
        }
        for (_, i, process, call) in extract(&mut self.calls, now) {
            if self.up {
                self.deliver(i, process, call);
            }
        }
        if self.chaos() && self.asleep.is_none() && self.random.chance(1) {
            self.asleep = Some((now.after(self.random.below(12_000)), now));
        }
        match self.asleep {
            Some((until, _)) if now < until => {}
            Some((_, since)) => {
                self.asleep = None;
                // A slow disk or a process that was stopped: the clock knows which.
                let overslept = if self.random.chance(50) { now.since(since) } else { 0 };
                if self.up && self.hear(Observation::Tick { overslept }).is_err() {
                    // Stored at the next tick.
                }
            }
            None => {
                if self.up && now.0.is_multiple_of(1000) && self.hear(Observation::Tick { overslept: 0 }).is_err() {
                    // Stored at the next tick.
                }
            }
        }
    }

    /// Whatever could happen now, on copies: nothing panics, and the invariants hold.
    fn try_everything(&mut self) {
        for event in wild::events(&self.state, &self.runs()) {
            let moment = Moment { now: self.now, entropy: Digest::of(b"wild") };
            let mut next = self.state.clone();
            let result = decide(&mut next, moment, event.clone());
            let broken = invariants::check_change(&self.state, &next);
            assert!(broken.is_empty(), "after {event:?}: {broken:#?}");
            if !matches!(result.as_ref().map(|effects| effects.first()), Ok(Some(Effect::Store(_)))) {
                assert_eq!(durable(&next), durable(&self.state), "{event:?} gave {result:?} and changed the state");
            }
        }
    }

    fn workers_step(&mut self) {
        let now = self.now;
        self.cuts.retain(|(_, _, until)| *until > now);
        let cuts = self.cuts.clone();
        let is_cut = |a: &WorkerId, b: &WorkerId| cuts.iter().any(|(x, y, _)| (x, y) == (a, b) || (x, y) == (b, a));
        for i in 0..self.workers.len() {
            let (process, own) = (self.workers[i].process, self.workers[i].name.clone());
            let unreachable: Vec<WorkerId> = self
                .workers
                .iter()
                .filter(|other| !other.runs(now) || is_cut(&own, &other.name))
                .map(|other| other.name.clone())
                .collect();
            for call in self.workers[i].speak(now, &unreachable) {
                let copies = if self.chaos() && self.random.chance(8) { 2 } else { 1 };
                for _ in 0..copies {
                    if !(self.chaos() && self.random.chance(8)) {
                        let delay = self.delay();
                        self.calls.push((now.after(delay), i, process, call.clone()));
                    }
                }
            }
            let Some(grant) = self.workers[i].grant().cloned() else { continue };
            let task = self.state.task(&grant.task).ok().map(|(_, task)| task);
            let members = task.map(|task| task.holders().to_vec()).unwrap_or_default();
            let peers: Vec<&FakeWorker> =
                self.workers.iter().filter(|w| members.iter().any(|member| member.worker == w.name)).collect();
            let apart = |peer: &&FakeWorker| peers.iter().any(|other| is_cut(&peer.name, &other.name));
            let together = !peers.is_empty()
                && !peers.iter().any(apart)
                && peers.iter().all(|peer| peer.runs(now) && peer.grant().is_some_and(|g| g.fence == grant.fence));
            let furthest = together.then(|| peers.iter().filter_map(|peer| peer.live(&grant)).max());
            let saved = task.and_then(|task| task.newest()).map_or(0, |saved| saved.step);
            let chaos = self.chaos();
            self.workers[i].execution(now, furthest, saved, &mut self.random, chaos);
        }
    }
}

fn extract<T>(queue: &mut Vec<(Millis, usize, u32, T)>, now: Millis) -> Vec<(Millis, usize, u32, T)> {
    let (mut due, later): (Vec<_>, Vec<_>) = std::mem::take(queue).into_iter().partition(|message| message.0 <= now);
    *queue = later;
    due.sort_by_key(|message| message.0);
    due
}
