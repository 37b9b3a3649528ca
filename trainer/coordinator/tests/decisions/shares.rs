//! Workers are shared between groups: a second group gets its part of running gangs, and gives it back.

use coordinator::{Control, Event, Observation, Policy};
use protocol::message::{Doing, Poll, Progress, Role, TaskOutcome};
use protocol::stage::WorkerRange;
use protocol::{Digest, RunId};

use crate::common::PureCoordinator;
use crate::priorities;

const NAMES: [&str; 4] = ["a", "b", "c", "d"];

/// Submits a training of `owner`, with seeds apart, so that no stage is shared.
fn submit(coordinator: &mut PureCoordinator, owner: &str, seed: u64, min: usize) -> RunId {
    priorities::submit(coordinator, owner, seed, 0, WorkerRange { min, max: 8 })
}

/// Ends the task of the worker that works for `run` alone, such as its dataset.
fn finish_small(coordinator: &mut PureCoordinator, run: &RunId) {
    let of_run = |name: &&str| {
        let held = coordinator.assignment(name);
        held.is_some_and(|held| held.grant.task.as_str().starts_with(run.as_str()) && held.role == Role::Alone)
    };
    let worker = NAMES.iter().copied().find(of_run).expect("one works for it");
    let held = coordinator.assignment(worker).expect("a task");
    let output = Digest::of(held.grant.task.as_str().as_bytes());
    coordinator.report(&held, TaskOutcome::Finished { output, metrics: Default::default() });
}

/// All members report that they hold the state, and time passes.
fn beat(coordinator: &mut PureCoordinator) {
    beat_of(coordinator, NAMES);
}

/// The same for some of the members.
fn beat_of(coordinator: &mut PureCoordinator, names: impl IntoIterator<Item = &'static str>) {
    for name in names {
        let Some(worker) = coordinator.state.workers.get(&name.into()) else { continue };
        let incarnation = worker.incarnation;
        let ready = worker.ready.iter().cloned().collect();
        let doing = coordinator
            .assignment(name)
            .map(|held| Doing { holds: Some(7), ..Doing::new(held.grant, Progress::default()) });
        let poll = Poll { incarnation, doing: doing.into_iter().collect(), ready, version: 0, leaving: false };
        coordinator.hear(Observation::Poll { worker: name.into(), poll });
    }
    coordinator.now += 1_000;
    coordinator.tick();
}

/// Number of workers that hold a task of each run.
fn holding(coordinator: &PureCoordinator, runs: [&RunId; 2]) -> [usize; 2] {
    let held = |run: &RunId| {
        let tasks = NAMES.iter().filter_map(|name| coordinator.assignment(name));
        tasks.filter(|held| held.grant.task.as_str().starts_with(run.as_str())).count()
    };
    runs.map(held)
}

/// A coordinator whose four workers train for `mine`.
fn trains(owner: &str, min: usize) -> (PureCoordinator, RunId) {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let mine = submit(&mut coordinator, owner, 1, min);
    coordinator.join("a");
    finish_small(&mut coordinator, &mine);
    for name in &NAMES[1..] {
        coordinator.join(name);
        beat(&mut coordinator);
    }
    beat(&mut coordinator);
    (coordinator, mine)
}

#[test]
fn a_second_group_gets_half_of_the_workers_and_gives_them_back() {
    let (mut coordinator, mine) = trains("me", 1);
    assert_eq!(holding(&coordinator, [&mine, &mine]), [4, 4]);
    let yours = submit(&mut coordinator, "you", 2, 1);
    assert_eq!(holding(&coordinator, [&mine, &yours]), [3, 1], "its dataset begins at once");
    finish_small(&mut coordinator, &yours);
    for _ in 0..5 {
        beat(&mut coordinator);
    }
    assert_eq!(holding(&coordinator, [&mine, &yours]), [2, 2]);
    let attempt = |coordinator: &PureCoordinator, run: &RunId| {
        let of_run = coordinator.state.executions.values().filter(|execution| execution.run == *run);
        of_run.map(|execution| execution.attempt().0).max()
    };
    assert_eq!(attempt(&coordinator, &mine), Some(1), "the gang only regroups");
    coordinator.control(&yours, Control::Cancel).expect("cancelled");
    let leads = |name: &&str| {
        let held = coordinator.assignment(name).filter(|held| held.grant.task.as_str().starts_with(yours.as_str()));
        matches!(held.map(|held| held.role), Some(Role::Member { members, .. }) if members[0].worker.as_str() == *name)
    };
    let leader = NAMES.iter().copied().find(leads).expect("a leader");
    let held = coordinator.assignment(leader).expect("its task");
    coordinator.report(&held, TaskOutcome::Yielded { at: 7 });
    for _ in 0..3 {
        beat(&mut coordinator);
    }
    assert_eq!(holding(&coordinator, [&mine, &yours]), [4, 0]);
}

#[test]
fn runs_of_one_group_and_gangs_at_their_minimum_keep_their_workers() {
    let (mut coordinator, mine) = trains("me", 1);
    let later = submit(&mut coordinator, "me", 2, 1);
    beat(&mut coordinator);
    assert_eq!(holding(&coordinator, [&mine, &later]), [4, 0], "runs of one group are served in their order");
    let (mut coordinator, mine) = trains("me", 4);
    let yours = submit(&mut coordinator, "you", 2, 1);
    beat(&mut coordinator);
    assert_eq!(holding(&coordinator, [&mine, &yours]), [4, 0]);
}

/// A worker that falls silent while it is kept costs no decision at every tick.
#[test]
fn a_kept_worker_that_falls_silent_costs_no_decisions() {
    let (mut coordinator, _mine) = trains("me", 3);
    let yours = submit(&mut coordinator, "you", 2, 1);
    coordinator.quick = false;
    finish_small(&mut coordinator, &yours);
    beat(&mut coordinator);
    let kept = NAMES.into_iter().find(|name| coordinator.assignment(name).is_none()).expect("an idle one");
    let lease = Policy::default().lease_ms / 1_000;
    let over = Policy::default().share_ms / 1_000 + lease;
    for _ in 0..over {
        beat_of(&mut coordinator, NAMES.into_iter().filter(|name| *name != kept));
    }
    let before = coordinator.state.seq;
    for _ in 0..30 {
        beat_of(&mut coordinator, NAMES.into_iter().filter(|name| *name != kept));
    }
    assert_eq!(coordinator.state.seq, before);
}

/// A worker that never prepares for the other group's gang does not stay idle.
#[test]
fn a_worker_that_its_group_does_not_use_goes_back() {
    let (mut coordinator, mine) = trains("me", 1);
    let yours = submit(&mut coordinator, "you", 2, 1);
    coordinator.quick = false;
    finish_small(&mut coordinator, &yours);
    beat(&mut coordinator);
    assert_eq!(holding(&coordinator, [&mine, &yours]), [3, 0], "it is kept for the training that it prepares");
    let idle = NAMES.into_iter().find(|name| coordinator.assignment(name).is_none()).expect("an idle one");
    let prepares = coordinator.asked(idle).into_iter().map(|prepare| prepare.task);
    let tasks = prepares.filter(|task| task.as_str().starts_with(mine.as_str())).collect();
    let incarnation = coordinator.state.workers[&idle.into()].incarnation;
    coordinator.happen(Event::WorkerReady { worker: idle.into(), incarnation, tasks }).expect("taken");
    let kept = Policy::default().share_ms / 1_000 - 5;
    for _ in 0..kept {
        beat(&mut coordinator);
    }
    assert_eq!(holding(&coordinator, [&mine, &yours]), [3, 0], "it is kept, although it could join the other gang");
    for _ in 0..10 {
        beat(&mut coordinator);
    }
    assert_eq!(holding(&coordinator, [&mine, &yours]), [4, 0]);
    for _ in 0..300 {
        beat(&mut coordinator);
        assert_eq!(holding(&coordinator, [&mine, &yours]), [4, 0], "a group that lets workers idle gets no other one");
    }
    let urgent = super::priorities::submit(&mut coordinator, "you", 3, 9, super::priorities::MANY);
    for _ in 0..30 {
        beat(&mut coordinator);
        assert_eq!(holding(&coordinator, [&mine, &urgent]), [4, 0], "nor with a priority");
    }
}
