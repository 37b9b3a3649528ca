//! Priorities order the runs of a group. Work of a higher one gets the workers of a lower one, and a training that makes
//! way continues from its last step.

use coordinator::state::task::Lease;
use coordinator::{Control, Effect, Event, Observation, Policy};
use protocol::message::{CommitCheckpoint, Doing, Poll, Progress, Role, TaskOutcome};
use protocol::stage::WorkerRange;
use protocol::{Digest, Owner, RunId};

use crate::common::{PureCoordinator, pipelines};

/// A run up to its training `vae`.
pub(super) fn submit(
    coordinator: &mut PureCoordinator,
    owner: &str,
    seed: u64,
    priority: i32,
    workers: WorkerRange,
) -> RunId {
    let mut pipeline = pipelines::quickstart(seed, workers, &[]);
    pipeline.priority = priority;
    for stage in &mut pipeline.stages {
        if let Some(training) = stage.settings.training_mut() {
            training.batch.slices = 8;
        }
    }
    let event = Event::Submit {
        submission: None,
        owner: Owner::local(owner),
        pipeline: Box::new(pipeline),
        source: String::new(),
        idempotency_key: None,
        until: Some("vae".into()),
    };
    let effects = coordinator.happen(event).expect("submitted");
    let run = effects.into_iter().find_map(|effect| match effect {
        Effect::Submitted(run) => Some(run),
        _ => None,
    });
    run.expect("a run")
}

pub(super) const ALONE: WorkerRange = WorkerRange { min: 1, max: 1 };
pub(super) const MANY: WorkerRange = WorkerRange { min: 1, max: 8 };

/// The task that a worker holds; empty without one.
pub(super) fn task(coordinator: &PureCoordinator, worker: &str) -> String {
    coordinator.assignment(worker).map(|held| held.grant.task.to_string()).unwrap_or_default()
}

fn training(run: &RunId) -> String {
    format!("{run}/vae")
}

/// Ends the task that a worker holds alone, such as a data set.
pub(super) fn finish_small(coordinator: &mut PureCoordinator, worker: &str) {
    let held = coordinator.assignment(worker).expect("a task");
    assert_eq!(held.role, Role::Alone, "{}", held.grant.task);
    let output = Digest::of(held.grant.task.as_str().as_bytes());
    coordinator.report(&held, TaskOutcome::Finished { output, metrics: Default::default() });
}

/// The lead of a preempted gang saves at `step` and yields.
fn yields(coordinator: &mut PureCoordinator, worker: &str, step: u64) {
    let held = coordinator.assignment(worker).expect("a task");
    assert!(held.drain, "{} is asked to make way", held.grant.task);
    save(coordinator, worker, step);
    coordinator.report(&held, TaskOutcome::Yielded { at: step });
}

fn save(coordinator: &mut PureCoordinator, worker: &str, step: u64) {
    let grant = coordinator.assignment(worker).expect("a task").grant;
    let manifest = Digest::of(format!("{} {step}", grant.task).as_bytes());
    let commit = CommitCheckpoint { grant, step, manifest, metrics: Default::default() };
    coordinator.happen(Event::Checkpoint { commit }).expect("saved");
}

/// All workers poll as holders of their tasks' state, and a second passes.
pub(super) fn beat(coordinator: &mut PureCoordinator) {
    let names: Vec<_> = coordinator.state.workers.keys().cloned().collect();
    for name in names {
        let worker = &coordinator.state.workers[&name];
        let incarnation = worker.incarnation;
        let ready = worker.ready.iter().cloned().collect();
        let doing = coordinator.assignment(name.as_str());
        let doing = doing.map(|held| Doing { holds: Some(7), ..Doing::new(held.grant, Progress::default()) });
        let poll = Poll { incarnation, doing: doing.into_iter().collect(), ready, version: 0, leaving: false };
        coordinator.hear(Observation::Poll { worker: name, poll });
    }
    coordinator.now += 1_000;
    coordinator.tick();
}

/// A coordinator whose only worker trains for a run without a priority.
fn one_worker_trains() -> (PureCoordinator, RunId) {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let low = submit(&mut coordinator, "me", 1, 0, ALONE);
    coordinator.join("a");
    finish_small(&mut coordinator, "a");
    assert_eq!(task(&coordinator, "a"), training(&low));
    (coordinator, low)
}

#[test]
fn the_higher_priority_of_a_group_is_served_first() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let low = submit(&mut coordinator, "me", 1, 0, ALONE);
    let high = submit(&mut coordinator, "me", 2, 5, ALONE);
    let lowest = submit(&mut coordinator, "me", 3, -5, ALONE);
    coordinator.join("a");
    for run in [&high, &low, &lowest] {
        assert!(task(&coordinator, "a").starts_with(run.as_str()), "{run}: {}", task(&coordinator, "a"));
        finish_small(&mut coordinator, "a");
        assert_eq!(task(&coordinator, "a"), training(run));
        let held = coordinator.assignment("a").expect("its training");
        let output = Digest::of(run.as_str().as_bytes());
        coordinator.report(&held, TaskOutcome::Finished { output, metrics: Default::default() });
    }
    assert!(!coordinator.is_held());
}

/// A group cannot get ahead of another one by its priorities.
#[test]
fn a_priority_has_no_effect_on_other_groups() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let mine = submit(&mut coordinator, "me", 1, 0, ALONE);
    let yours = submit(&mut coordinator, "you", 2, 100, ALONE);
    coordinator.join("a");
    assert!(task(&coordinator, "a").starts_with(mine.as_str()), "the first submission of groups without workers");
    finish_small(&mut coordinator, "a");
    let first = task(&coordinator, "a");
    for _ in 0..100 {
        beat(&mut coordinator);
    }
    assert_eq!(task(&coordinator, "a"), first, "the training is not stopped for another group");
    assert!(!coordinator.assignment("a").expect("a task").drain, "{yours} waits");
}

#[test]
fn a_training_makes_way_and_continues_from_its_last_step() {
    let (mut coordinator, low) = one_worker_trains();
    let high = submit(&mut coordinator, "me", 2, 1, ALONE);
    let message = |coordinator: &PureCoordinator| coordinator.view(&high).stages[0].message.clone().unwrap_or_default();
    assert_eq!(message(&coordinator), "waits for 1 idle `flex` worker; the only one is about to save and make way");
    yields(&mut coordinator, "a", 5);
    assert!(task(&coordinator, "a").starts_with(high.as_str()), "{}", task(&coordinator, "a"));
    // The low run does not get the worker between two stages of the high one.
    finish_small(&mut coordinator, "a");
    assert_eq!(task(&coordinator, "a"), training(&high));
    let stages = coordinator.view(&low).stages;
    let waits = stages.into_iter().find(|stage| stage.wants_workers.is_some()).and_then(|stage| stage.message);
    assert_eq!(
        waits.unwrap_or_default(),
        "waits for 1 idle `flex` worker with avx2, like the earlier workers; the only one is with work of equal or higher priority"
    );
    let held = coordinator.assignment("a").expect("its training");
    coordinator.report(&held, TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() });
    let again = coordinator.assignment("a").expect("the low training");
    assert_eq!((again.grant.task.to_string(), again.grant.attempt.0), (training(&low), 2));
    let saved = Digest::of(format!("{} 5", again.grant.task).as_bytes());
    assert_eq!(again.resume, Some(saved), "no step is lost");
    assert!(!again.drain);
}

#[test]
fn equal_priorities_do_not_stop_each_other() {
    let (mut coordinator, low) = one_worker_trains();
    submit(&mut coordinator, "me", 2, 0, ALONE);
    submit(&mut coordinator, "me", 3, -1, ALONE);
    for _ in 0..200 {
        beat(&mut coordinator);
        let held = coordinator.assignment("a").expect("a task");
        assert_eq!((held.grant.task.to_string(), held.drain), (training(&low), false));
    }
}

/// A gang gives up the members that it can spare, and is not stopped for the last one.
#[test]
fn a_gang_spares_members_before_a_training_is_stopped() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let low = submit(&mut coordinator, "me", 1, 0, MANY);
    coordinator.join("a");
    finish_small(&mut coordinator, "a");
    for name in ["b", "c"] {
        coordinator.join(name);
        beat(&mut coordinator);
    }
    beat(&mut coordinator);
    assert!(["a", "b", "c"].iter().all(|name| task(&coordinator, name) == training(&low)));
    let high = submit(&mut coordinator, "me", 2, 1, MANY);
    let of_high = |coordinator: &PureCoordinator| {
        ["a", "b", "c"]
            .into_iter()
            .filter(|name| task(coordinator, name).starts_with(high.as_str()))
            .collect::<Vec<_>>()
    };
    let first = of_high(&coordinator);
    assert_eq!(first.len(), 1, "its data set begins at once");
    finish_small(&mut coordinator, first[0]);
    for _ in 0..10 {
        beat(&mut coordinator);
    }
    assert_eq!(of_high(&coordinator).len(), 2, "the low gang keeps one member");
    let execution = coordinator.state.executions.values().find(|execution| execution.run == low && execution.is_gang());
    let execution = execution.expect("the low training");
    assert_eq!(execution.attempt().0, 1, "it only regroups");
    assert!(matches!(execution.tasks[0].lease, Lease::Held { drain_by: None, .. }));
}

/// A training that has just been resumed works for a while before it makes way again.
#[test]
fn a_resumed_training_stays_for_a_while() {
    let (mut coordinator, low) = one_worker_trains();
    let high = submit(&mut coordinator, "me", 2, 1, ALONE);
    yields(&mut coordinator, "a", 5);
    coordinator.control(&high, Control::Cancel).expect("cancelled");
    let dataset = coordinator.assignment("a").expect("a task");
    coordinator.report(&dataset, TaskOutcome::Yielded { at: 0 });
    assert_eq!(task(&coordinator, "a"), training(&low));
    submit(&mut coordinator, "me", 3, 1, ALONE);
    let stay = Policy::default().stay_ms / 1_000;
    for second in 0..stay - 1 {
        assert!(!coordinator.assignment("a").expect("a task").drain, "after {second} s");
        beat(&mut coordinator);
    }
    for _ in 0..2 {
        beat(&mut coordinator);
    }
    yields(&mut coordinator, "a", 9);
}

/// A run that cannot use the freed worker does not take it a second time.
#[test]
fn a_worker_that_the_higher_priority_does_not_use_goes_back_once() {
    let (mut coordinator, low) = one_worker_trains();
    let high = submit(&mut coordinator, "me", 2, 1, ALONE);
    yields(&mut coordinator, "a", 5);
    coordinator.quick = false;
    finish_small(&mut coordinator, "a");
    assert_eq!(task(&coordinator, "a"), "", "it is kept for the training of {high}, whose inputs it never fetches");
    let mut stops = 0;
    let mut was_asked = false;
    for _ in 0..1_500 {
        beat(&mut coordinator);
        let held = coordinator.assignment("a");
        let is_asked = held.is_some_and(|held| held.drain);
        stops += usize::from(is_asked && !was_asked);
        was_asked = is_asked;
    }
    assert_eq!((task(&coordinator, "a"), stops), (training(&low), 0), "{high}");
}

/// A stage that needs more workers than its lower priorities have stops none of them.
#[test]
fn too_few_workers_are_not_freed() {
    let (mut coordinator, low) = one_worker_trains();
    let high = submit(&mut coordinator, "me", 2, 1, WorkerRange { min: 2, max: 2 });
    yields(&mut coordinator, "a", 5);
    finish_small(&mut coordinator, "a");
    for _ in 0..300 {
        beat(&mut coordinator);
    }
    let held = coordinator.assignment("a").expect("a task");
    assert_eq!((held.grant.task.to_string(), held.drain), (training(&low), false), "{high} needs two workers");
}

/// The training that makes way is not asked to continue by a later decision, and is released if it never answers.
#[test]
fn a_training_that_does_not_answer_is_released_in_the_end() {
    let (mut coordinator, low) = one_worker_trains();
    save(&mut coordinator, "a", 3);
    let high = submit(&mut coordinator, "me", 2, 1, ALONE);
    save(&mut coordinator, "a", 6);
    assert!(coordinator.assignment("a").expect("a task").drain);
    for _ in 0..Policy::default().yield_ms / 1_000 - 2 {
        beat(&mut coordinator);
        assert_eq!(task(&coordinator, "a"), training(&low));
    }
    for _ in 0..4 {
        beat(&mut coordinator);
    }
    assert!(task(&coordinator, "a").starts_with(high.as_str()), "{}", task(&coordinator, "a"));
}
