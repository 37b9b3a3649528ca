//! The real `decide` among fake workers, a fake store and virtual time, all driven by one seed: calls are dropped, doubled,
//! delayed and so reordered, workers die and hang, the store fills up, the coordinator is killed between any two events
//! and on either side of a commit, and comes back by replay. Invariants are checked after every event; in the end
//! everything that was submitted is done exactly once.
//!
//! `SIM_SEED=n` replays one seed; `SIM_SEEDS=n` runs so many instead of the 2,000 of every `cargo test`. A seed that fails
//! is added to `seeds.txt` beside this file, which is run first ever after.

mod pipelines;
mod random;
mod store;
mod sweeps;
mod wild;
mod worker;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use coordinator::event::Known;
use coordinator::{Control, Effect, Event, Millis, Moment, Observation, Policy, Rejected, State};
use coordinator::{decide, invariants, journal, observe};
use protocol::message::{RunState, StageState};
use protocol::stage::WorkerRange;
use protocol::{Digest, RunId, WorkerId};

use crate::random::Random;
use crate::store::{FakeStore, Refusal};
use crate::worker::{Answer, Call, FakeWorker, Saving};

/// Seeds of every run of the tests, beside those that once failed.
const SEEDS: u64 = 2_000;
const CHAOS_MS: u64 = 180_000;
const LIMIT_MS: u64 = 3_000_000;

struct World {
    random: Random,
    now: Millis,
    store: FakeStore,
    state: State,
    /// The coordinator runs.
    up: bool,
    back_at: Millis,
    effects: Vec<(Millis, Effect)>,
    calls: Vec<(Millis, usize, u32, Call)>,
    answers: Vec<(Millis, usize, u32, Answer)>,
    workers: Vec<FakeWorker>,
    submissions: Vec<(Millis, Event)>,
    checkpoint_steps: BTreeMap<Digest, u64>,
    events: u64,
    cancelled: Vec<RunId>,
    /// Kills on either side of a commit: what the disk has is all that is left.
    torn: u64,
    /// Try every event now and then.
    wild: bool,
    /// Kill the coordinator after each stored event whose number is a multiple of the first, from the second on; its answer is lost.
    kills: Option<(u64, u64)>,
    /// Only the first of them.
    once: bool,
    stored: u64,
}

fn policy() -> Policy {
    Policy { grace_ms: 10_000, fault_budget: 1000, infrastructure_budget: 1000, ..Policy::default() }
}

impl World {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let workers = (0..1 + random.below(4)).map(|i| FakeWorker::new(&format!("w{i}"))).collect();
        let submissions = (0..1 + random.below(3))
            .map(|i| {
                let max = random.below(4) as usize;
                let range = WorkerRange { min: 1, max };
                let gates: &[&str] = if random.chance(15) { &["never <= 0"] } else { &["latent_fid <= 1"] };
                let pipeline = match random.below(4) {
                    0 => pipelines::swept(random.below(2), 4 + random.below(8)),
                    _ => pipelines::quickstart(random.below(2), range, gates),
                };
                let event = Event::Submit {
                    pipeline: Box::new(pipeline),
                    source: String::new(),
                    idempotency_key: random.chance(30).then(|| format!("key-{i}")),
                    until: random.chance(20).then(|| "mld".into()),
                };
                (Millis(random.below(CHAOS_MS / 2)), event)
            })
            .collect();
        Self {
            random,
            now: Millis(0),
            store: FakeStore::default(),
            state: State::new(policy()),
            up: true,
            back_at: Millis(0),
            effects: Vec::new(),
            calls: Vec::new(),
            answers: Vec::new(),
            workers,
            submissions,
            checkpoint_steps: BTreeMap::new(),
            events: 0,
            cancelled: Vec::new(),
            torn: 0,
            wild: false,
            kills: None,
            once: false,
            stored: 0,
        }
    }

    fn chaos(&self) -> bool {
        self.now.0 < CHAOS_MS
    }

    /// One event through the real thing: decide on a copy, store, publish.
    fn happen(&mut self, event: Event) -> Result<Vec<Effect>, Refused> {
        self.events += 1;
        let moment = Moment { now: self.now, entropy: self.random.digest() };
        let mut next = self.state.clone();
        let decided = decide(&mut next, moment, event.clone());
        let mut effects = match decided {
            Ok(effects) => effects,
            Err(rejected) => {
                assert_eq!(durable(&next), durable(&self.state), "a rejected {event:?} changed the state");
                return Err(Refused::Rejected(rejected));
            }
        };
        let broken = invariants::check_change(&self.state, &next);
        let what: String = format!("{event:?}").chars().take(300).collect();
        assert!(broken.is_empty(), "after {what} at {:?}: {broken:#?}", self.now);
        if let Some(Effect::Store(_)) = effects.first() {
            let Effect::Store(writes) = effects.remove(0) else { unreachable!() };
            if self.chaos() && self.random.chance(1) {
                return Err(Refused::Store(Refusal::Full));
            }
            let torn = (self.chaos() && self.random.chance(1)).then(|| self.random.below(2));
            if torn == Some(0) {
                // The transaction was being written: the database rolls it back, whatever part of it lay on the disk.
                self.torn += 1;
                self.crash();
                return Err(Refused::Killed);
            }
            self.store.write(&writes).map_err(Refused::Store)?;
            if torn == Some(1) {
                // It is durable, and nobody was told: the caller hears nothing, no other effect happens.
                self.torn += 1;
                self.crash();
                self.state = next;
                return Err(Refused::Killed);
            }
        } else {
            assert_eq!(durable(&next), durable(&self.state), "{event:?} changed something without a write");
        }
        self.state = next;
        self.stored += 1;
        // Whoever never hears that it has joined joins for ever.
        let spared: &[&str] = if self.once { &["started"] } else { &["started", "join"] };
        let spared = self.store.journal.last().is_some_and(|entry| spared.iter().any(|event| entry["event"] == *event));
        if let Some((every, from)) = self.kills
            && !spared
            && self.stored >= from
            && self.stored.is_multiple_of(every)
        {
            self.effects.clear();
            if self.once {
                self.kills = None;
            }
            let recovered = journal::replay(policy(), self.store.journal.clone()).expect("the journal replays");
            assert_eq!(durable(&recovered), durable(&self.state), "replay gives what was");
            self.state = recovered;
            self.happen(Event::Started { alone: false, park: false }).expect("starts again");
            return Err(Refused::Store(Refusal::Full));
        }
        for effect in &effects {
            if let Effect::Lookup { .. } | Effect::Register { .. } = effect {
                let at = self.now.after(self.random.below(if self.chaos() { 3000 } else { 10 }));
                self.effects.push((at, effect.clone()));
            }
        }
        Ok(effects)
    }

    fn hear(&mut self, observation: Observation) -> Result<(), Refused> {
        let events = observe(&mut self.state, self.now, observation).map_err(Refused::Rejected)?;
        for event in events {
            match self.happen(event) {
                Ok(_) => {}
                Err(Refused::Rejected(rejected)) => drop(rejected.to_string()),
                Err(refused @ (Refused::Store(_) | Refused::Killed)) => return Err(refused),
            }
        }
        Ok(())
    }

    fn perform(&mut self, effect: Effect) {
        let event = match &effect {
            Effect::Lookup { key } => Event::LookedUp { key: *key, known: self.store.results.get(key).cloned() },
            Effect::Register { key, candidates } => Event::Bundled {
                key: *key,
                bundles: candidates.iter().map(|c| Digest::of(c.stage.as_str().as_bytes())).collect(),
            },
            _ => return,
        };
        match (self.happen(event), &effect) {
            (Ok(_) | Err(Refused::Rejected(_) | Refused::Killed), _) => {}
            (Err(Refused::Store(Refusal::Gate)), Effect::Register { key, .. }) => {
                let refused = Event::RegisterRefused { key: *key, message: "a gate does not hold".into() };
                if self.happen(refused).is_err() {
                    self.effects.push((self.now.after(1000), effect));
                }
            }
            (Err(Refused::Store(_)), _) => self.effects.push((self.now.after(1000), effect)),
        }
    }

    fn crash(&mut self) {
        self.up = false;
        self.back_at = self.now.after(self.random.below(40_000));
        self.effects.clear();
    }

    fn recover(&mut self) {
        let recovered = journal::replay(policy(), self.store.journal.clone()).expect("the journal replays");
        assert_eq!(durable(&recovered), durable(&self.state), "replay gives what was");
        self.state = recovered;
        self.up = true;
        let alone = self.random.chance(30);
        if alone {
            for worker in &mut self.workers {
                worker.alive = false;
            }
        }
        // A coordinator that cannot store its first event does not start.
        loop {
            match self.happen(Event::Started { alone, park: false }) {
                Ok(_) => return,
                Err(Refused::Killed) => return,
                Err(Refused::Rejected(_) | Refused::Store(_)) => {}
            }
        }
    }

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
                let orders = self.state.orders(&name, incarnation).map_err(Refused::Rejected);
                (true, heard.and(orders).map(Answer::Orders))
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
            12..20 => self.workers[i].hung_until = self.now.after(self.random.below(40_000)),
            20..24 if self.up => self.crash(),
            24..40 if self.up && !self.state.runs.is_empty() => {
                let run = &self.state.runs[self.random.below(self.state.runs.len() as u64) as usize];
                let run = run.id.clone();
                let action = match self.random.below(5) {
                    0 | 1 => Control::Pause,
                    2 | 3 => Control::Resume,
                    _ => Control::Cancel,
                };
                // Whether it was taken shows in the state: a coordinator that is killed after the commit does not answer.
                let _ = self.happen(Event::Control { run: run.clone(), action });
                if action == Control::Cancel && self.state.run(&run).is_ok_and(|run| run.state == RunState::Cancelled) {
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

    fn step(&mut self) {
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
                for run in self.state.runs.clone() {
                    if run.state == RunState::Paused && self.up {
                        self.happen(Event::Control { run: run.id.clone(), action: Control::Resume }).expect("resumes");
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
        if self.up && now.0.is_multiple_of(1000) && self.hear(Observation::Tick).is_err() {
            // Stored at the next tick.
        }
    }

    /// Whatever could happen now, on copies: nothing panics, and the invariants hold.
    fn try_everything(&mut self) {
        for event in wild::events(&self.state) {
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
        let dead: Vec<WorkerId> = self.workers.iter().filter(|w| !w.runs(now)).map(|w| w.name.clone()).collect();
        for i in 0..self.workers.len() {
            let process = self.workers[i].process;
            for call in self.workers[i].speak(now, &dead) {
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
            let together = !peers.is_empty()
                && peers.iter().all(|peer| peer.runs(now) && peer.grant().is_some_and(|g| g.fence == grant.fence));
            let furthest = together.then(|| peers.iter().filter_map(|peer| peer.live(&grant)).max());
            let saved = task.and_then(|task| task.newest()).map_or(0, |saved| saved.step);
            let chaos = self.chaos();
            self.workers[i].work(now, furthest, saved, &mut self.random, chaos);
        }
    }

    fn is_over(&self) -> bool {
        self.submissions.is_empty() && self.up && self.state.runs.iter().all(|run| run.state.is_final())
    }

    fn run(&mut self) {
        while self.now.0 < LIMIT_MS && (self.chaos() || !self.is_over()) {
            self.step();
        }
        let held: Vec<_> =
            self.state.works.values().flat_map(|work| &work.tasks).filter(|task| task.is_held()).collect();
        assert!(self.is_over(), "not over after {LIMIT_MS} ms: {held:#?} {:#?}", self.workers);
        for run in &self.state.runs {
            let never = format!("{:?}", run.pipeline).contains("never");
            let whole = run.until.is_none();
            let expected = match run.state {
                RunState::Cancelled => self.cancelled.contains(&run.id),
                RunState::Failed => never && whole,
                RunState::Finished => !(never && whole) || self.store.promotions > 0,
                RunState::Running | RunState::Paused => false,
            };
            assert!(expected, "{}: {:#?}", run.id, self.state.view(run, self.now));
            let stored = serde_json::to_value(run.state).expect("a word");
            assert_eq!(stored.as_str(), self.store.runs.get(&run.id).map(String::as_str), "the row follows the state");
        }
        for (task, times) in &self.store.accepted {
            assert_eq!(*times, 1, "{task} was accepted {times} times");
        }
        let recovered = journal::replay(policy(), self.store.journal.clone()).expect("the journal replays");
        assert_eq!(durable(&recovered), durable(&self.state));
    }

    fn views(&self) -> Vec<protocol::message::RunView> {
        self.state.runs.iter().map(|run| self.state.view(run, self.now)).collect()
    }
}

#[derive(Debug)]
enum Refused {
    Rejected(Rejected),
    Store(Refusal),
    /// The coordinator was killed while it stored the event; who asked hears nothing.
    Killed,
}

/// What must survive a restart.
fn durable(state: &State) -> impl PartialEq + std::fmt::Debug + use<> {
    (state.workers.clone(), state.runs.clone(), state.works.clone(), state.tasks.clone(), state.draining, state.now)
}

fn extract<T>(queue: &mut Vec<(Millis, usize, u32, T)>, now: Millis) -> Vec<(Millis, usize, u32, T)> {
    let (mut due, later): (Vec<_>, Vec<_>) = std::mem::take(queue).into_iter().partition(|message| message.0 <= now);
    *queue = later;
    due.sort_by_key(|message| message.0);
    due
}

/// What a seed came to.
#[derive(Debug, Default)]
struct Tally {
    events: u64,
    runs: usize,
    restarts: usize,
    torn: u64,
}

fn simulate(seed: u64) -> Tally {
    let mut world = World::new(seed);
    world.run();
    Tally {
        events: world.events,
        runs: world.state.runs.len(),
        restarts: world.store.journal.iter().filter(|entry| entry["event"] == "started").count(),
        torn: world.torn,
    }
}

fn seeds_file() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/simulation/seeds.txt")
}

/// Those of `seeds.txt`, then fresh ones.
fn seeds() -> Vec<u64> {
    let number = |text: String| text.trim().parse::<u64>().unwrap_or_else(|_| panic!("`{text}` is not a seed"));
    if let Ok(seed) = std::env::var("SIM_SEED") {
        return vec![number(seed)];
    }
    let count = std::env::var("SIM_SEEDS").map_or(SEEDS, number);
    let kept = std::fs::read_to_string(seeds_file()).expect("the kept seeds");
    let kept = kept.lines().filter(|line| !line.starts_with('#') && !line.trim().is_empty());
    kept.map(|line| number(line.to_owned())).chain(1000..1000 + count).collect()
}

/// All cores take seeds from one list; a seed is a world of its own, so nothing hangs on who takes which.
#[test]
fn whatever_happens_every_run_ends_and_every_task_is_done_once() {
    let (seeds, begun) = (seeds(), std::time::Instant::now());
    let next = AtomicUsize::new(0);
    let work = || {
        let (mut sum, mut failed) = (Tally::default(), Vec::new());
        while let Some(seed) = seeds.get(next.fetch_add(1, Ordering::Relaxed)) {
            match std::panic::catch_unwind(|| simulate(*seed)) {
                Ok(tally) => {
                    sum.events += tally.events;
                    sum.runs += tally.runs;
                    sum.restarts += tally.restarts;
                    sum.torn += tally.torn;
                }
                Err(_) => failed.push(*seed),
            }
        }
        (sum, failed)
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let done: Vec<(Tally, Vec<u64>)> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        threads.into_iter().map(|thread| thread.join().expect("panics are caught")).collect()
    });
    let sum = |of: fn(&Tally) -> u64| done.iter().map(|(tally, _)| of(tally)).sum::<u64>();
    let took = begun.elapsed().as_secs_f64();
    eprintln!(
        "{} seeds in {took:.1} s, {:.0} a second: {} events, {} runs, {} starts, {} kills at a commit",
        seeds.len(),
        seeds.len() as f64 / took,
        sum(|tally| tally.events),
        sum(|tally| tally.runs as u64),
        sum(|tally| tally.restarts as u64),
        sum(|tally| tally.torn),
    );
    let failed: Vec<u64> = done.into_iter().flat_map(|(_, failed)| failed).collect();
    keep(&failed);
    assert!(failed.is_empty(), "replay with SIM_SEED={}; these seeds failed: {failed:?}", failed[0]);
}

/// Adds seeds that failed to those that are always run.
fn keep(failed: &[u64]) {
    let kept = std::fs::read_to_string(seeds_file()).unwrap_or_default();
    let new: Vec<String> =
        failed.iter().map(u64::to_string).filter(|seed| !kept.lines().any(|line| line == seed)).collect();
    if !new.is_empty() {
        let text = format!("{}\n{}\n", kept.trim_end(), new.join("\n"));
        if let Err(error) = std::fs::write(seeds_file(), text) {
            eprintln!("cannot keep the failed seeds: {error}");
        }
    }
}

#[test]
fn every_event_in_every_state_is_taken_or_refused() {
    for seed in 0..6 {
        let mut world = World::new(seed);
        world.wild = true;
        world.run();
    }
}

#[test]
fn two_runs_of_one_pipeline_compute_once_and_a_third_finds_everything() {
    let mut world = World::new(7);
    world.now = Millis(CHAOS_MS);
    let submit = || Event::Submit {
        pipeline: Box::new(pipelines::quickstart(9, WorkerRange::default(), &[])),
        source: String::new(),
        idempotency_key: None,
        until: None,
    };
    world.submissions = vec![(Millis(0), submit()), (Millis(0), submit())];
    world.run();
    let results = world.store.results.len();
    world.submissions = vec![(Millis(0), submit())];
    world.run();
    assert_eq!((world.store.results.len(), world.store.promotions), (results, 1));
    let states = |i: usize| world.views()[i].stages.iter().map(|s| s.state).collect::<Vec<_>>();
    assert!(states(0).iter().all(|state| *state == StageState::Ran), "{:?}", states(0));
    assert_eq!(states(0), states(1));
    assert!(states(2).iter().all(|state| *state == StageState::Cached), "{:?}", states(2));
    let known: Vec<&Known> = world.state.runs.iter().filter_map(|run| run.stages.last()?.known()).collect();
    assert!(known.len() == 3 && known.iter().all(|k| *k == known[0]));
}
