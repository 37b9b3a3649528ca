//! Upgrades: a store of another build opens under another policy and another order of grants, and its run finishes.
//!
//! `testdata/store.json` is the store of a sweep with three workers. One worker was lost, and another held a training
//! task with a checkpoint. `make_the_store` wrote it. It is rewritten only if the major number of `journal::FORMAT`
//! changes, because the test shows that stored data stays readable.

use std::path::PathBuf;

use coordinator::state::run::Status;
use coordinator::state::task::Part;
use coordinator::{Event, GrantOrder, Millis, Policy, State, journal};
use protocol::message::RunState;

use crate::pipelines;
use crate::store::FakeStore;
use crate::worker::FakeWorker;
use crate::world::{CHAOS_MS, World};

const TRIALS: u64 = 12;

fn file() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("testdata/store.json")
}

fn world(seed: u64) -> World {
    let mut world = World::new(seed);
    world.now = Millis(CHAOS_MS);
    world.workers = ["a", "b", "c"].map(FakeWorker::new).into();
    world.submissions = Vec::new();
    world
}

/// Returns true if a worker holds a training task with a checkpoint.
fn holds_with_a_checkpoint(state: &State) -> bool {
    let mut tasks = state.executions.values().flat_map(|execution| &execution.tasks);
    tasks.any(|task| task.part == Part::Gang && task.is_held() && task.newest().is_some())
}

#[test]
#[ignore = "writes the sample; see the header"]
fn make_the_store() {
    let mut world = world(3);
    let pipeline = Box::new(pipelines::swept(3, TRIALS));
    let submit = Event::Submit {
        submission: None,
        pipeline,
        source: String::new(),
        idempotency_key: Some("once".into()),
        until: None,
        owner: protocol::Owner::local("me"),
    };
    world.submissions = vec![(world.now, submit)];
    let trials_done =
        |world: &World| world.state().runs.values().flat_map(|run| &run.sweeps).any(|s| s.search.score(14).is_some());
    for _ in 0..4_000 {
        world.step();
        if trials_done(&world) && holds_with_a_checkpoint(world.state()) {
            break;
        }
    }
    let lost = world.state().workers.iter().find(|(_, worker)| worker.holds.is_some()).expect("one works").0.clone();
    world.happen(Event::WorkerGone { worker: lost, incarnation: None }).expect("taken");
    while !holds_with_a_checkpoint(world.state()) {
        world.step();
    }
    let first = world.store.recovery.facts.len() / 2;
    let half = registry::Recovery { facts: world.store.recovery.facts[..first].to_vec(), ..Default::default() };
    let half = journal::recover(world.policy.clone(), &half).expect("half of it");
    world.store.snapshot(&half);
    std::fs::create_dir_all(file().parent().expect("a folder")).expect("a folder");
    std::fs::write(file(), world.store.to_json()).expect("written");
}

#[test]
fn a_store_of_another_build_opens_under_another_policy_and_goes_on() {
    let text = std::fs::read_to_string(file()).expect("the sample");
    let mut ends = Vec::new();
    for (grants, lease_ms, backoff_ms) in [
        (GrantOrder::ByName, 15_000, 500),
        (GrantOrder::ByNameBackwards, 4_000, 50),
        (GrantOrder::ByNameBackwards, 60_000, 9_000),
    ] {
        let mut world = world(5);
        world.policy =
            Policy { grants, lease_ms, backoff_ms, fault_budget: 3, infrastructure_budget: 3, ..world.policy };
        world.store = FakeStore::from_json(&text);
        assert!(world.store.recovery.snapshot.is_some() && world.store.recovery.facts.len() > 50, "both are there");
        world.recovered();
        assert!(holds_with_a_checkpoint(world.state()), "a task is held");
        let run = world.state().runs.values().next().expect("a run").id.clone();
        world.now = world.state().now.after(60_000);
        world.happen(Event::Started { alone: false, park: false }).expect("starts");
        world.run();
        let run = *world.store.archived(&run).expect("it ended");
        assert_eq!(run.state, RunState::Finished);
        assert_eq!(world.store.versions, 1);
        let value = |status: &Status| status.known().map(|known| known.outputs.clone());
        ends.push((run.stages.iter().map(value).collect::<Vec<_>>(), run.sweeps[0].search.best()));
    }
    assert!(ends.iter().all(|end| *end == ends[0]), "the values are the same by any rules");
}
