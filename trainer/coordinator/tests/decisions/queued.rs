//! The cost of queued runs, as the number of executions, runs and workers that a decision inspects.

use coordinator::{Event, Policy, journal};
use protocol::message::TaskOutcome;
use protocol::stage::WorkerRange;
use protocol::{Digest, Owner};

use crate::common::{PureCoordinator, pipelines};

fn submit(coordinator: &mut PureCoordinator, seed: u64, until: &str) {
    let event = Event::Submit {
        submission: None,
        pipeline: Box::new(pipelines::quickstart(seed, WorkerRange { min: 1, max: 1 }, &[])),
        source: String::new(),
        idempotency_key: None,
        until: Some(until.into()),
        owner: Owner::local("me"),
    };
    coordinator.happen(event).expect("submitted");
}

/// Finishes the worker's task, which grants it the next one.
fn claim(coordinator: &mut PureCoordinator, worker: &str) {
    let held = coordinator.assignment(worker).expect("there is always something to do");
    let output = Digest::of(held.grant.task.as_str().as_bytes());
    coordinator.report(&held, TaskOutcome::Finished { output, metrics: Default::default() });
}

/// Numbers of visits and of changed state parts, for each of some claims.
fn costs(coordinator: &mut PureCoordinator) -> Vec<(u64, usize)> {
    let cost = |_| {
        let (before, visits) = (coordinator.state.clone(), coordinator.state.visits);
        claim(coordinator, "a");
        (coordinator.state.visits - visits, journal::changed_parts(&before, &coordinator.state).len())
    };
    (0..8).map(cost).collect()
}

/// Costs with `runs` runs that wait for a plain stage.
fn small(runs: u64) -> Vec<(u64, usize)> {
    let mut coordinator = PureCoordinator::new(Policy::default());
    (0..runs).for_each(|seed| submit(&mut coordinator, seed, "dataset"));
    coordinator.join("a");
    claim(&mut coordinator, "a");
    costs(&mut coordinator)
}

/// Costs with `runs` runs that wait for a gang of one.
fn gangs(runs: u64) -> Vec<(u64, usize)> {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.join("a");
    for seed in 0..runs {
        submit(&mut coordinator, seed, "vae");
        // The other datasets are made while the first run trains.
        if seed == 0 {
            claim(&mut coordinator, "a");
            coordinator.join("b");
        } else {
            claim(&mut coordinator, "b");
        }
    }
    coordinator.happen(Event::WorkerGone { worker: "b".into(), incarnation: None }).expect("taken");
    claim(&mut coordinator, "a");
    costs(&mut coordinator)
}

#[test]
fn a_claim_costs_the_same_however_many_runs_wait() {
    assert_eq!(small(20), small(200));
}

#[test]
fn a_claim_of_a_training_costs_the_same_however_many_runs_wait() {
    let few = gangs(90);
    assert_eq!(few, gangs(180));
    assert!(few.iter().all(|(visits, _)| *visits < 300), "{few:?}");
}

#[test]
fn a_snapshot_writes_what_has_changed_since_the_one_before() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    (0..100).for_each(|seed| submit(&mut coordinator, seed, "dataset"));
    coordinator.join("a");
    let before = coordinator.state.clone();
    coordinator.store.snapshot(&before);
    assert!(coordinator.store.recovery.parts.len() > 200, "each run and execution is a part");
    claim(&mut coordinator, "a");
    let changed: Vec<_> =
        journal::changed_parts(&before, &coordinator.state).iter().map(|part| part.stored()).collect();
    let gone = changed.iter().filter(|(_, text)| text.is_none()).count();
    assert_eq!((changed.len(), gone), (4, 2), "a run and its execution are over, its worker has another: {changed:?}");
    coordinator.store.snapshot(&coordinator.state);
    let recovered = journal::recover(Policy::default(), &coordinator.store.recovery).expect("it reads");
    assert_eq!((recovered.runs, recovered.executions), (coordinator.state.runs, coordinator.state.executions));
    assert_eq!((recovered.workers, recovered.queue), (coordinator.state.workers, coordinator.state.queue));
}
