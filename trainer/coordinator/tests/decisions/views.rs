//! Views of runs and stages: points of interruption, missing workers, and the progress of finished stages.

use coordinator::{Control, Event, Observation, Policy};
use protocol::message::{
    CommitCheckpoint, Doing, Poll, Progress, ReportOutcome, RunState, StageState, StageView, TaskOutcome,
};
use protocol::stage::WorkerRange;
use protocol::{Digest, Incarnation, RunId};

use crate::common::{PureCoordinator, gang_of_three};

fn stage(coordinator: &PureCoordinator, run: &RunId, name: &str) -> StageView {
    let view = coordinator.view(run);
    view.stages.into_iter().find(|stage| stage.name.as_str() == name).expect("the stage")
}

/// A gang in training that has reported 253 of 300 steps.
fn training() -> (PureCoordinator, RunId) {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, [a, ..]) = gang_of_three(&mut coordinator);
    reports(&mut coordinator, a, 253);
    (coordinator, run)
}

fn reports(coordinator: &mut PureCoordinator, incarnation: Incarnation, done: u64) {
    let grant = coordinator.assignment("a").expect("it trains").grant;
    let progress = Progress { done, total: 300, unit: "steps".to_owned(), ..Progress::default() };
    let doing = vec![Doing::new(grant, progress)];
    let poll = Poll { incarnation, doing, ready: Vec::new(), version: 0, leaving: false };
    coordinator.hear(Observation::Poll { worker: "a".into(), poll });
}

fn saves(coordinator: &mut PureCoordinator, step: u64) {
    let grant = coordinator.assignment("a").expect("it trains").grant;
    let commit = CommitCheckpoint { grant, step, manifest: Digest::of(b"saved"), metrics: Default::default() };
    coordinator.happen(Event::Checkpoint { commit }).expect("saved");
}

fn stops(coordinator: &mut PureCoordinator) {
    coordinator.restart(true);
    coordinator.happen(Event::Started { alone: true, park: true }).expect("starts");
}

#[test]
fn a_finished_stage_is_whole_however_old_its_last_report_is() {
    let (mut coordinator, run) = training();
    assert_eq!(stage(&coordinator, &run, "vae").progress.done, 253);
    let assignment = coordinator.assignment("a").expect("it trains");
    let metrics = [("loss".to_owned(), 0.25)].into();
    coordinator.report(&assignment, TaskOutcome::Finished { output: Digest::of(b"vae"), metrics });
    let vae = stage(&coordinator, &run, "vae");
    assert_eq!((vae.state, vae.progress.done, vae.progress.total), (StageState::Ran, 300, 300));
    assert_eq!(vae.metrics["loss"], 0.25);
}

#[test]
fn the_highest_memory_of_a_stage_is_shown_while_it_runs_and_afterwards() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, incarnations) = gang_of_three(&mut coordinator);
    assert_eq!(stage(&coordinator, &run, "vae").peak_memory, None);
    for (name, incarnation, peak) in
        [("a", incarnations[0], 300), ("b", incarnations[1], 500), ("a", incarnations[0], 200)]
    {
        let grant = coordinator.assignment(name).expect("it trains").grant;
        let doing = Doing { peak_memory: Some(peak), ..Doing::new(grant, Progress::default()) };
        let poll = Poll { incarnation, doing: vec![doing], ready: Vec::new(), version: 0, leaving: false };
        coordinator.hear(Observation::Poll { worker: name.into(), poll });
    }
    assert_eq!(stage(&coordinator, &run, "vae").peak_memory, Some(500));
    let grant = coordinator.assignment("a").expect("it trains").grant;
    let outcome = TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() };
    let report = ReportOutcome { peak_memory: Some(400), ..ReportOutcome::new(grant, outcome) };
    coordinator.happen(Event::Outcome { report }).expect("taken");
    assert_eq!(stage(&coordinator, &run, "vae").peak_memory, Some(500));
    coordinator.restart(true);
    assert_eq!(stage(&coordinator, &run, "vae").peak_memory, Some(500), "it is in the facts");
}

#[test]
fn a_stage_that_ended_before_its_first_report_has_the_steps_of_its_settings() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, _) = gang_of_three(&mut coordinator);
    let assignment = coordinator.assignment("a").expect("it trains");
    let steps = assignment.stage.settings.steps().expect("it trains").0;
    coordinator.report(&assignment, TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() });
    let progress = stage(&coordinator, &run, "vae").progress;
    assert_eq!((progress.done, progress.total, &*progress.unit), (steps, steps, "steps"));
}

#[test]
fn an_interrupted_run_says_where_it_stopped() {
    let (mut coordinator, run) = training();
    saves(&mut coordinator, 240);
    let total = stage(&coordinator, &run, "vae").progress.total;
    assert_eq!(total, 300);
    coordinator.happen(Event::Drain).expect("drains");
    let assignment = coordinator.assignment("a").expect("it saves");
    coordinator.report(&assignment, TaskOutcome::Yielded { at: 240 });
    let vae = stage(&coordinator, &run, "vae");
    assert_eq!((vae.state, vae.wants_workers), (StageState::Ready, None), "nobody is looked for");
    let steps = assignment.stage.settings.steps().expect("it trains").0;
    assert_eq!(vae.message, Some(format!("interrupted at 240 of {} steps", protocol::units::grouped(steps))));
    assert_eq!(vae.progress.done, 240, "not the 253 of the last report");

    stops(&mut coordinator);
    let view = coordinator.view(&run);
    assert!(view.state == RunState::Paused && view.interrupted);
    let stopped = stage(&coordinator, &run, "vae");
    assert_eq!(stopped.message, vae.message);
    assert_eq!(
        (stopped.progress.done, stopped.progress.total),
        (240, steps),
        "what is saved is known without a worker"
    );
    let next = stage(&coordinator, &run, "latents");
    assert!(!next.is_asked_for(), "{next:?}");
}

#[test]
fn resumed_work_is_shown_at_its_checkpoint_until_its_worker_reports() {
    let (mut coordinator, run) = training();
    saves(&mut coordinator, 240);
    let assignment = coordinator.assignment("a").expect("it trains");
    let poll =
        |doing| Poll { incarnation: assignment.grant.incarnation, doing, ready: vec![], version: 0, leaving: false };
    // A worker that has just begun knows neither the steps done nor their number.
    let begins = poll(vec![Doing::new(assignment.grant.clone(), Progress::default())]);
    coordinator.hear(Observation::Poll { worker: "a".into(), poll: begins });
    let progress = stage(&coordinator, &run, "vae").progress;
    let steps = assignment.stage.settings.steps().expect("it trains").0;
    assert_eq!((progress.done, progress.total, &*progress.unit), (240, steps, "steps"));
    reports(&mut coordinator, assignment.grant.incarnation, 241);
    assert_eq!(stage(&coordinator, &run, "vae").progress.done, 241);
}

#[test]
fn a_pipeline_that_was_interrupted_goes_on_as_the_same_run() {
    let (mut coordinator, run) = training();
    saves(&mut coordinator, 240);
    stops(&mut coordinator);
    let again = coordinator.submit("vae", WorkerRange { min: 1, max: 3 });
    assert_eq!(again, run);
    let view = coordinator.view(&run);
    assert!(view.state == RunState::Running && !view.interrupted);
    assert_eq!(stage(&coordinator, &run, "vae").wants_workers, Some(1));

    let other = coordinator.submit("dataset", WorkerRange { min: 1, max: 3 });
    assert_ne!(other, run, "another part of the pipeline is another run");
}

#[test]
fn a_run_that_a_user_paused_stays_paused() {
    let (mut coordinator, run) = training();
    coordinator.control(&run, Control::Pause).expect("paused");
    stops(&mut coordinator);
    let view = coordinator.view(&run);
    assert!(view.state == RunState::Paused && !view.interrupted);
    let again = coordinator.submit("vae", WorkerRange { min: 1, max: 3 });
    assert_ne!(again, run);
    assert_eq!(coordinator.run_state(&run), RunState::Paused);
}

/// Runs share what has one key. Pausing a run pauses no run of another owner with the same stage.
#[test]
fn a_paused_run_shows_that_another_run_computes_its_stage() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let [paused, other] = [0, 1].map(|_| coordinator.submit("dataset", WorkerRange::default()));
    coordinator.control(&paused, Control::Pause).expect("paused");
    coordinator.join("a");
    let shown = |run: &RunId| (coordinator.run_state(run), stage(&coordinator, run, "dataset").state);
    assert_eq!(shown(&paused), (RunState::Paused, StageState::Running));
    assert_eq!(shown(&other), (RunState::Running, StageState::Running));
}
