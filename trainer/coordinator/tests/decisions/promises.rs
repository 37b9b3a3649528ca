//! Numbered promises of `docs`, for the pure half with a virtual clock: leases, budgets, and ends of runs.
//!
//! Unlike process tests, which can only measure, these tests are exact: they try every moment without waiting.

use coordinator::state::task::{Lease, Part};
use coordinator::{Control, Event, Millis, Observation, Policy, Rejected, observe};
use protocol::message::{
    CommitCheckpoint, Doing, FailureClass, Grant, LossCause, LostPeer, Poll, Progress, ReportOutcome, RunState,
    StageState, TaskOutcome,
};
use protocol::stage::WorkerRange;
use protocol::{Digest, RunId, WorkerId};

use crate::common::{PureCoordinator, failed, gang_of_three};

/// Sampled: a worker dies at 40 moments between two ticks, 25 ms apart.
#[test]
fn p3_the_task_of_a_dead_worker_is_another_s_within_16_seconds() {
    let policy = Policy::default();
    assert_eq!((policy.lease_ms, policy.tick_ms), (15_000, 1_000), "what is promised is 15 s and 1 s");
    for offset in (0..policy.tick_ms).step_by(25) {
        let mut coordinator = PureCoordinator::new(Policy::default());
        coordinator.submit("dataset", WorkerRange::default());
        let a = coordinator.join("a");
        let lost = coordinator.assignment("a").expect("the only worker gets it").grant;
        let b = coordinator.join("b");
        // Ticks are a second apart, independent of the last poll of `a`.
        let first = coordinator.now;
        coordinator.now += offset;
        coordinator.poll("a", a);
        let heard = coordinator.now;
        let mut tick = first;
        let taken = loop {
            tick += policy.tick_ms;
            coordinator.now = tick;
            coordinator.poll("b", b);
            coordinator.tick();
            if let Some(taken) = coordinator.assignment("b") {
                break taken.grant;
            }
            assert!(tick < heard + 60_000, "never taken");
        };
        let after = coordinator.now - heard;
        // A first back-off of half a second may follow the loss.
        let bound = policy.lease_ms + policy.tick_ms;
        assert!(after > policy.lease_ms, "a lease of {} ms ended after {after} ms", policy.lease_ms);
        let backoff = policy.backoff(1).next_multiple_of(policy.tick_ms);
        assert!(after <= bound + backoff, "offset {offset}: taken after {after} ms");
        assert!(taken.fence > lost.fence && taken.attempt > lost.attempt);
        let refused = ReportOutcome::new(lost, failed(FailureClass::Fault));
        let refused = coordinator.happen(Event::Outcome { report: refused });
        assert!(matches!(refused, Err(Rejected::StaleFence { .. })), "{refused:?}");
    }
}

#[test]
fn only_the_first_member_of_a_gang_commits() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    gang_of_three(&mut coordinator);
    let [first, second] = ["a", "b"].map(|name| coordinator.assignment(name).expect("it trains").grant);
    let commit = |grant: &Grant| {
        let (grant, manifest) = (grant.clone(), Digest::of(b"step 1"));
        Event::Checkpoint { commit: CommitCheckpoint { grant, step: 1, manifest, metrics: Default::default() } }
    };
    let refused = coordinator.happen(commit(&second));
    assert!(matches!(refused, Err(Rejected::Conflict(_))), "{refused:?}");
    coordinator.happen(commit(&first)).expect("saved");
}

/// A member that led the gang may learn only from its report that another one leads now.
#[test]
fn a_report_of_the_end_counts_whoever_leads_the_gang_meanwhile() {
    for (name, is_alone) in [("a", true), ("b", false)] {
        let mut coordinator = PureCoordinator::new(Policy::default());
        let (run, _) = gang_of_three(&mut coordinator);
        let grant = coordinator.assignment(name).expect("it trains").grant;
        let report = |outcome| Event::Outcome { report: ReportOutcome::new(grant.clone(), outcome) };
        let attempt = grant.attempt;
        coordinator.happen(report(TaskOutcome::Yielded { at: 1 })).expect("heard");
        let (_, task) = coordinator.state.task(&grant.task).expect("known");
        assert_eq!(task.attempt == attempt && !task.holders().is_empty(), !is_alone, "{name}: {task:?}");

        let mut coordinator = PureCoordinator::new(Policy::default());
        let (again, _) = gang_of_three(&mut coordinator);
        assert_eq!(again, run);
        let grant = coordinator.assignment(name).expect("it trains").grant;
        let outcome = TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() };
        coordinator.happen(Event::Outcome { report: ReportOutcome::new(grant, outcome) }).expect("done");
        assert_eq!(coordinator.run_state(&run), RunState::Finished, "{name}");
    }
}

/// Sampled: one gang of three. Its first member is silent beyond its lease and then polls with its old grant, with
/// progress and complaints. The test then repeats the complaint as an event from before the member was removed.
#[test]
fn p2_what_a_member_says_that_was_left_behind_is_not_believed() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, [a, b, c]) = gang_of_three(&mut coordinator);
    let old = coordinator.assignment("a").expect("it trains").grant;
    let gang = |coordinator: &PureCoordinator| {
        let (_, task) = coordinator.state.task(&old.task).expect("known");
        task.holders().iter().map(|member| member.worker.clone()).collect::<Vec<_>>()
    };
    assert_eq!(gang(&coordinator), ["a", "b", "c"].map(WorkerId::from));
    for _ in 0..16 {
        coordinator.now += 1000;
        coordinator.poll("b", b);
        coordinator.poll("c", c);
        coordinator.tick();
    }
    assert_eq!(gang(&coordinator), ["b", "c"].map(WorkerId::from));

    let lost = |name: &str| LostPeer { worker: name.into(), cause: LossCause::Unreachable };
    let progress = Progress { done: 999, total: 1000, ..Progress::default() };
    let doing = Doing { holds: Some(999), lost: ["b", "c"].map(lost).into(), ..Doing::new(old.clone(), progress) };
    let doing = vec![doing];
    let poll = Poll { incarnation: a, doing, ready: Vec::new(), version: 0, leaving: false };
    let heard =
        observe(&mut coordinator.state, Millis(coordinator.now), Observation::Poll { worker: "a".into(), poll });
    let heard = heard.expect("it is known");
    assert!(matches!(&heard[..], [Event::WorkerBack { worker }] if worker.as_str() == "a"), "{heard:?}");
    let view = coordinator.view(&run);
    let told: Vec<u64> = view.stages.iter().map(|stage| stage.progress.done).collect();
    assert!(!told.contains(&999), "{told:?}");

    let event = Event::GangDivided { task: old.task.clone(), fence: old.fence };
    assert_eq!(coordinator.happen(event), Ok(Vec::new()), "the generation is over");
    assert_eq!(gang(&coordinator), ["b", "c"].map(WorkerId::from));
}

/// A stopped process leaves a gap of 8 s between two ticks. A worker heard during the gap gets one lease from then on,
/// without an extra 8 s.
#[test]
fn p3_a_late_clock_gives_nobody_more_than_a_lease_from_now() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.submit("dataset", WorkerRange::default());
    let a = coordinator.join("a");
    coordinator.tick();
    coordinator.now += 8000;
    coordinator.poll("a", a);
    coordinator.hear(Observation::Tick { overslept: 7000 });
    let heard = coordinator.now;
    while coordinator.is_held() {
        coordinator.now += 1000;
        coordinator.tick();
        assert!(coordinator.now - heard <= 16_000, "still held {} ms after it was last heard", coordinator.now - heard);
    }
    assert!(coordinator.now - heard > 15_000, "its lease was cut short");
}

/// A restart after a simulated hour, with workers that poll at once, late within the lease, or never.
#[test]
fn p3_after_an_hour_without_a_coordinator_leases_get_one_interval_of_grace() {
    for back_after in [0, 14_000] {
        let mut coordinator = PureCoordinator::new(Policy::default());
        coordinator.submit("dataset", WorkerRange::default());
        let a = coordinator.join("a");
        let held = coordinator.assignment("a").expect("held").grant;
        coordinator.now += 3_600_000;
        coordinator.restart(false);
        for _ in 0..back_after / 1000 {
            coordinator.tick();
            coordinator.now += 1000;
        }
        coordinator.poll("a", a);
        coordinator.tick();
        assert_eq!(coordinator.assignment("a").expect("still its own").grant, held, "back after {back_after} ms");
        // After that the worker is silent and loses its task.
        for _ in 0..17 {
            coordinator.now += 1000;
            coordinator.tick();
        }
        assert!(!coordinator.is_held(), "an orphan");
    }
}

/// All pairs of budgets from 0 to 3, with a restart of the coordinator between any two attempts, and both kinds of
/// failure mixed.
#[test]
fn p15_each_budget_allows_exactly_one_try_more_than_it_says() {
    for (faults, losses) in (0..4u32).flat_map(|f| (0..4u32).map(move |l| (f, l))) {
        for class in [FailureClass::Fault, FailureClass::Infrastructure] {
            let policy = Policy { fault_budget: faults, infrastructure_budget: losses, ..Policy::default() };
            let (own, other) = match class {
                FailureClass::Fault => (faults, losses),
                _ => (losses, faults),
            };
            let mut coordinator = PureCoordinator::new(policy.clone());
            let run = coordinator.submit("dataset", WorkerRange::default());
            let mut others = 0;
            let mut attempts = 0;
            let mut streak = 0;
            let a = coordinator.join("a");
            loop {
                let assignment = coordinator.assignment("a").expect("granted once the back-off is over");
                attempts += 1;
                // The other budget is also used up, exactly to its end.
                let class = if others < other && attempts % 2 == 0 {
                    others += 1;
                    if class == FailureClass::Fault { FailureClass::Infrastructure } else { FailureClass::Fault }
                } else {
                    class
                };
                coordinator.report(&assignment, failed(class));
                streak += 1;
                coordinator.restart(false);
                if coordinator.run_state(&run) == RunState::Failed {
                    break;
                }
                let backoff = policy.backoff(streak);
                assert!(backoff <= policy.backoff_max_ms);
                coordinator.now += backoff - 1;
                coordinator.poll("a", a);
                coordinator.tick();
                assert!(coordinator.assignment("a").is_none(), "granted before {backoff} ms were over");
                coordinator.now += 1;
                coordinator.tick();
                assert!(attempts < 50, "never given up");
            }
            assert_eq!(attempts - others, own + 1, "budgets {faults} and {losses}, failing by {class:?}");
            let view = coordinator.view(&run);
            let message = view.stages[0].message.clone().unwrap_or_default();
            assert!(message.contains("gave up after") && message.contains("made up"), "{message}");
        }
    }
}

/// Every class of final failure, after none and after two failures that can be retried.
#[test]
fn p15_a_final_failure_is_not_tried_again() {
    for class in [FailureClass::Input, FailureClass::Diverged, FailureClass::OutOfMemory, FailureClass::Storage] {
        for before in [0, 2] {
            let mut coordinator = PureCoordinator::new(Policy::default());
            let run = coordinator.submit("dataset", WorkerRange::default());
            let a = coordinator.join("a");
            for _ in 0..before {
                let assignment = coordinator.assignment("a").expect("granted");
                coordinator.report(&assignment, failed(FailureClass::Fault));
                coordinator.now += coordinator.state.policy.backoff_max_ms;
                coordinator.poll("a", a);
                coordinator.tick();
            }
            let assignment = coordinator.assignment("a").expect("granted");
            coordinator.report(&assignment, failed(class));
            assert_eq!(coordinator.run_state(&run), RunState::Failed, "{class:?}");
            let view = coordinator.view(&run);
            assert_eq!(view.stages[0].state, StageState::Failed);
            assert_eq!(view.stages[0].attempt.0, before + 1);
            assert!(coordinator.assignment("a").is_none());
            // A resumed run starts again.
            coordinator.control(&run, Control::Resume).expect("taken up");
            assert!(coordinator.assignment("a").is_some());
        }
    }
}

/// Brings a run into one of its states by regular events.
fn in_state(state: RunState, held: bool) -> (PureCoordinator, RunId) {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let run = coordinator.submit("dataset", WorkerRange::default());
    let control = |coordinator: &mut PureCoordinator, action| coordinator.control(&run, action).expect("taken");
    if held || matches!(state, RunState::Finished | RunState::Failed) {
        coordinator.join("a");
    }
    match state {
        RunState::Running => {}
        RunState::Paused => drop(control(&mut coordinator, Control::Pause)),
        RunState::Cancelled => drop(control(&mut coordinator, Control::Cancel)),
        RunState::Failed => {
            let assignment = coordinator.assignment("a").expect("granted");
            coordinator.report(&assignment, failed(FailureClass::Input));
        }
        RunState::Finished => {
            let assignment = coordinator.assignment("a").expect("granted");
            let output = Digest::of(b"clips");
            coordinator.report(&assignment, TaskOutcome::Finished { output, metrics: Default::default() });
        }
    }
    assert_eq!(coordinator.run_state(&run), state);
    (coordinator, run)
}

/// The whole table: each state, idle and with a worker that never answers, with each action. The coordinator is killed
/// before the event is stored, after it, or not at all. A worker that ignores all requests loses its task, and the
/// right to write, after the grace period.
#[test]
fn p14_pause_resume_and_cancel_end_where_the_table_says_whoever_is_killed() {
    use RunState::{Cancelled, Failed, Finished, Paused, Running};
    let table = [
        (Running, [Some(Paused), Some(Running), Some(Cancelled)]),
        (Paused, [Some(Paused), Some(Running), Some(Cancelled)]),
        (Finished, [None, None, None]),
        (Failed, [None, Some(Running), None]),
        (Cancelled, [None, Some(Running), Some(Cancelled)]),
    ];
    for (state, row) in table {
        for (action, expected) in [Control::Pause, Control::Resume, Control::Cancel].into_iter().zip(row) {
            for held in [false, true] {
                for killed in ["never", "before", "after"] {
                    let case = format!("{state:?}, held: {held}, {action:?}, killed {killed}");
                    let (mut coordinator, run) = in_state(state, held);
                    if killed == "before" {
                        // The request was not answered, so the client repeats it.
                        coordinator.restart(false);
                    }
                    let asked = coordinator.control(&run, action);
                    assert_eq!(asked.is_ok(), expected.is_some(), "{case}: {asked:?}");
                    if killed == "after" {
                        coordinator.restart(false);
                    }
                    let expected = expected.unwrap_or(state);
                    assert_eq!(coordinator.run_state(&run), expected, "{case}");
                    let begun = coordinator.now;
                    let worker = coordinator.state.workers.contains_key(&"a".into());
                    while coordinator.is_held() && expected != Running {
                        coordinator.now += 1000;
                        if worker {
                            // The worker polls but ignores the request.
                            coordinator.poll("a", coordinator.state.workers[&"a".into()].incarnation);
                        }
                        coordinator.tick();
                        let limit = coordinator.state.policy.grace_ms + 5000;
                        assert!(coordinator.now - begun <= limit, "{case}: still held after {limit} ms");
                    }
                    assert_eq!(coordinator.run_state(&run), expected, "{case}");
                }
            }
        }
    }
}

/// Drains with a worker that does not react; the next start grants the work again.
#[test]
fn p14_a_drain_ends_though_a_worker_ignores_it() {
    let (mut coordinator, run) = in_state(RunState::Running, true);
    let a = coordinator.state.workers[&"a".into()].incarnation;
    coordinator.happen(Event::Drain).expect("taken");
    assert!(coordinator.assignment("a").is_some_and(|assignment| assignment.drain));
    for _ in 0..(coordinator.state.policy.grace_ms / 1000 + 1) {
        coordinator.now += 1000;
        coordinator.poll("a", a);
        coordinator.tick();
    }
    let waits = |coordinator: &PureCoordinator| {
        let mut tasks = coordinator.state.executions.values().flat_map(|execution| &execution.tasks);
        tasks.all(|task| matches!(task.lease, Lease::Waiting { .. }))
    };
    assert!(waits(&coordinator), "released by force");
    assert_eq!(coordinator.run_state(&run), RunState::Running, "the run itself was not asked to stop");
    assert!(coordinator.state.desired(&"a".into(), a).expect("known").leave);
    coordinator.restart(false);
    coordinator.poll("a", a);
    assert!(coordinator.assignment("a").is_some(), "a new start gives it out again");
}

fn members(coordinator: &PureCoordinator) -> Vec<String> {
    let tasks = coordinator.state.executions.values().flat_map(|execution| execution.tasks.iter());
    let gang = tasks.filter(|task| task.part == Part::Gang).flat_map(|task| task.holders());
    gang.map(|member| member.worker.to_string()).collect()
}

/// Sampled: of three workers, one has the inputs when the stage starts, one gets them later, and one never does.
#[test]
fn p4_a_gang_waits_for_nobody_who_fetches_its_inputs() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.quick = false;
    coordinator.submit("vae", WorkerRange { min: 1, max: 3 });
    coordinator.join("a");
    let dataset = coordinator.assignment("a").expect("the only worker gets it");
    coordinator.report(&dataset, TaskOutcome::Finished { output: Digest::of(b"clips"), metrics: Default::default() });
    for name in ["b", "c"] {
        coordinator.join(name);
    }
    assert_eq!(members(&coordinator), [""; 0], "nobody has its inputs");
    for name in ["a", "b", "c"] {
        let asked = coordinator.asked(name);
        assert_eq!(asked.len(), 1, "{name}: {asked:?}");
        assert!(asked[0].inputs.values().eq([&Digest::of(b"clips")]) && asked[0].resume.is_none(), "{asked:?}");
    }
    coordinator.prepare("b");
    assert_eq!(members(&coordinator), ["b"], "it starts with who is ready");
    assert_eq!(coordinator.asked("b"), []);
    let held = coordinator.assignment("b").expect("it trains");
    coordinator.poll("c", coordinator.state.workers[&WorkerId::from("c")].incarnation);
    coordinator.tick();
    assert_eq!(coordinator.assignment("b").as_ref(), Some(&held), "and nobody disturbs it");
    let commit = CommitCheckpoint {
        grant: held.grant.clone(),
        step: 4,
        manifest: Digest::of(b"state"),
        metrics: Default::default(),
    };
    coordinator.happen(Event::Checkpoint { commit }).expect("saved");
    assert_eq!(coordinator.asked("a")[0].resume, None, "a joiner is handed the state");
    coordinator.prepare("a");
    assert_eq!(members(&coordinator), ["b", "a"]);
    assert_eq!(coordinator.assignment("b").expect("it trains").grant.attempt, held.grant.attempt);
    // Without a member to hand over the state, a new worker needs the checkpoint too.
    for name in ["a", "b"] {
        coordinator.happen(Event::WorkerGone { worker: name.into(), incarnation: None }).expect("gone");
    }
    assert_eq!(coordinator.asked("c")[0].resume, Some(Digest::of(b"state")));
}

/// Sampled: workers that joined a coordinator of another build, and new ones.
#[test]
fn p1_members_of_a_gang_share_their_code() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.submit("vae", WorkerRange { min: 1, max: 4 });
    let older = |name: &str| {
        let mut join = PureCoordinator::offer(name);
        join.code_versions.insert("train.vae".into(), 1);
        join
    };
    coordinator.join_as(older("a"));
    let dataset = coordinator.assignment("a").expect("the only worker gets it");
    coordinator.report(&dataset, TaskOutcome::Finished { output: Digest::of(b"clips"), metrics: Default::default() });
    coordinator.join("b");
    coordinator.join_as(older("c"));
    assert_eq!(members(&coordinator), ["a", "c"], "it is not taken in");
    for name in ["a", "c"] {
        coordinator.happen(Event::WorkerGone { worker: name.into(), incarnation: None }).expect("gone");
    }
    for _ in 0..5 {
        coordinator.now += 1_000;
        coordinator.tick();
    }
    assert_eq!(members(&coordinator), ["b"]);
    coordinator.join("d");
    assert_eq!(members(&coordinator), ["b", "d"]);
}

/// Sampled: two workers of one instruction set and one of another, before and after a checkpoint.
#[test]
fn p1_all_that_work_on_a_stage_share_an_instruction_set() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let run = coordinator.submit("vae", WorkerRange { min: 1, max: 3 });
    let vae = |coordinator: &PureCoordinator| {
        coordinator.view(&run).stages.into_iter().find(|stage| stage.name.as_str() == "vae").expect("a stage")
    };
    coordinator.join_with("a", "avx2");
    let dataset = coordinator.assignment("a").expect("the only worker gets it");
    coordinator.report(&dataset, TaskOutcome::Finished { output: Digest::of(b"clips"), metrics: Default::default() });
    coordinator.join_with("b", "avx512");
    coordinator.join_with("c", "avx2");
    assert_eq!(members(&coordinator), ["a", "c"]);
    assert_eq!(coordinator.asked("b"), [], "it could not be taken in");
    assert_eq!(vae(&coordinator).instruction_set.as_deref(), Some("avx2"));
    let over = |coordinator: &mut PureCoordinator, names: &[&str]| {
        for name in names {
            coordinator.happen(Event::WorkerGone { worker: (*name).into(), incarnation: None }).expect("gone");
        }
        for _ in 0..5 {
            coordinator.now += 1_000;
            coordinator.tick();
        }
    };
    over(&mut coordinator, &["a", "c"]);
    assert_eq!(members(&coordinator), ["b"], "nothing was saved that would bind it");
    assert_eq!(vae(&coordinator).instruction_set.as_deref(), Some("avx512"));
    let grant = coordinator.assignment("b").expect("it trains").grant;
    let commit = CommitCheckpoint { grant, step: 4, manifest: Digest::of(b"state"), metrics: Default::default() };
    coordinator.happen(Event::Checkpoint { commit }).expect("saved");
    over(&mut coordinator, &["b"]);
    coordinator.join_with("a", "avx2");
    assert_eq!(members(&coordinator), [""; 0], "its bits would be others");
    let message = vae(&coordinator).message.unwrap_or_default();
    assert!(message.contains("avx512"), "{message}");
    coordinator.join_with("b", "avx512");
    assert_eq!(members(&coordinator), ["b"]);
}
