//! Decisions of a sweep, independent of the number of workers and of restarts of the coordinator.

use coordinator::search::{Score, Ticket};
use coordinator::state::run::Status;
use coordinator::{Event, Millis};
use protocol::message::{RunState, StageState, TrialState};

use crate::pipelines;
use crate::worker::FakeWorker;
use crate::world::{CHAOS_MS, World};

const TRIALS: u64 = 50;

/// All decisions of a sweep.
type Decisions = (Vec<Ticket>, Vec<Option<Score>>, Option<(usize, f64)>, Status);

fn world(workers: usize, seed: u64) -> World {
    sized(workers, seed, TRIALS)
}

fn sized(workers: usize, seed: u64, trials: u64) -> World {
    let mut world = World::new(seed);
    world.now = Millis(CHAOS_MS);
    world.workers = (0..workers).map(|i| FakeWorker::new(&format!("w{i}"))).collect();
    let pipeline = Box::new(pipelines::swept(3, trials));
    let idempotency_key = Some("once".to_owned());
    let submit = Event::Submit {
        submission: None,
        pipeline,
        source: String::new(),
        idempotency_key,
        until: None,
        owner: protocol::Owner::local("me"),
    };
    world.submissions = vec![(Millis(0), submit)];
    world
}

fn decisions(world: &World) -> Decisions {
    let run = &world.runs()[0];
    assert_eq!(run.state, RunState::Finished, "{:?}", world.views()[0].stages.last());
    let sweep = &run.sweeps[0];
    let search = &sweep.search;
    let scores = (0..search.tickets().len()).map(|ticket| search.score(ticket)).collect();
    let Status::Done { key, known, .. } = run.stages[sweep.stage].clone() else { panic!("the sweep is not done") };
    let (attempt, peak_memory) = Default::default();
    let status = Status::Done { key, how: StageState::Ran, known, wall_s: 0.0, attempt, peak_memory };
    (search.tickets().to_vec(), scores, search.best(), status)
}

fn reference() -> (Decisions, u64) {
    let mut world = world(2, 1);
    world.run();
    (decisions(&world), world.stored)
}

#[test]
fn p19_a_sweep_decides_the_same_with_any_workers() {
    let (reference, _) = reference();
    let (tickets, scores, best, _) = &reference;
    let rungs = |wanted| tickets.iter().filter(|t| matches!(t, Ticket::Rung { rung, .. } if *rung == wanted)).count();
    assert_eq!(rungs(0), TRIALS as usize);
    assert!(rungs(1) >= 12 && rungs(2) >= 3 && best.is_some(), "{tickets:?}");
    assert!(scores.contains(&Some(Score::Failed)), "some trials fail, and the sweep goes on");
    for (workers, seed) in [(1, 2), (3, 3), (7, 4), (16, 5)] {
        let mut world = world(workers, seed);
        world.run();
        assert_eq!(decisions(&world), reference, "{workers} workers");
    }
}

#[test]
fn p19_a_sweep_decides_the_same_wherever_the_coordinator_is_killed() {
    let (reference, events) = reference();
    // First a kill after every event; then single kills at events spread over the whole run.
    let single = (0..8).map(|i| ((1, i * events / 8), true));
    for (i, ((every, from), once)) in [((1, 0), false)].into_iter().chain(single).enumerate() {
        let mut world = world(1 + i % 4, 10 + i as u64);
        (world.kills, world.once) = (Some((every, from)), once);
        world.run();
        assert_eq!(decisions(&world), reference, "killed every {every} from {from}");
    }
}

#[test]
fn a_sweep_is_found_again_and_shows_what_became_of_its_trials() {
    let mut world = world(3, 6);
    world.run();
    let results = world.store.results.len();
    let again = Event::Submit {
        submission: None,
        pipeline: Box::new(pipelines::swept(3, TRIALS)),
        source: String::new(),
        idempotency_key: None,
        until: None,
        owner: protocol::Owner::local("me"),
    };
    world.submissions = vec![(Millis(0), again)];
    world.run();
    assert_eq!(world.store.results.len(), results, "nothing is computed twice");
    let views = world.views();
    // The last reported progress of a failed trial may or may not have arrived.
    let trials = |run: usize| {
        let mut trials = views[run].sweeps[0].trials.clone();
        trials.iter_mut().filter(|trial| trial.state == TrialState::Failed).for_each(|trial| trial.steps = 0);
        trials
    };
    assert_eq!(trials(0), trials(1));
    let swept = |run: usize| views[run].stages.iter().find(|stage| stage.name.as_str() == "pcm").expect("the stage");
    assert_eq!((swept(0).state, swept(1).state), (StageState::Ran, StageState::Cached));
    assert_eq!((&swept(0).outputs, &swept(0).metrics), (&swept(1).outputs, &swept(1).metrics));
    let sweep = &views[0].sweeps[0];
    let best = &sweep.trials[sweep.best.expect("a best trial")];
    assert_eq!((best.state, best.steps, best.results.len()), (TrialState::Finished, 18, 3));
    assert_eq!(swept(0).metrics["latent_fid"], best.results[2].expect("a result"));
    assert_eq!(swept(0).metrics["sweep.trial"], best.trial as f64);
    let count = |state| sweep.trials.iter().filter(|trial| trial.state == state).count();
    assert!(count(TrialState::Stopped) > 25 && count(TrialState::Failed) > 1, "{sweep:?}");
    assert_eq!(count(TrialState::Waiting) + count(TrialState::Running) + count(TrialState::Paused), 0);
    assert!(sweep.over && sweep.spent * 2 <= sweep.full && sweep.spent <= sweep.planned, "{sweep:?}");
}

#[test]
fn a_metric_that_nobody_reports_ends_the_run_at_once() {
    let mut world = world(2, 8);
    let mut pipeline = pipelines::swept(3, TRIALS);
    let stage = pipeline.stages.iter_mut().find(|stage| stage.sweep.is_some()).expect("the swept stage");
    stage.sweep.as_mut().expect("a sweep").metric = "fdi".into();
    let submit = Event::Submit {
        submission: None,
        pipeline: Box::new(pipeline),
        source: String::new(),
        idempotency_key: None,
        until: None,
        owner: protocol::Owner::local("me"),
    };
    world.submissions = vec![(Millis(0), submit)];
    while !world.is_over() {
        world.step();
    }
    let view = &world.views()[0];
    let message = view.stages.iter().find(|stage| stage.name.as_str() == "pcm").and_then(|stage| stage.message.clone());
    assert_eq!(view.state, RunState::Failed);
    assert!(
        message.as_deref().is_some_and(|m| m.contains("`fdi`") && m.contains("it reports latent_fid")),
        "{message:?}"
    );
}

/// The coordinator's cost per trial of a sweep of `trials`: decisions, facts, bytes of facts, and objects inspected by
/// decisions. Counts do not depend on the machine, unlike times.
fn cost(trials: u64) -> [u64; 4] {
    let mut world = sized(4, 9, trials);
    while !world.is_over() {
        world.step();
    }
    let state = world.state();
    let bytes: usize = world.store.recovery.facts.iter().map(|(_, text)| text.len()).sum();
    let cost = [state.seq, state.recorded, bytes as u64, state.visits].map(|all| all / trials);
    eprintln!("{trials} trials: {cost:?} decisions, facts, bytes of facts and looks for each");
    cost
}

#[test]
fn bookkeeping_takes_little_for_each_trial_however_many_there_are() {
    let most = [14, 70, 22_000, 80];
    let (few, many) = (cost(25), cost(100));
    for ((few, many), most) in few.into_iter().zip(many).zip(most) {
        assert!(many <= most, "{many} for each trial, {most} are expected at most");
        assert!(many * 4 <= few * 5, "{many} for each of a hundred trials, {few} for each of 25");
    }
}
