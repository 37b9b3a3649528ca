//! Simulation of the real `decide` and the actor's real batches with fake workers, a fake store and virtual time,
//! driven by one seed. Calls are lost, duplicated, delayed and reordered. Workers die, hang, run slowly or lose contact
//! with each other. The clock is late; the store fills up and collects garbage. The coordinator is killed between any
//! two events or during a commit, with or without a loss of power, and recovers by replay. [`INJECTED`] lists all
//! faults. Invariants are checked after every event, and in the end every submitted task is done exactly once.
//!
//! `SIM_SEED=n` replays one seed. `SIM_SEEDS=n` sets the number of seeds; the default is 120, or 2,000 with
//! `STRIDE_LONG_TESTS=1`. Failed seeds are added to `seeds.txt` beside this file, which always runs first.

mod pipelines;
mod random;
mod store;
mod sweeps;
mod upgrade;
mod wild;
mod worker;
mod world;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use coordinator::state::execution::{ExecutionState, StageExecution};
use coordinator::state::run::Status;
use coordinator::value::Known;
use coordinator::{Control, Event, Millis};
use protocol::message::{RunState, StageState};
use protocol::stage::{DataSynthetic, WorkerRange};

use crate::world::{CHAOS_MS, INJECTED, World};

/// Number of new seeds in every run of the tests; permanent seeds run as well.
const SEEDS: u64 = 120;
/// Number of seeds in long tests.
const MANY_SEEDS: u64 = 2_000;
/// Number of seeds among which every kind of fault must occur.
const ENOUGH: usize = 100;

/// Statistics of a seed.
#[derive(Debug, Default)]
struct Tally {
    events: u64,
    runs: usize,
    restarts: usize,
    injected: BTreeMap<&'static str, u64>,
}

impl Tally {
    fn add(&mut self, other: Self) {
        self.events += other.events;
        self.runs += other.runs;
        self.restarts += other.restarts;
        for (what, times) in other.injected {
            *self.injected.entry(what).or_default() += times;
        }
    }
}

fn simulate(seed: u64) -> Tally {
    let mut world = World::new(seed);
    world.run();
    let runs = world.runs().len();
    Tally { events: world.events, runs, restarts: world.starts, injected: world.injected }
}

fn seeds_file() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/simulation/seeds.txt")
}

/// Seeds of `seeds.txt`, then new ones.
fn seeds() -> Vec<u64> {
    let number = |text: String| text.trim().parse::<u64>().unwrap_or_else(|_| panic!("`{text}` is not a seed"));
    if let Ok(seed) = std::env::var("SIM_SEED") {
        return vec![number(seed)];
    }
    let usual = || if fixtures::long("2,000 seeds of the simulation") { MANY_SEEDS } else { SEEDS };
    let count = std::env::var("SIM_SEEDS").map_or_else(|_| usual(), number);
    let kept = std::fs::read_to_string(seeds_file()).expect("the kept seeds");
    let kept = kept.lines().filter(|line| !line.starts_with('#') && !line.trim().is_empty());
    kept.map(|line| number(line.to_owned())).chain(1000..1000 + count).collect()
}

/// All cores take seeds from one list. A seed is a world of its own, so the assignment to threads has no effect.
#[test]
fn whatever_happens_every_run_ends_and_every_task_is_done_once() {
    let (seeds, begun) = (seeds(), std::time::Instant::now());
    let next = AtomicUsize::new(0);
    let execution = || {
        let (mut sum, mut failed) = (Tally::default(), Vec::new());
        while let Some(seed) = seeds.get(next.fetch_add(1, Ordering::Relaxed)) {
            match std::panic::catch_unwind(|| simulate(*seed)) {
                Ok(tally) => sum.add(tally),
                Err(_) => failed.push(*seed),
            }
        }
        (sum, failed)
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let done: Vec<(Tally, Vec<u64>)> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(execution)).collect();
        threads.into_iter().map(|thread| thread.join().expect("panics are caught")).collect()
    });
    let (mut sum, mut failed) = (Tally::default(), Vec::new());
    for (tally, seeds) in done {
        sum.add(tally);
        failed.extend(seeds);
    }
    let took = begun.elapsed().as_secs_f64();
    let each = seeds.len() as f64 / took;
    eprintln!("{} seeds in {took:.1} s, {each:.0} a second", seeds.len());
    eprintln!("{} events, {} runs, {} starts", sum.events, sum.runs, sum.restarts);
    let times = |what| sum.injected.get(what).copied().unwrap_or_default();
    for what in INJECTED {
        eprintln!("{:>9} times {what}", times(what));
    }
    keep(&failed);
    assert!(failed.is_empty(), "replay with SIM_SEED={}; these seeds failed: {failed:?}", failed[0]);
    if seeds.len() >= ENOUGH {
        let missing: Vec<&str> = INJECTED.into_iter().filter(|what| times(what) == 0).collect();
        assert!(missing.is_empty(), "none of {} seeds had {missing:?}", seeds.len());
    }
}

/// Adds failed seeds to the list of permanent seeds.
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

fn submission(pipeline: pipeline::Pipeline) -> Event {
    Event::Submit {
        submission: None,
        pipeline: Box::new(pipeline),
        source: String::new(),
        idempotency_key: None,
        until: None,
        owner: protocol::Owner::local("me"),
    }
}

/// A damaged input is recomputed while its reader waits, and all stages keep their values.
#[test]
fn a_damaged_input_is_made_again_within_the_run() {
    let mut world = World::new(7);
    world.now = Millis(CHAOS_MS);
    world.submissions = vec![(Millis(0), submission(pipelines::quickstart(9, WorkerRange::default(), &[])))];
    let damaged = loop {
        world.step();
        let reads =
            |worker: &&mut worker::FakeWorker| worker.grant().is_some_and(|g| g.task.as_str().ends_with("/lcm"));
        let now = world.now;
        let found = world.workers.iter_mut().find(reads).and_then(|reader| reader.finds_damage(now, |_| true));
        if let Some(input) = found {
            break input;
        }
    };
    let results = world.store.results.len();
    world.store.damage(damaged);
    assert_eq!(world.store.results.len(), results - 1, "one stage gave it");
    let mut waited = false;
    while !world.is_over() {
        world.step();
        let waits = |message: &Option<String>| message.as_ref().is_some_and(|m| m.contains("damaged input"));
        waited |= world.views()[0].stages.iter().any(|stage| waits(&stage.message));
        assert!(world.views()[0].stages.iter().all(|stage| stage.state != StageState::Failed), "{:?}", world.views());
    }
    assert!(waited, "its reader says what it waits for");
    assert!(world.store.results.values().any(|(known, ..)| known.outputs.values().any(|output| *output == damaged)));
    assert!(world.views()[0].stages.iter().all(|stage| stage.state == StageState::Ran), "{:?}", world.views());
}

/// A run needs a value that is made again, and another run with the same value ends meanwhile. `shared` brings the first run
/// to the stage that finds the damage, with the second one.
fn damaged_while_another_run_ends(shared: impl Fn(&mut World)) {
    let mut world = World::new(7);
    world.now = Millis(CHAOS_MS);
    shared(&mut world);
    let [first, second] = [0, 1].map(|i| world.runs()[i].id.clone());
    let reads =
        |worker: &&mut worker::FakeWorker| worker.grant().is_some_and(|grant| grant.task.as_str().ends_with("/vae"));
    let waits = |execution: &Arc<StageExecution>| matches!(execution.state, ExecutionState::Mending { .. });
    let mut damaged = None;
    while !world.state().executions.values().any(waits) {
        world.step();
        let now = world.now;
        // A report is too late if the gang has changed since, so there may be several.
        if world.runs().iter().all(|run| run.is_at_work() && run.status(&"vae".into()).is_some_and(is_active))
            && let Some(reader) = world.workers.iter_mut().find(reads)
            && let Some(input) = reader.finds_damage(now, |_| true)
        {
            world.store.damage(input);
            damaged = Some(input);
        }
    }
    world.cancelled.push(second.clone());
    world.control(&second, Control::Cancel).expect("it runs");
    world.run();
    let states = world.runs().iter().map(|run| (run.id.clone(), run.state)).collect::<Vec<_>>();
    assert_eq!(states, [(first, RunState::Finished), (second, RunState::Cancelled)]);
    let mut outputs = world.store.results.values().flat_map(|(known, ..)| known.outputs.values());
    assert!(outputs.any(|output| Some(*output) == damaged), "it was made again");
}

fn is_active(status: &Status) -> bool {
    matches!(status, Status::Active { .. })
}

/// The second run gives the value under another key.
#[test]
fn a_value_is_made_again_though_another_run_that_gives_it_ends() {
    damaged_while_another_run_ends(|world| {
        let other = DataSynthetic { clips: 7, ..DataSynthetic::default() };
        let mut second = pipelines::quickstart(9, WorkerRange::default(), &[]);
        second.stages[0].settings = other.into();
        world.submissions = vec![
            (Millis(0), submission(pipelines::quickstart(9, WorkerRange::default(), &[]))),
            (Millis(0), submission(second)),
        ];
        while world.runs().len() < 2 {
            world.step();
        }
    });
}

/// The first run is resumed, so the second one has begun the execution that gives the value.
#[test]
fn a_value_of_a_resumed_run_is_made_again_though_another_run_ends() {
    damaged_while_another_run_ends(|world| {
        let quickstart = || submission(pipelines::quickstart(9, WorkerRange::default(), &[]));
        let until_active = |world: &mut World| {
            while !world.runs().last().and_then(|run| run.status(&"vae".into())).is_some_and(is_active) {
                world.step();
            }
        };
        world.submissions = vec![(Millis(0), quickstart())];
        until_active(world);
        let first = world.runs()[0].id.clone();
        world.control(&first, Control::Cancel).expect("it runs");
        while !world.state().executions.is_empty() {
            world.step();
        }
        world.control(&first, Control::Resume).expect("it was cancelled");
        until_active(world);
        world.submissions = vec![(Millis(0), quickstart())];
        while world.runs().len() < 2 {
            world.step();
        }
    });
}

#[test]
fn two_runs_of_one_pipeline_compute_once_and_a_third_finds_everything() {
    let mut world = World::new(7);
    world.now = Millis(CHAOS_MS);
    let submit = || submission(pipelines::quickstart(9, WorkerRange::default(), &[]));
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
    let runs = world.runs();
    let known: Vec<&Known> = runs.iter().filter_map(|run| run.stages.last()?.known()).collect();
    assert!(known.len() == 3 && known.iter().all(|k| *k == known[0]));
}
