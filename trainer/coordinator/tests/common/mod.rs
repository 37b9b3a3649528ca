//! The pure half with a virtual clock, for tests that control every moment.

#[path = "../simulation/pipelines.rs"]
pub(crate) mod pipelines;
#[path = "../simulation/store.rs"]
pub(crate) mod store;

use coordinator::state::worker::{Identity, Worker};
use coordinator::{
    Control, Effect, Event, Millis, Moment, Observation, Policy, Rejected, State, decide, invariants, journal, observe,
};
use protocol::message::{
    Assignment, FailureClass, Join, PROTOCOL_VERSION, Poll, Prepare, ReportOutcome, RunState, RunView, TaskOutcome,
};
use protocol::stage::{Backend, WorkerRange};
use protocol::{Digest, Incarnation, RunId, WorkerId};

/// A coordinator without a shell: one call after the other, at times chosen by the test.
pub(crate) struct PureCoordinator {
    pub(crate) state: State,
    pub(crate) store: store::FakeStore,
    pub(crate) now: u64,
    pub(crate) entropy: Digest,
    /// Set if workers have requested inputs at once.
    pub(crate) quick: bool,
}

impl PureCoordinator {
    pub(crate) fn new(policy: Policy) -> Self {
        Self {
            state: State::new(policy),
            store: store::FakeStore::default(),
            now: 1_000_000,
            entropy: Digest::of(b"entropy"),
            quick: true,
        }
    }

    /// Decides and stores an event; lookups query the fake store.
    pub(crate) fn happen(&mut self, event: Event) -> Result<Vec<Effect>, Rejected> {
        let moment = Moment { now: Millis(self.now), entropy: self.entropy };
        let before = self.state.clone();
        let effects = decide(&mut self.state, moment, event)?;
        let broken = invariants::check_change(&before, &self.state);
        assert!(broken.is_empty(), "{broken:#?}");
        for effect in &effects {
            match effect {
                Effect::Store(writes) => self.store.write(writes).expect("stored"),
                Effect::Lookup { key } => drop(self.happen(self.store.look_up(*key))?),
                _ => {}
            }
        }
        let names: Vec<WorkerId> = self.state.workers.keys().filter(|_| self.quick).cloned().collect();
        for name in names {
            self.prepare(name.as_str());
        }
        Ok(effects)
    }

    /// Reports all requested inputs of a worker as fetched.
    pub(crate) fn prepare(&mut self, name: &str) {
        let worker = WorkerId::from(name);
        let Worker { incarnation, ready, .. } = self.state.workers[&worker].clone();
        let asked = self.asked(name);
        if asked.iter().any(|prepare| !ready.contains(&prepare.task)) {
            let tasks = asked.into_iter().map(|prepare| prepare.task).collect();
            self.happen(Event::WorkerReady { worker, incarnation, tasks }).expect("taken");
        }
    }

    /// The inputs that a worker is asked to fetch.
    pub(crate) fn asked(&self, name: &str) -> Vec<Prepare> {
        let worker = WorkerId::from(name);
        let incarnation = self.state.workers[&worker].incarnation;
        self.state.desired(&worker, incarnation).expect("known").prepare
    }

    pub(crate) fn hear(&mut self, observation: Observation) {
        for event in observe(&mut self.state, Millis(self.now), observation).expect("heard") {
            self.happen(event).expect("what follows from the clock is taken");
        }
    }

    /// Simulates `kill -9` and a new coordinator on the same store.
    pub(crate) fn restart(&mut self, alone: bool) {
        let policy = self.state.policy.clone();
        self.state = journal::recover(policy, &self.store.recovery).expect("what is stored can be recovered");
        self.happen(Event::Started { alone, park: false }).expect("starts");
    }

    pub(crate) fn submit(&mut self, until: &str, workers: WorkerRange) -> RunId {
        let event = Event::Submit {
            submission: None,
            pipeline: Box::new(pipelines::quickstart(1, workers, &[])),
            source: String::new(),
            idempotency_key: None,
            until: Some(until.into()),
            owner: protocol::Owner::local("me"),
        };
        let effects = self.happen(event).expect("submitted");
        let run = effects.into_iter().find_map(|effect| match effect {
            Effect::Submitted(run) => Some(run),
            _ => None,
        });
        run.expect("a submission gives a run")
    }

    pub(crate) fn join(&mut self, name: &str) -> Incarnation {
        self.join_with(name, "avx2")
    }

    pub(crate) fn join_with(&mut self, name: &str, instruction_set: &str) -> Incarnation {
        self.join_labelled(name, instruction_set, "")
    }

    pub(crate) fn join_labelled(&mut self, name: &str, instruction_set: &str, labels: &str) -> Incarnation {
        let labels = labels.parse().expect("labels");
        self.join_as(Join { instruction_set: instruction_set.into(), labels, ..Self::offer(name) })
    }

    /// What a worker of this build says when it joins.
    pub(crate) fn offer(name: &str) -> Join {
        Join {
            protocol: PROTOCOL_VERSION,
            worker: name.into(),
            pid: 1,
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            code_versions: protocol::stage::StageSettings::code_versions(),
            peer_address: format!("{name}:1"),
            labels: Default::default(),
        }
    }

    pub(crate) fn join_as(&mut self, join: Join) -> Incarnation {
        let name = join.worker.to_string();
        // Always the same process, with the same secret.
        let by = Identity { caller: "t".into(), secret: Digest::of(name.as_bytes()) };
        let effects = self.happen(Event::Join { join, by }).expect("joined");
        let joined = effects.into_iter().find_map(|effect| match effect {
            Effect::Joined(incarnation) => Some(incarnation),
            _ => None,
        });
        joined.expect("a join gives an incarnation")
    }

    pub(crate) fn poll(&mut self, name: &str, incarnation: Incarnation) {
        let poll = Poll { incarnation, doing: Vec::new(), ready: Vec::new(), version: 0, leaving: false };
        self.hear(Observation::Poll { worker: name.into(), poll });
    }

    pub(crate) fn assignment(&self, name: &str) -> Option<Assignment> {
        let worker: WorkerId = name.into();
        let incarnation = self.state.workers[&worker].incarnation;
        self.state.desired(&worker, incarnation).expect("known").assignments.into_iter().next()
    }

    pub(crate) fn report(&mut self, assignment: &Assignment, outcome: TaskOutcome) {
        let report = ReportOutcome::new(assignment.grant.clone(), outcome);
        self.happen(Event::Outcome { report }).expect("taken");
    }

    pub(crate) fn view(&self, run: &RunId) -> RunView {
        match self.state.run(run) {
            Ok(run) => self.state.view(run, Millis(self.now)),
            Err(_) => self.store.view(run).expect("it ended"),
        }
    }

    pub(crate) fn run_state(&self, run: &RunId) -> RunState {
        self.view(run).state
    }

    pub(crate) fn control(&mut self, run: &RunId, action: Control) -> Result<Vec<Effect>, Rejected> {
        let archived = if self.state.run(run).is_ok() { None } else { self.store.archived(run) };
        self.happen(Event::Control { run: run.clone(), action, archived })
    }

    pub(crate) fn tick(&mut self) {
        self.hear(Observation::Tick { overslept: 0 });
    }

    pub(crate) fn is_held(&self) -> bool {
        self.state.executions.values().any(|execution| execution.is_busy())
    }
}

pub(crate) fn failed(class: FailureClass) -> TaskOutcome {
    TaskOutcome::Failed { class, message: "made up".into() }
}

/// Starts a gang of three in training; returns the incarnations of its members by rank.
pub(crate) fn gang_of_three(coordinator: &mut PureCoordinator) -> (RunId, [Incarnation; 3]) {
    let run = coordinator.submit("vae", WorkerRange { min: 1, max: 3 });
    let a = coordinator.join("a");
    let dataset = coordinator.assignment("a").expect("the only worker gets it");
    coordinator.report(&dataset, TaskOutcome::Finished { output: Digest::of(b"clips"), metrics: Default::default() });
    let [b, c] = ["b", "c"].map(|name| coordinator.join(name));
    (run, [a, b, c])
}
