//! Limits of groups: a group gets no more workers than its limit, and further runs wait.

use std::collections::BTreeMap;
use std::sync::Arc;

use coordinator::{Control, Event, Policy};
use protocol::message::TaskOutcome;
use protocol::{Digest, Group, GroupLimits, RunId};

use super::priorities::{ALONE, MANY, beat, finish_small, submit, task};
use crate::common::PureCoordinator;

fn of_me(limits: GroupLimits) -> Arc<BTreeMap<Group, GroupLimits>> {
    Arc::new(BTreeMap::from([(Group::new("me"), limits)]))
}

fn workers(most: usize) -> GroupLimits {
    GroupLimits { workers: Some(most), ..GroupLimits::default() }
}

fn runs(most: usize) -> GroupLimits {
    GroupLimits { runs: Some(most), ..GroupLimits::default() }
}

fn limited(limits: GroupLimits) -> PureCoordinator {
    PureCoordinator::new(Policy { limits: of_me(limits), ..Policy::default() })
}

const NAMES: [&str; 4] = ["a", "b", "c", "d"];

/// Workers that hold a task of a run.
fn of_run(coordinator: &PureCoordinator, run: &RunId) -> Vec<&'static str> {
    let known = NAMES.into_iter().filter(|name| coordinator.state.workers.contains_key(&(*name).into()));
    known.filter(|name| task(coordinator, name).starts_with(run.as_str())).collect()
}

#[test]
fn a_group_gets_no_more_workers_than_its_limit() {
    let mut coordinator = limited(workers(1));
    let mine = submit(&mut coordinator, "me", 1, 0, MANY);
    coordinator.join("a");
    finish_small(&mut coordinator, "a");
    for name in &NAMES[1..] {
        coordinator.join(name);
        beat(&mut coordinator);
    }
    beat(&mut coordinator);
    assert_eq!(of_run(&coordinator, &mine).len(), 1, "three workers stay idle");
    coordinator.happen(Event::Limits { limits: of_me(workers(2)) }).expect("taken");
    assert_eq!(of_run(&coordinator, &mine).len(), 2, "only one of three idle workers joins");
    let next = submit(&mut coordinator, "me", 2, 0, ALONE);
    beat(&mut coordinator);
    assert_eq!(of_run(&coordinator, &next).len(), 0);
    let waits = coordinator.view(&next).stages[0].message.clone().unwrap_or_default();
    assert_eq!(waits, "waits for 1 idle `flex` worker; me already has 2 workers, the most allowed");
    let yours = submit(&mut coordinator, "you", 3, 0, ALONE);
    assert_eq!(of_run(&coordinator, &yours).len(), 1, "another group has no limit");
    coordinator.happen(Event::Limits { limits: of_me(workers(3)) }).expect("taken");
    assert_eq!(of_run(&coordinator, &next).len(), 1, "{next} begins at once");
    coordinator.happen(Event::Limits { limits: of_me(workers(1)) }).expect("taken");
    beat(&mut coordinator);
    assert_eq!(of_run(&coordinator, &mine).len() + of_run(&coordinator, &next).len(), 3, "work under way continues");
}

/// Within the limit, a higher priority still gets the worker of a lower one.
#[test]
fn a_full_group_serves_its_higher_priority_with_its_own_workers() {
    let mut coordinator = limited(workers(1));
    let low = submit(&mut coordinator, "me", 1, 0, ALONE);
    coordinator.join("a");
    coordinator.join("b");
    finish_small(&mut coordinator, "a");
    assert_eq!(of_run(&coordinator, &low).len(), 1);
    let high = submit(&mut coordinator, "me", 2, 1, ALONE);
    let [at_work] = of_run(&coordinator, &low)[..] else { panic!("one works") };
    let held = coordinator.assignment(at_work).expect("its training");
    assert!(held.drain);
    coordinator.report(&held, TaskOutcome::Yielded { at: 3 });
    assert_eq!((of_run(&coordinator, &low).len(), of_run(&coordinator, &high).len()), (0, 1));
}

#[test]
fn further_runs_wait_and_begin_by_priority() {
    let mut coordinator = limited(runs(1));
    for name in NAMES {
        coordinator.join(name);
    }
    let first = submit(&mut coordinator, "me", 1, 0, ALONE);
    let second = submit(&mut coordinator, "me", 2, 0, ALONE);
    let third = submit(&mut coordinator, "me", 3, 7, ALONE);
    let yours = submit(&mut coordinator, "you", 4, 0, ALONE);
    let at_work = |coordinator: &PureCoordinator| {
        let runs = [&first, &second, &third, &yours];
        runs.map(|run| of_run(coordinator, run).len())
    };
    assert_eq!(at_work(&coordinator), [1, 0, 0, 1]);
    let view = coordinator.view(&second);
    assert!(view.queued && !coordinator.view(&first).queued);
    assert_eq!(view.note, "queued: 1 run of me at work, at most 1 allowed");
    coordinator.restart(false);
    assert_eq!(at_work(&coordinator), [1, 0, 0, 1], "a queued run is still queued after a restart");
    coordinator.control(&first, Control::Pause).expect("paused");
    assert_eq!(at_work(&coordinator)[2], 1, "the higher priority begins when a run is paused");
    coordinator.control(&first, Control::Resume).expect("resumed");
    assert!(coordinator.view(&first).queued, "its place is taken");
    coordinator.control(&third, Control::Cancel).expect("cancelled");
    assert!(!coordinator.view(&first).queued && coordinator.view(&second).queued, "the order of submission again");
    coordinator.happen(Event::Limits { limits: Arc::default() }).expect("taken");
    assert!(!coordinator.view(&second).queued);
    assert_eq!(coordinator.happen(Event::Limits { limits: Arc::default() }), Ok(Vec::new()), "nothing changes");
}

/// A finished run makes room in the same decision.
#[test]
fn the_next_run_begins_when_one_ends() {
    let mut coordinator = limited(runs(1));
    coordinator.join("a");
    let first = submit(&mut coordinator, "me", 1, 0, ALONE);
    let second = submit(&mut coordinator, "me", 2, 0, ALONE);
    finish_small(&mut coordinator, "a");
    let held = coordinator.assignment("a").expect("its training");
    assert_eq!(of_run(&coordinator, &first), ["a"]);
    coordinator.report(&held, TaskOutcome::Finished { output: Digest::of(b"vae"), metrics: Default::default() });
    assert_eq!(of_run(&coordinator, &second), ["a"]);
}
