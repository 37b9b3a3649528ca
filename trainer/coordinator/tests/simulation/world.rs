//! The world of a seed: the coordinator as it is, what it stores, and everything that is on its way.

mod steps;

use std::collections::BTreeMap;

use coordinator::observe::is_quiet;
use coordinator::state::run::Run;
use coordinator::{Control, Effect, Event, Millis, Moment, Observation, Policy, Rejected, State};
use coordinator::{decide, invariants, journal, observe, refused_for_good};
use protocol::message::{RunState, TaskOutcome};
use protocol::stage::WorkerRange;
use protocol::{Digest, RunId, WorkerId};

use crate::pipelines;
use crate::random::Random;
use crate::store::{FakeStore, Refusal};
use crate::worker::{Answer, Call, FakeWorker};

/// How long things go wrong.
pub(crate) const CHAOS_MS: u64 = 180_000;
const LIMIT_MS: u64 = 3_000_000;

pub(crate) struct World {
    pub(crate) policy: Policy,
    pub(crate) random: Random,
    pub(crate) now: Millis,
    pub(crate) store: FakeStore,
    pub(crate) state: State,
    /// The coordinator runs.
    pub(crate) up: bool,
    pub(crate) back_at: Millis,
    pub(crate) effects: Vec<(Millis, Effect)>,
    pub(crate) calls: Vec<(Millis, usize, u32, Call)>,
    pub(crate) answers: Vec<(Millis, usize, u32, Answer)>,
    pub(crate) workers: Vec<FakeWorker>,
    /// Pairs of workers that cannot reach each other, and until when; the coordinator reaches both.
    pub(crate) cuts: Vec<(WorkerId, WorkerId, Millis)>,
    pub(crate) submissions: Vec<(Millis, Event)>,
    pub(crate) checkpoint_steps: BTreeMap<Digest, u64>,
    pub(crate) events: u64,
    pub(crate) cancelled: Vec<RunId>,
    /// Kills on either side of a commit: what the disk has is all that is left.
    pub(crate) torn: u64,
    /// Try every event now and then.
    pub(crate) wild: bool,
    /// Kill the coordinator after each stored event whose number is a multiple of the first, from the second on; its answer is lost.
    pub(crate) kills: Option<(u64, u64)>,
    /// Only the first of them.
    pub(crate) once: bool,
    pub(crate) stored: u64,
    /// Starts of the coordinator.
    pub(crate) starts: usize,
    /// Reports that named what was collected before.
    pub(crate) missing: usize,
    /// Until when nobody looks at the clock, and since when.
    pub(crate) asleep: Option<(Millis, Millis)>,
}

/// What a worker uploaded before it reported this.
fn named(event: &Event) -> Option<Digest> {
    match event {
        Event::Checkpoint { commit } => Some(commit.manifest),
        Event::Outcome { report } => match report.outcome {
            TaskOutcome::Finished { output, .. } => Some(output),
            TaskOutcome::Yielded { .. } | TaskOutcome::Failed { .. } => None,
        },
        _ => None,
    }
}

fn policy() -> Policy {
    Policy { grace_ms: 10_000, fault_budget: 1000, infrastructure_budget: 1000, ..Policy::default() }
}

impl World {
    pub(crate) fn new(seed: u64) -> Self {
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
            policy: policy(),
            state: State::new(policy()),
            up: true,
            back_at: Millis(0),
            effects: Vec::new(),
            calls: Vec::new(),
            answers: Vec::new(),
            workers,
            cuts: Vec::new(),
            submissions,
            checkpoint_steps: BTreeMap::new(),
            events: 0,
            cancelled: Vec::new(),
            torn: 0,
            wild: false,
            kills: None,
            once: false,
            stored: 0,
            starts: 0,
            missing: 0,
            asleep: None,
        }
    }

    fn chaos(&self) -> bool {
        self.now.0 < CHAOS_MS
    }

    /// One event through the real thing: decide on a copy, store, publish.
    pub(crate) fn happen(&mut self, event: Event) -> Result<Vec<Effect>, Refused> {
        self.events += 1;
        let moment = Moment { now: self.now, entropy: self.random.digest() };
        let mut next = self.state.clone();
        let starts = matches!(event, Event::Started { .. });
        let joins = matches!(event, Event::Join { .. });
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
        let wrote = matches!(effects.first(), Some(Effect::Store(_)));
        if wrote {
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
            if self.chaos() && self.random.chance(1) {
                // The collector comes between an upload and the report that names it.
                self.store.collected.extend(named(&event));
            }
            let written = self.store.write(&writes);
            if let Err(Refusal::Missing(digest)) = written {
                // Whoever tries again uploads it again.
                self.store.collected.clear();
                let error = registry::WriteError::NotFound(format!("blob {digest} is not in the store"));
                self.missing += 1;
                if let Some(instead) = refused_for_good(&event, &error) {
                    self.happen(instead)?;
                }
                return Err(Refused::Store(Refusal::Missing(digest)));
            }
            self.store.collected.clear();
            written.map_err(Refused::Store)?;
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
        self.starts += usize::from(starts);
        if self.chaos() && self.random.chance(2) {
            self.store.snapshot(&self.state);
        }
        // Whoever never hears that it has joined joins for ever.
        let spared = !wrote || starts || (joins && !self.once);
        if let Some((every, from)) = self.kills
            && !spared
            && self.stored >= from
            && self.stored.is_multiple_of(every)
        {
            self.effects.clear();
            if self.once {
                self.kills = None;
            }
            self.recovered();
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
        let quiet = match &observation {
            Observation::Poll { worker, poll } => is_quiet(&self.state, worker, poll) == Ok(true),
            Observation::Tick { .. } => false,
        };
        let events = observe(&mut self.state, self.now, observation).map_err(Refused::Rejected)?;
        assert!(!quiet || events.is_empty(), "a poll from which nothing follows gave {events:?}");
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
            Effect::Lookup { key } => self.store.look_up(*key),
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

    /// What is stored is what was; whoever comes back goes on from it.
    fn recovered(&mut self) {
        let recovered =
            journal::recover(self.policy.clone(), &self.store.recovery).expect("what is stored can be recovered");
        assert_eq!(durable(&recovered), durable(&self.state), "recovery gives what was");
        self.state = recovered;
    }

    fn recover(&mut self) {
        self.recovered();
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

    pub(crate) fn is_over(&self) -> bool {
        self.submissions.is_empty() && self.up && self.state.runs.is_empty()
    }

    pub(crate) fn run(&mut self) {
        while self.now.0 < LIMIT_MS && (self.chaos() || !self.is_over()) {
            self.step();
        }
        let held: Vec<_> = self
            .state
            .executions
            .values()
            .flat_map(|execution| &execution.tasks)
            .filter(|task| task.is_held())
            .collect();
        assert!(self.is_over(), "not over after {LIMIT_MS} ms: {held:#?} {:#?}", self.workers);
        for run in self.runs() {
            let never = format!("{:?}", run.pipeline).contains("never");
            let whole = run.until.is_none();
            let expected = match run.state {
                RunState::Cancelled => self.cancelled.contains(&run.id),
                RunState::Failed => never && whole,
                RunState::Finished => !(never && whole) || self.store.promotions > 0,
                RunState::Running | RunState::Paused => false,
            };
            assert!(expected, "{}: {:#?}", run.id, self.store.view(&run.id));
            let stored = serde_json::to_value(run.state).expect("a word");
            assert_eq!(stored.as_str(), self.store.runs.get(&run.id).map(String::as_str), "the row follows the state");
        }
        for (task, times) in &self.store.accepted {
            assert_eq!(*times, 1, "{task} was accepted {times} times");
        }
        self.recovered();
        let held: usize = self.state.executions.values().map(|execution| execution.tasks.held().count()).sum();
        assert!(self.state.executions.len() <= held, "all that is left in memory is what workers are leaving");
    }

    /// All runs, whether they go on or have ended, by submission.
    pub(crate) fn runs(&self) -> Vec<Run> {
        let ended = self.store.ended.keys().filter(|run| self.state.run(run).is_err());
        let ended = ended.map(|run| *self.store.archived(run).expect("it ended"));
        let mut runs: Vec<Run> = self.state.runs.values().map(|run| Run::clone(run)).chain(ended).collect();
        runs.sort_by_key(|run| run.number);
        runs
    }

    /// As clients see them.
    pub(crate) fn views(&self) -> Vec<protocol::message::RunView> {
        let view = |run: Run| match self.state.run(&run.id) {
            Ok(run) => self.state.view(run, self.now),
            Err(_) => self.store.view(&run.id).expect("it ended"),
        };
        self.runs().into_iter().map(view).collect()
    }

    /// As the shell does: a run that has ended is handed in.
    pub(crate) fn control(&mut self, run: &RunId, action: Control) -> Result<Vec<Effect>, Refused> {
        let archived = if self.state.run(run).is_ok() { None } else { self.store.archived(run) };
        self.happen(Event::Control { run: run.clone(), action, archived })
    }
}

#[derive(Debug)]
pub(crate) enum Refused {
    Rejected(Rejected),
    Store(Refusal),
    /// The coordinator was killed while it stored the event; who asked hears nothing.
    Killed,
}

/// What must survive a restart.
fn durable(state: &State) -> impl PartialEq + std::fmt::Debug + use<> {
    (
        state.workers.clone(),
        state.runs.clone(),
        state.executions.clone(),
        state.tasks.clone(),
        state.unused.clone(),
        (state.draining, state.now, state.seq),
        (state.submitted, state.incarnation, state.fence),
    )
}
