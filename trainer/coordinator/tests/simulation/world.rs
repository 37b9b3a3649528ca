//! The world of a seed: the real coordinator, its store, and all messages in transit.

mod disk;
mod steps;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use coordinator::batch::{Ask, Batches};
use coordinator::state::run::Run;
use coordinator::{Control, Effect, Event, Millis, Policy, Refused, State, journal};
use pipeline::Pipeline;
use protocol::message::{Member, RunState};
use protocol::stage::WorkerRange;
use protocol::{Attempt, Digest, Group, GroupLimits, Incarnation, RunId, TaskId, WorkerId};

use self::disk::{Disk, Ticket};
use crate::pipelines;
use crate::random::Random;
use crate::store::FakeStore;
use crate::worker::{Answer, Call, FakeWorker};

/// All injected faults. A fault that is never counted has silently disappeared from the simulation.
pub(crate) const INJECTED: [&str; 31] = [
    "a call that was lost",
    "a call that came twice",
    "a worker that died",
    "a worker that was stopped",
    "a cut between peers that both reach the coordinator",
    "a cut that only one of two peers notices",
    "a refused peer port",
    "a false complaint",
    "a worker that was asked to end",
    "a stage that hangs while its worker polls",
    "a member whom its peers could not reach",
    "a slow joiner",
    "a late tick of a clock that overslept",
    "a late tick of a slow disk",
    "a lease that expired",
    "a batch of several",
    "a batch that the store refused, each tried alone",
    "a full disk",
    "an ask that came while a commit was in flight",
    "a quiet poll answered while a commit was in flight",
    "a collection of what was not named yet",
    "a training that made way for a higher priority",
    "an input that was found damaged",
    "a checkpoint refused for a missing blob",
    "an outcome refused for a missing blob",
    "a gate that does not hold",
    "a crash between decide and commit",
    "a crash between commit and answer",
    "a loss of power before the commit was synced",
    "a loss of power that spared what was synced",
    "a snapshot that was overtaken by facts",
];

/// Duration of the period with faults.
pub(crate) const CHAOS_MS: u64 = 180_000;
const LIMIT_MS: u64 = 3_000_000;

/// A pair of workers that cannot reach each other.
#[derive(Debug, Clone)]
pub(crate) struct Cut {
    pub(crate) from: WorkerId,
    pub(crate) to: WorkerId,
    /// Set if only `from` notices.
    pub(crate) one_way: bool,
    pub(crate) until: Millis,
}

pub(crate) struct World {
    pub(crate) policy: Policy,
    pub(crate) random: Random,
    pub(crate) now: Millis,
    pub(crate) store: FakeStore,
    /// The same batches that the coordinator's actor drives.
    batches: Batches<u64>,
    disk: Disk,
    /// Pending requests.
    asked: BTreeMap<u64, Ticket>,
    tickets: u64,
    /// The answer for the caller that waits in [`World::happen`].
    answered: Option<Result<Vec<Effect>, Refused>>,
    /// Snapshots being stored, with their completion times.
    snapshots: Vec<(Millis, Arc<State>)>,
    /// The newest answered poll of each process, now and when the batch in flight was decided.
    heard: BTreeMap<(WorkerId, Incarnation), Millis>,
    heard_then: BTreeMap<(WorkerId, Incarnation), Millis>,
    /// Processes with a lease after the newest batch.
    present: BTreeMap<WorkerId, Incarnation>,
    /// Gangs after the newest batch, with attempts and members.
    gangs: BTreeMap<TaskId, (Attempt, Vec<Member>)>,
    /// Trainings that are asked to make way.
    preempted: BTreeSet<TaskId>,
    /// Number of injected faults by kind.
    pub(crate) injected: BTreeMap<&'static str, u64>,
    /// Set while the coordinator runs.
    pub(crate) up: bool,
    pub(crate) back_at: Millis,
    pub(crate) effects: Vec<(Millis, Effect)>,
    pub(crate) calls: Vec<(Millis, usize, u32, Call)>,
    pub(crate) answers: Vec<(Millis, usize, u32, Answer)>,
    pub(crate) workers: Vec<FakeWorker>,
    /// Workers that cannot reach each other, although the coordinator reaches them.
    pub(crate) cuts: Vec<Cut>,
    pub(crate) submissions: Vec<(Millis, Event)>,
    pub(crate) checkpoint_steps: BTreeMap<Digest, u64>,
    pub(crate) events: u64,
    /// Cancelled runs.
    pub(crate) cancelled: Vec<RunId>,
    /// Tries every kind of event at intervals.
    pub(crate) wild: bool,
    /// Kills the coordinator after stored batches, whose answers are lost: those numbered by multiples of the first
    /// value, starting from the second.
    pub(crate) kills: Option<(u64, u64)>,
    /// Kills only once.
    pub(crate) once: bool,
    pub(crate) stored: u64,
    /// Number of starts of the coordinator.
    pub(crate) starts: usize,
    /// The period without ticks: its end and its start.
    pub(crate) asleep: Option<(Millis, Millis)>,
}

/// Limits of the group whose runs are most of them.
pub(crate) fn limits(most: usize) -> Arc<BTreeMap<Group, GroupLimits>> {
    let limits = GroupLimits { workers: Some(1 + most), runs: Some(most), bytes: None };
    Arc::new(BTreeMap::from([(Group::new("me"), limits)]))
}

fn policy() -> Policy {
    let budgets = Policy { fault_budget: 1000, infrastructure_budget: 1000, ..Policy::default() };
    Policy { grace_ms: 10_000, stall_ms: 30_000, ..budgets }
}

impl World {
    pub(crate) fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        // Apart from the others, so that a seed keeps its faults.
        let mut priorities = Random::new(!seed);
        let workers = (0..1 + random.below(6)).map(|i| FakeWorker::new(&format!("w{i}"))).collect();
        let submissions = (0..1 + random.below(3))
            .map(|i| {
                let max = random.below(4) as usize;
                let range = WorkerRange { min: 1, max };
                let gates: &[&str] = if random.chance(15) { &["never <= 0"] } else { &["latent_fid <= 1"] };
                let pipeline = match random.below(4) {
                    0 => pipelines::swept(random.below(2), 4 + random.below(8)),
                    _ => match random.below(2) {
                        0 => pipelines::quickstart(0, range, gates),
                        seed => pipelines::reading_files(pipelines::quickstart(seed, range, gates)),
                    },
                };
                let pipeline = Pipeline { priority: priorities.below(3) as i32 - 1, ..pipeline };
                let is_mine = i % 2 == 0 || priorities.chance(50);
                let event = Event::Submit {
                    submission: None,
                    pipeline: Box::new(pipeline),
                    source: String::new(),
                    idempotency_key: random.chance(30).then(|| format!("key-{i}")),
                    until: random.chance(20).then(|| "mld".into()),
                    owner: protocol::Owner::local(if is_mine { "me" } else { "you" }),
                };
                (Millis(random.below(CHAOS_MS / 2)), event)
            })
            .collect();
        let limits = if priorities.chance(40) { limits(1) } else { Arc::default() };
        let policy = Policy { limits, ..policy() };
        Self {
            random,
            now: Millis(0),
            store: FakeStore::default(),
            policy: policy.clone(),
            batches: Batches::new(State::new(policy)),
            disk: Disk::Idle,
            asked: BTreeMap::new(),
            tickets: 0,
            answered: None,
            snapshots: Vec::new(),
            heard: BTreeMap::new(),
            heard_then: BTreeMap::new(),
            present: BTreeMap::new(),
            gangs: BTreeMap::new(),
            preempted: BTreeSet::new(),
            injected: BTreeMap::new(),
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
            wild: false,
            kills: None,
            once: false,
            stored: 0,
            starts: 0,
            asleep: None,
        }
    }

    fn chaos(&self) -> bool {
        self.now.0 < CHAOS_MS
    }

    /// Counts an injected fault.
    pub(crate) fn count(&mut self, what: &'static str) {
        debug_assert!(INJECTED.contains(&what), "`{what}` is not in the list");
        *self.injected.entry(what).or_default() += 1;
    }

    /// The newest stored state that the coordinator knows.
    pub(crate) fn state(&self) -> &State {
        self.batches.state()
    }

    /// Requests an event and waits for the answer while the rest of the world stands still.
    pub(crate) fn happen(&mut self, event: Event) -> Result<Vec<Effect>, Refused> {
        let starts = matches!(event, Event::Started { .. });
        self.ask(Ask::Event(Box::new(event)), Ticket::Caller);
        let ticket = self.tickets;
        while self.up && self.asked.contains_key(&ticket) {
            self.disk.hurry();
            self.turn();
        }
        let answer = self.answered.take().unwrap_or(Err(Refused::Stopped));
        self.starts += usize::from(starts && answer.is_ok());
        answer
    }

    /// Kills the coordinator: only stored data survives, and waiting callers get no answer.
    fn crash(&mut self) {
        self.up = false;
        self.back_at = self.now.after(self.random.below(40_000));
        self.forget();
    }

    /// Discards the coordinator's memory.
    fn forget(&mut self) {
        self.effects.clear();
        self.snapshots.clear();
        match self.disk.lose() {
            Disk::Idle => {}
            Disk::Writing { .. } => self.count("a crash between decide and commit"),
            Disk::Written { .. } => self.count("a crash between commit and answer"),
        }
        for ticket in std::mem::take(&mut self.asked).into_values() {
            // A client without an answer repeats its submission under the same key; without a key it may count twice.
            if let Ticket::Submission(event) = ticket {
                self.submissions.push((self.now.after(500), *event));
            }
        }
    }

    /// Recovers from the stored data and compares it with the state before.
    pub(crate) fn recovered(&mut self) {
        let recovered =
            journal::recover(self.policy.clone(), &self.store.recovery).expect("what is stored can be recovered");
        // A commit in flight may be stored, although it was not acknowledged.
        assert!(recovered.seq >= self.state().seq, "what was acknowledged is gone");
        if recovered.seq == self.state().seq {
            assert_eq!(durable(&recovered), durable(self.state()), "recovery gives what was");
        }
        self.batches = Batches::new(recovered);
        self.gangs.clear();
        self.present = self.present_now();
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
        while self.up && self.happen(Event::Started { alone, park: false }).is_err() {}
    }

    pub(crate) fn is_over(&self) -> bool {
        self.submissions.is_empty() && self.up && self.asked.is_empty() && self.state().runs.is_empty()
    }

    pub(crate) fn run(&mut self) {
        while self.now.0 < LIMIT_MS && (self.chaos() || !self.is_over()) {
            self.step();
        }
        let held: Vec<_> = self
            .state()
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
            let most = 1 + self.store.remade.get(task).copied().unwrap_or_default();
            assert!((1..=most).contains(times), "{task} was accepted {times} times, {most} are expected at most");
        }
        self.recovered();
        let held: usize = self.state().executions.values().map(|execution| execution.tasks.held().count()).sum();
        assert!(self.state().executions.size() <= held, "all that is left in memory is what workers are leaving");
    }

    /// All runs, active and ended, by submission.
    pub(crate) fn runs(&self) -> Vec<Run> {
        let ended = self.store.ended.keys().filter(|run| self.state().run(run).is_err());
        let ended = ended.map(|run| *self.store.archived(run).expect("it ended"));
        let mut runs: Vec<Run> = self.state().runs.values().map(|run| Run::clone(run)).chain(ended).collect();
        runs.sort_by_key(|run| run.number);
        runs
    }

    /// Views of all runs.
    pub(crate) fn views(&self) -> Vec<protocol::message::RunView> {
        let view = |run: Run| match self.state().run(&run.id) {
            Ok(run) => self.state().view(run, self.now),
            Err(_) => self.store.view(&run.id).expect("it ended"),
        };
        self.runs().into_iter().map(view).collect()
    }

    /// Controls a run. Like the shell, it passes the archive of an ended run.
    pub(crate) fn control(&mut self, run: &RunId, action: Control) -> Result<Vec<Effect>, Refused> {
        let event = self.control_event(run, action);
        self.happen(event)
    }

    fn control_event(&self, run: &RunId, action: Control) -> Event {
        let archived = if self.state().run(run).is_ok() { None } else { self.store.archived(run) };
        Event::Control { run: run.clone(), action, archived }
    }
}

/// The data that must survive a restart.
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
