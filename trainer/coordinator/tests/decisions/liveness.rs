//! Progress despite failures, and limits of remembered data, for the pure half with a virtual clock.

use coordinator::state::execution::ExecutionState;
use coordinator::{Control, Effect, Event, Observation, Policy, State, journal, refused_for_good};
use protocol::message::{
    Assignment, CommitCheckpoint, FailureClass, ReportOutcome, Role, RunState, StageState, TaskOutcome,
};
use protocol::stage::WorkerRange;
use protocol::{Digest, Incarnation, RunId, WorkerId, limits};
use registry::WriteError;

use crate::common::{PureCoordinator, failed, gang_of_three, pipelines};

/// Returns the time until a second worker gets the only task of a silent one. The second worker `b` polls every second,
/// and `tick` runs the timer.
fn taken_after(mut tick: impl FnMut(&mut PureCoordinator, u64)) -> u64 {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.submit("dataset", WorkerRange::default());
    coordinator.join("a");
    let b = coordinator.join("b");
    let begun = coordinator.now;
    for second in 1..60 {
        coordinator.now = begun + second * 1000;
        coordinator.poll("b", b);
        tick(&mut coordinator, second);
        if coordinator.assignment("b").is_some() {
            return coordinator.now - begun;
        }
    }
    panic!("never taken");
}

/// The actor handles no tick for 6 s, three times in a row. Polls are received meanwhile, so no lease is extended.
#[test]
fn p3_a_slow_disk_stretches_no_lease() {
    let undisturbed = taken_after(|coordinator, _| coordinator.tick());
    let stalled = taken_after(|coordinator, second| {
        if second > 18 || second % 6 == 0 {
            coordinator.tick();
        }
    });
    assert!((16_000..=17_000).contains(&undisturbed), "{undisturbed}");
    assert!(stalled <= 19_000, "noticed by the first look after the lease, not {stalled} ms after the loss");
}

/// A process that overslept by 6 s received no polls then, so all leases are extended by exactly that time.
#[test]
fn p3_leniency_is_as_long_as_the_clock_overslept() {
    let taken = taken_after(|coordinator, second| match second {
        11..17 => {}
        17 => coordinator.hear(Observation::Tick { overslept: 6000 }),
        _ => coordinator.tick(),
    });
    assert!((22_000..=23_000).contains(&taken), "15 s, 6 s, a tick and a back-off, not {taken} ms");
}

#[test]
fn back_offs_are_half_a_second_doubled_up_to_half_a_minute() {
    let policy = Policy::default();
    let waits: Vec<u64> = (1..10).map(|failures| policy.backoff(failures)).collect();
    assert_eq!(waits, [500, 1000, 2000, 4000, 8000, 16_000, 30_000, 30_000, 30_000]);
}

fn save(coordinator: &mut PureCoordinator, assignment: &Assignment, step: u64, manifest: &str) {
    let (grant, manifest) = (assignment.grant.clone(), Digest::of(manifest.as_bytes()));
    let commit = CommitCheckpoint { grant, step, manifest, metrics: Default::default() };
    coordinator.happen(Event::Checkpoint { commit }).expect("taken");
}

/// A worker trains to the next checkpoint and is lost, 250 times.
#[test]
fn p15_a_task_that_makes_progress_survives_any_number_of_losses() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, _) = gang_of_three(&mut coordinator);
    for name in ["b", "c"] {
        coordinator.happen(Event::WorkerGone { worker: name.into(), incarnation: None }).expect("taken");
    }
    for step in 1..=250 {
        let assignment = coordinator.assignment("a").expect("it trains");
        save(&mut coordinator, &assignment, step, &format!("step {step}"));
        coordinator.happen(Event::WorkerGone { worker: "a".into(), incarnation: None }).expect("taken");
        assert_eq!(coordinator.run_state(&run), RunState::Running, "after loss {step}");
        coordinator.now += 40_000;
        coordinator.join("a");
        coordinator.tick();
    }
    // Without progress the budget applies.
    let budget = Policy::default().infrastructure_budget;
    for loss in 1..=budget {
        assert_eq!(coordinator.run_state(&run), RunState::Running, "after {loss} losses in a row");
        coordinator.happen(Event::WorkerGone { worker: "a".into(), incarnation: None }).expect("taken");
        coordinator.now += 40_000;
        coordinator.join("a");
        coordinator.tick();
    }
    assert_eq!(coordinator.run_state(&run), RunState::Failed);
}

/// The first worker by name dies of every attempt and is back before the next one.
#[test]
fn a_task_that_failed_goes_to_a_worker_on_which_it_failed_less_often() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let run = coordinator.submit("dataset", WorkerRange { min: 1, max: 1 });
    for name in ["a", "b", "c"] {
        coordinator.join(name);
    }
    let mut holders = Vec::new();
    for _ in 0..5 {
        let holder = ["a", "b", "c"].into_iter().find(|name| coordinator.assignment(name).is_some());
        let holder = holder.expect("a worker has the task");
        holders.push(holder);
        if holder == "c" {
            break;
        }
        coordinator.happen(Event::WorkerGone { worker: holder.into(), incarnation: None }).expect("taken");
        coordinator.join(holder);
        coordinator.now += 2_000;
        coordinator.tick();
    }
    assert_eq!(holders, ["a", "b", "c"]);
    assert_eq!(coordinator.run_state(&run), RunState::Running);
}

/// No attempt resumes a stage whose value is stored, so its checkpoints go with the report of the value.
#[test]
fn an_ended_stage_keeps_no_training_state() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, _) = gang_of_three(&mut coordinator);
    let assignment = coordinator.assignment("a").expect("it trains");
    for step in 1..=3 {
        save(&mut coordinator, &assignment, step, &format!("step {step}"));
    }
    let grant = assignment.grant.clone();
    let (task, outcome) =
        (grant.task.clone(), TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() });
    let effects = coordinator.happen(Event::Outcome { report: ReportOutcome::new(grant, outcome) }).expect("taken");
    let prunes = |effect: &Effect| matches!(effect, Effect::Prune { task: of, at_end: true, .. } if *of == task);
    assert_eq!(coordinator.run_state(&run), RunState::Finished);
    assert_eq!(effects.iter().filter(|effect| prunes(effect)).count(), 1, "{effects:?}");
}

fn members(coordinator: &PureCoordinator, name: &str) -> Vec<WorkerId> {
    match coordinator.assignment(name).map(|assignment| assignment.role) {
        Some(Role::Member { members, .. }) => members.into_iter().map(|member| member.worker).collect(),
        _ => Vec::new(),
    }
}

/// Every member of a gang of three in turn, including the first one. The failure of the last member ends the stage.
#[test]
fn p15_a_member_out_of_memory_leaves_its_gang_to_the_others() {
    for order in [["a", "b", "c"], ["c", "a", "b"], ["b", "c", "a"]] {
        let mut coordinator = PureCoordinator::new(Policy::default());
        let (run, _) = gang_of_three(&mut coordinator);
        for (i, name) in order.iter().enumerate() {
            let assignment = coordinator.assignment(name).expect("a member");
            coordinator.report(&assignment, failed(FailureClass::OutOfMemory));
            let left: Vec<WorkerId> = order[i + 1..].iter().map(|name| WorkerId::from(*name)).collect();
            if let Some(next) = left.first() {
                assert_eq!(coordinator.run_state(&run), RunState::Running, "{name} of {order:?}");
                assert!(coordinator.assignment(name).is_none(), "not taken into it again");
                // Neither a poll nor another join changes this.
                let incarnation = coordinator.join(name);
                coordinator.poll(name, incarnation);
                let mut members = members(&coordinator, next.as_str());
                members.sort_unstable();
                let mut left = left.clone();
                left.sort_unstable();
                assert_eq!(members, left);
            }
        }
        assert_eq!(coordinator.run_state(&run), RunState::Failed);
        // After a resume, all workers may try again.
        coordinator.control(&run, Control::Resume).expect("taken up");
        assert_eq!(members(&coordinator, "a").len(), 3);
    }
}

#[test]
fn a_gang_has_no_more_members_than_a_batch_has_slices() {
    for (slices, range) in
        [(1, WorkerRange::default()), (2, WorkerRange { min: 1, max: 3 }), (2, WorkerRange { min: 3, max: 3 })]
    {
        let mut coordinator = PureCoordinator::new(Policy::default());
        let mut pipeline = pipelines::quickstart(1, range, &[]);
        for stage in &mut pipeline.stages {
            if let Some(training) = stage.settings.training_mut() {
                training.batch.slices = slices;
            }
        }
        let submit = Event::Submit {
            submission: None,
            pipeline: Box::new(pipeline),
            source: String::new(),
            idempotency_key: None,
            until: Some("vae".into()),
            owner: protocol::Owner::local("me"),
        };
        coordinator.happen(submit).expect("submitted");
        for name in ["a", "b", "c", "d"] {
            coordinator.join(name);
        }
        let dataset = coordinator.assignment("a").expect("granted");
        let output = Digest::of(b"clips");
        coordinator.report(&dataset, TaskOutcome::Finished { output, metrics: Default::default() });
        assert_eq!(members(&coordinator, "a").len(), slices, "{slices} slices and {range:?}");
    }
}

#[test]
fn another_owners_run_keeps_its_placement() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let mut submit = |name: &str, min| {
        let event = Event::Submit {
            submission: None,
            pipeline: Box::new(pipelines::quickstart(1, WorkerRange { min, max: min }, &[])),
            source: String::new(),
            idempotency_key: None,
            until: Some("dataset".into()),
            owner: protocol::Owner { name: name.into(), ..Default::default() },
        };
        coordinator.happen(event).expect("submitted");
        let executions: Vec<_> = coordinator.state.executions.values().collect();
        assert_eq!(executions.len(), 1, "both want the same stage");
        executions[0].placement.workers.min
    };
    assert_eq!(submit("alice", 1), 1);
    assert_eq!(submit("bob", 9), 1, "he waits for what she has computed");
    assert_eq!(submit("alice", 2), 1, "his run waits for it as well");
    let mut coordinator = PureCoordinator::new(Policy::default());
    let run = coordinator.submit("dataset", WorkerRange { min: 1, max: 1 });
    coordinator.submit("dataset", WorkerRange { min: 2, max: 2 });
    let placement =
        |coordinator: &PureCoordinator| coordinator.state.executions.values().next().expect("one").placement.clone();
    assert_eq!(placement(&coordinator).workers.min, 2, "its owner's newest wish counts");
    assert_eq!(coordinator.run_state(&run), RunState::Running);
}

/// The end of a plain task, the end of a gang and a checkpoint of a gang, with blobs that were collected before they
/// were named.
#[test]
fn what_names_a_missing_blob_is_a_failed_try_and_is_tried_again() {
    for checkpoint in [None, Some(false), Some(true)] {
        let mut coordinator = PureCoordinator::new(Policy::default());
        let run = match checkpoint {
            None => {
                let run = coordinator.submit("dataset", WorkerRange::default());
                coordinator.join("a");
                run
            }
            Some(_) => gang_of_three(&mut coordinator).0,
        };
        let mut tries = 0;
        while coordinator.run_state(&run) == RunState::Running {
            let grant = coordinator.assignment("a").expect("granted again").grant;
            tries += 1;
            let (output, metrics) = (Digest::of(b"gone"), Default::default());
            let event = match checkpoint {
                Some(true) => {
                    Event::Checkpoint { commit: CommitCheckpoint { grant, step: 1, manifest: output, metrics } }
                }
                _ => {
                    let outcome = TaskOutcome::Finished { output, metrics };
                    Event::Outcome { report: ReportOutcome::new(grant, outcome) }
                }
            };
            let error = WriteError::NotFound("blob is not in the store".into());
            let instead = refused_for_good(&event, &error).expect("something happens instead");
            coordinator.happen(instead).expect("taken");
            assert!(!coordinator.is_held(), "an idle worker would hold it for ever");
            coordinator.now += 40_000;
            for name in ["a", "b", "c"] {
                if let Some(worker) = coordinator.state.workers.get(&WorkerId::from(name)) {
                    let incarnation = worker.incarnation;
                    coordinator.poll(name, incarnation);
                }
            }
            coordinator.tick();
        }
        assert_eq!(tries, Policy::default().fault_budget + 1, "within the budget");
        assert_eq!(coordinator.run_state(&run), RunState::Failed);
    }
}

#[test]
fn two_states_of_one_step_end_the_stage_and_are_both_named() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, _) = gang_of_three(&mut coordinator);
    let assignment = coordinator.assignment("a").expect("it trains");
    save(&mut coordinator, &assignment, 1, "one");
    save(&mut coordinator, &assignment, 1, "one");
    assert_eq!(coordinator.run_state(&run), RunState::Running, "the same is the same");
    save(&mut coordinator, &assignment, 1, "another");
    let view = coordinator.view(&run);
    let stage = view.stages.iter().find(|stage| stage.state == StageState::Failed).expect("it failed");
    let message = stage.message.clone().unwrap_or_default();
    for digest in ["one", "another"] {
        assert!(message.contains(&Digest::of(digest.as_bytes()).to_string()), "{message}");
    }
}

/// Several generations of a gang under the same entropy, and the same under another one.
#[test]
fn every_generation_has_a_secret_of_its_own() {
    let mut secrets = Vec::new();
    for entropy in ["one", "two"] {
        let mut coordinator = PureCoordinator::new(Policy::default());
        coordinator.entropy = Digest::of(entropy.as_bytes());
        gang_of_three(&mut coordinator);
        for next in ["b", "c", "d", "e"] {
            match coordinator.assignment("a").expect("it trains").role {
                Role::Member { secret, .. } => secrets.push(secret),
                role => panic!("{role:?}"),
            }
            if coordinator.state.workers.contains_key(&WorkerId::from(next)) {
                coordinator.happen(Event::WorkerGone { worker: next.into(), incarnation: None }).expect("taken");
            } else {
                coordinator.join(next);
            }
        }
    }
    let mut distinct = secrets.clone();
    distinct.sort_unstable();
    distinct.dedup();
    assert!(distinct.len() == secrets.len() && secrets.iter().all(|secret| secret.len() >= 32), "{secrets:?}");
}

fn submit(coordinator: &mut PureCoordinator, seed: u64) -> RunId {
    let submit = Event::Submit {
        submission: None,
        pipeline: Box::new(pipelines::quickstart(seed, WorkerRange::default(), &[])),
        source: String::new(),
        idempotency_key: None,
        until: None,
        owner: protocol::Owner::local("me"),
    };
    let effects = coordinator.happen(submit).expect("submitted");
    let run = effects.into_iter().find_map(|effect| match effect {
        coordinator::Effect::Submitted(run) => Some(run),
        _ => None,
    });
    run.expect("a submission gives a run")
}

/// Cancelled, failed and resumed runs. A resumed run continues its unfinished stages, with numbers that were never
/// used.
#[test]
fn an_ended_run_leaves_memory_and_is_taken_up_where_it_was() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, _) = gang_of_three(&mut coordinator);
    let first = coordinator.assignment("a").expect("it trains");
    save(&mut coordinator, &first, 3, "step 3");
    coordinator.control(&run, Control::Cancel).expect("taken");
    assert!(coordinator.state.runs.is_empty(), "it has ended");
    assert!(coordinator.is_held(), "its workers may still save");
    coordinator.report(&first, TaskOutcome::Yielded { at: 3 });
    assert!(coordinator.state.executions.is_empty() && coordinator.state.tasks.is_empty());
    assert_eq!(coordinator.run_state(&run), RunState::Cancelled);

    coordinator.restart(false);
    for name in ["a", "b", "c"] {
        coordinator.join(name);
    }
    coordinator.control(&run, Control::Resume).expect("taken up");
    let second = coordinator.assignment("a").expect("it trains again");
    assert_eq!(second.resume, Some(Digest::of(b"step 3")), "from where it was");
    assert_eq!(second.grant.task, first.grant.task);
    assert!(second.grant.fence > first.grant.fence && second.grant.attempt > first.grant.attempt);
    coordinator.control(&run, Control::Cancel).expect("taken");
    coordinator.report(&second, TaskOutcome::Yielded { at: 3 });

    // Another run of the same pipeline finds the value of the first stage and the checkpoint of the second.
    let other = coordinator.submit("vae", WorkerRange { min: 1, max: 3 });
    assert_ne!(other, run);
    let third = coordinator.assignment("a").expect("it trains for another run");
    assert_eq!(third.resume, Some(Digest::of(b"step 3")));
    assert!(third.grant.attempt > second.grant.attempt);
    let finished = TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() };
    coordinator.report(&third, finished);
    let view = coordinator.view(&other);
    assert_eq!(view.state, RunState::Finished);
    let states: Vec<StageState> = view.stages.iter().map(|stage| stage.state).take(3).collect();
    assert_eq!(states, [StageState::Cached, StageState::Skipped, StageState::Resumed]);
    assert!(coordinator.state.executions.is_empty());
}

/// Size of a snapshot with all of its parts, in bytes.
fn stored_bytes(state: &State) -> usize {
    let parts = journal::changed_parts(&State::new(Policy::default()), state);
    let texts = parts.iter().filter_map(|part| part.stored().1);
    journal::snapshot(state).len() + texts.map(|text| text.len()).sum::<usize>()
}

/// The cost of a submission, as the number of objects that decisions inspect and the size of the state.
#[test]
fn a_submission_costs_the_same_however_many_runs_have_ended() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let cost = |coordinator: &mut PureCoordinator, seeds: std::ops::Range<u64>| {
        let (before, count) = (coordinator.state.visits, seeds.end - seeds.start);
        for seed in seeds {
            let run = submit(coordinator, seed);
            coordinator.control(&run, Control::Cancel).expect("taken");
        }
        ((coordinator.state.visits - before) / count, stored_bytes(&coordinator.state))
    };
    let (visits, size) = cost(&mut coordinator, 0..10);
    cost(&mut coordinator, 10..150);
    let (later_visits, later_size) = cost(&mut coordinator, 150..160);
    assert_eq!(visits, later_visits);
    assert!(later_size <= size + 20, "the state grew from {size} to {later_size} bytes");

    // Waiting runs are not inspected either while no worker is idle.
    for seed in 1000..1040 {
        submit(&mut coordinator, seed);
    }
    let (beside_visits, _) = cost(&mut coordinator, 160..170);
    assert_eq!(visits, beside_visits, "with 40 runs that wait");
}

#[test]
fn a_worker_that_is_away_for_an_hour_leaves_memory_and_comes_back_as_another_process() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let old = coordinator.join("a");
    coordinator.happen(Event::WorkerGone { worker: "a".into(), incarnation: None }).expect("taken");
    coordinator.now += 3_590_000;
    coordinator.tick();
    assert!(coordinator.state.workers.contains_key(&WorkerId::from("a")));
    coordinator.now += 20_000;
    coordinator.tick();
    assert!(coordinator.state.workers.is_empty());
    coordinator.restart(false);
    let new: Incarnation = coordinator.join("a");
    assert!(new > old, "{new} after {old}");
}

#[test]
fn a_pipeline_of_more_than_a_thousand_stages_is_refused() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let mut pipeline = pipelines::quickstart(1, WorkerRange::default(), &[]);
    let text = pipeline.stages.remove(1);
    pipeline.stages = (0..=limits::STAGES)
        .map(|i| pipeline::PipelineStage { name: format!("s{i}").as_str().into(), ..text.clone() })
        .collect();
    let mut take = |pipeline: &pipeline::Pipeline| {
        let event = Event::Submit {
            submission: None,
            pipeline: Box::new(pipeline.clone()),
            source: String::new(),
            idempotency_key: None,
            until: Some("nowhere".into()),
            owner: protocol::Owner::local("me"),
        };
        coordinator.happen(event).expect_err("refused").to_string()
    };
    pipeline.stages[0].inputs.clear();
    for stage in &mut pipeline.stages {
        stage.inputs.clear();
    }
    let refused = take(&pipeline);
    assert!(refused.contains("1001 stages") && refused.contains("1000"), "{refused}");
    assert!(pipeline.check().is_err_and(|refused| refused.contains("1001 stages")));
    pipeline.stages.pop();
    let refused = take(&pipeline);
    assert!(refused.contains("nowhere"), "a thousand are taken: {refused}");
}

/// Data of other builds: a later minor version without unknown kinds, one with an unknown kind, and another major
/// version.
#[test]
fn what_is_stored_says_of_which_format_it_is() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let run = coordinator.submit("dataset", WorkerRange::default());
    coordinator.join("a");
    let recover = |stored: &registry::Recovery| journal::recover(Policy::default(), stored).map_err(|e| e.to_string());
    let with = |from: &str, to: &str| {
        let mut stored = coordinator.store.recovery.clone();
        let text = &mut stored.facts[1].1;
        assert!(text.contains(from), "{text}");
        *text = text.replace(from, to);
        recover(&stored)
    };
    assert!(recover(&coordinator.store.recovery).is_ok());
    let (major, minor) = journal::FORMAT;
    let now = format!("\"format\":[{major},{minor}]");
    assert!(with(&now, "\"format\":[2,7]").is_ok());
    let refused = with(&now, "\"format\":[3,0]").expect_err("another major version");
    assert!(refused.contains("format 3.0") && refused.contains("2.x") && refused.contains("decision 2"), "{refused}");
    let refused = with("\"execution-state\"", "\"horoscope\"").expect_err("an unknown kind");
    assert!(refused.contains("horoscope") && refused.contains("decision 2"), "{refused}");
    let mut stored = coordinator.store.recovery.clone();
    stored.facts.remove(1);
    let refused = recover(&stored).expect_err("one is missing");
    assert!(refused.contains("decision 3") && refused.contains("missing"), "{refused}");

    // The same for a snapshot.
    coordinator.store.snapshot(&coordinator.state);
    let whole = recover(&coordinator.store.recovery).expect("it opens");
    assert!(
        whole.run(&run).is_ok() && whole.executions.values().all(|execution| execution.state == ExecutionState::Open)
    );
    let (_, text) = coordinator.store.recovery.snapshot.as_mut().expect("a snapshot");
    *text = text.replace(&now, "\"format\":[3,1]");
    let refused = recover(&coordinator.store.recovery).expect_err("another major version");
    assert!(refused.contains("format 3.1") && refused.contains("snapshot"), "{refused}");
}
