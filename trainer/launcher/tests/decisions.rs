//! Decisions of a launcher under virtual time, with an engine and a coordinator that exist only here.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::collections::BTreeMap;
use std::time::Duration;

use launcher::{Action, Fleet, Job, JobState, Observation, Plan};
use protocol::WorkerId;
use protocol::demand::{Demand, DemandGroup, DemandWorker};
use protocol::stage::Backend;

const IDLE: u64 = 60;

fn plan(min: usize, max: usize) -> Plan {
    Plan {
        prefix: "stride-t".into(),
        backend: Backend::Flex,
        labels: "gpu=h100".parse().unwrap(),
        min,
        max,
        idle: Duration::from_secs(IDLE),
        crashes: 5,
    }
}

/// A job of the engine, and its worker.
#[derive(Debug, Clone, Default)]
struct Simulated {
    age: u64,
    polls: bool,
    leaves: bool,
    works: bool,
}

/// An engine with machines, and a coordinator with slots.
struct World {
    now: u64,
    jobs: BTreeMap<String, Simulated>,
    /// Workers that someone started by hand.
    others: usize,
    /// Slots of open work.
    slots: usize,
    /// Seconds until a submitted job's worker polls; `None` if it crashes.
    starts_in: Option<u64>,
    submitted: usize,
    /// Largest number of jobs at a time.
    most: usize,
}

impl World {
    fn new() -> Self {
        Self { now: 0, jobs: BTreeMap::new(), others: 0, slots: 0, starts_in: Some(3), submitted: 0, most: 0 }
    }

    fn demand(&self) -> Demand {
        let worker = |name: String, idle: bool| DemandWorker {
            worker: WorkerId::new(name),
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            labels: "gpu=h100".parse().unwrap(),
            idle,
        };
        let polling = self.jobs.iter().filter(|(_, job)| job.polls);
        let mut workers: Vec<_> = polling.map(|(name, job)| worker(name.clone(), !job.works)).collect();
        let works = self.jobs.values().filter(|job| job.works).count();
        workers.extend((0..self.others).map(|i| worker(format!("other-{i}"), true)));
        let ready = self.slots.saturating_sub(works) as u64;
        let group = |requires: &str, ready: u64| DemandGroup {
            backend: Backend::Flex,
            requires: requires.parse().unwrap(),
            instruction_set: None,
            ready,
            wanted: ready,
            idle: 0,
            oldest_wait_ms: 0,
        };
        // Work for other machines is no demand for these.
        let groups = vec![group("gpu=h100", ready), group("gpu=a100", 100)];
        Demand { version: 1, lead_ms: 15_000, groups, workers }
    }

    fn listed(&self) -> Vec<Job> {
        let state = |job: &Simulated| if job.age == 0 { JobState::Pending } else { JobState::Running };
        let listed = self.jobs.iter();
        listed.map(|(name, job)| Job { worker: name.clone(), id: name.clone(), state: state(job) }).collect()
    }

    /// One second, one pass of the launcher.
    fn pass(&mut self, fleet: &mut Fleet) -> Vec<Action> {
        self.advance();
        let (demand, jobs) = (self.demand(), self.listed());
        let now = Duration::from_secs(self.now);
        let actions = fleet.decide(Observation { now, stamp: 1_000_000 + self.now, demand: &demand, jobs: &jobs });
        for action in &actions {
            match action {
                Action::Submit { worker } => {
                    self.submitted += 1;
                    assert!(self.jobs.insert(worker.clone(), Simulated::default()).is_none(), "{worker} is new");
                }
                Action::Retire { job } => self.jobs.get_mut(&job.worker).unwrap().leaves = true,
            }
        }
        self.most = self.most.max(self.jobs.len());
        actions
    }

    fn advance(&mut self) {
        self.now += 1;
        let starts_in = self.starts_in;
        self.jobs.retain(|_, job| {
            job.age += 1;
            job.polls |= starts_in.is_some_and(|seconds| job.age >= seconds);
            let crashes = starts_in.is_none() && !job.polls;
            let has_left = job.leaves && !job.works;
            !has_left && !crashes
        });
        let mut left = self.slots;
        for job in self.jobs.values_mut().filter(|job| job.polls) {
            job.works = left > 0 && !job.leaves;
            left -= usize::from(job.works);
        }
    }

    fn run(&mut self, fleet: &mut Fleet, seconds: u64) {
        (0..seconds).for_each(|_| drop(self.pass(fleet)));
    }

    fn working(&self) -> usize {
        self.jobs.values().filter(|job| job.works).count()
    }
}

#[test]
fn workers_follow_the_demand_from_none_to_many_to_none() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 8)));
    world.run(&mut fleet, 30);
    assert_eq!(world.submitted, 0, "no demand, no jobs");
    world.slots = 5;
    world.run(&mut fleet, 30);
    assert_eq!((world.submitted, world.working()), (5, 5), "as many as there are slots, once");
    world.slots = 20;
    world.run(&mut fleet, 30);
    assert_eq!((world.most, world.working()), (8, 8), "at most MAX");
    world.slots = 0;
    world.run(&mut fleet, IDLE / 2);
    assert_eq!(world.jobs.len(), 8, "idle workers wait for more work");
    world.slots = 3;
    world.run(&mut fleet, IDLE);
    assert_eq!((world.working(), world.submitted), (3, 8), "which idle workers take");
    world.slots = 0;
    world.run(&mut fleet, 2 * IDLE);
    assert!(world.jobs.is_empty(), "{:?}", world.jobs);
}

#[test]
fn a_minimum_stays_and_idle_workers_of_others_are_used_first() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(2, 8)));
    world.run(&mut fleet, 3 * IDLE);
    assert_eq!((world.jobs.len(), world.submitted), (2, 2));
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 8)));
    (world.others, world.slots) = (3, 4);
    world.run(&mut fleet, 1);
    assert_eq!(world.submitted, 1, "three of the slots have workers");
}

#[test]
fn a_crashing_template_is_tried_ever_more_rarely_and_then_given_up() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 8)));
    (world.slots, world.starts_in) = (8, None);
    let mut times = Vec::new();
    for _ in 0..3600 {
        let before = world.submitted;
        world.pass(&mut fleet);
        times.extend((world.submitted > before).then_some((world.now, world.submitted - before)));
    }
    assert!(fleet.has_given_up());
    let counts: Vec<usize> = times.iter().map(|(_, count)| *count).collect();
    assert_eq!(counts, [8, 1, 1, 1, 1], "no crowd of jobs after the first crash");
    let pauses: Vec<u64> = times.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    assert!(pauses.windows(2).all(|pair| pair[1] > pair[0]), "{pauses:?}");
}

#[test]
fn jobs_that_end_before_any_work_are_named_and_others_are_not() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 4)));
    world.slots = 2;
    while world.working() < 2 {
        world.pass(&mut fleet);
    }
    world.pass(&mut fleet);
    (world.slots, world.jobs) = (0, BTreeMap::new());
    world.run(&mut fleet, 5);
    assert_eq!(fleet.take_crashed(), Vec::<String>::new(), "these workers have worked");
    (world.slots, world.starts_in) = (2, None);
    world.run(&mut fleet, 30);
    let crashed = fleet.take_crashed();
    assert!(crashed.len() >= 2 && crashed.iter().all(|name| name.starts_with("stride-t-")), "{crashed:?}");
    assert_eq!(fleet.take_crashed(), Vec::<String>::new(), "each is named once");
}

#[test]
fn a_template_that_works_again_is_trusted_again() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 4)));
    (world.slots, world.starts_in) = (4, None);
    while world.submitted < 6 {
        world.pass(&mut fleet);
    }
    world.starts_in = Some(2);
    world.run(&mut fleet, 60);
    assert_eq!(world.working(), 4);
    assert!(!fleet.has_given_up());
}

#[test]
fn a_restarted_launcher_counts_the_jobs_of_the_earlier_one() {
    let mut world = World::new();
    world.slots = 6;
    world.starts_in = Some(20);
    let mut fleet = Fleet::new(plan(0, 8));
    world.run(&mut fleet, 2);
    assert_eq!(world.submitted, 6);
    let mut restarted = Fleet::new(plan(0, 8));
    world.run(&mut restarted, 60);
    assert_eq!((world.submitted, world.working()), (6, 6), "those that pend and those that run");
    world.slots = 0;
    world.run(&mut Fleet::new(plan(0, 8)), 2 * IDLE);
    assert!(world.jobs.is_empty(), "and it ends them");
}

#[test]
fn the_jobs_of_another_launcher_are_left_alone() {
    let mut fleet = Fleet::new(plan(0, 8));
    let jobs = ["stride-t2-x-001", "stride-t", "mine"].map(|name| Job {
        worker: name.into(),
        id: "1".into(),
        state: JobState::Running,
    });
    let demand = World::new().demand();
    for now in [0, 1_000, 10_000] {
        let now = Duration::from_secs(now);
        let actions = fleet.decide(Observation { now, stamp: 1, demand: &demand, jobs: &jobs });
        assert!(actions.is_empty(), "{actions:?}");
    }
}

/// Slurm reports a job lost with its node, while the worker lives on.
#[test]
fn a_worker_that_polls_is_alive_whatever_the_engine_reports() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 8)));
    world.slots = 2;
    world.run(&mut fleet, 30);
    let (demand, no_jobs) = (world.demand(), Vec::new());
    for now in 30..90 {
        let now = Duration::from_secs(now);
        let actions = fleet.decide(Observation { now, stamp: 1, demand: &demand, jobs: &no_jobs });
        assert!(actions.is_empty(), "{actions:?}");
    }
}

/// Preempted in its first seconds, before it has worked.
#[test]
fn a_job_that_the_engine_revokes_is_replaced_at_once_and_is_no_crash() {
    let (world, mut fleet) = (World { slots: 1, ..World::new() }, Fleet::new(plan(0, 8)));
    let demand = world.demand();
    let mut jobs: Vec<Job> = Vec::new();
    for pass in 0..20 {
        let actions =
            fleet.decide(Observation { now: Duration::from_secs(pass), stamp: pass, demand: &demand, jobs: &jobs });
        let [Action::Submit { worker }] = &actions[..] else { panic!("{pass}: {actions:?}") };
        jobs.push(Job { worker: worker.clone(), id: worker.clone(), state: JobState::Running });
        let now = Duration::from_millis(1_000 * pass + 500);
        let actions = fleet.decide(Observation { now, stamp: pass, demand: &demand, jobs: &jobs });
        assert!(actions.is_empty(), "{pass}: {actions:?}");
        jobs.last_mut().unwrap().state = JobState::Revoked;
    }
    assert_eq!(fleet.take_crashed(), Vec::<String>::new());
}

#[test]
fn a_submission_whose_call_hung_is_counted_until_the_engine_has_had_time_to_list_it() {
    let (world, mut fleet) = (World { slots: 1, ..World::new() }, Fleet::new(plan(0, 8)));
    let demand = world.demand();
    let decide = |now: u64, fleet: &mut Fleet| {
        fleet.decide(Observation { now: Duration::from_secs(now), stamp: now, demand: &demand, jobs: &[] })
    };
    let first = decide(0, &mut fleet);
    let [Action::Submit { worker }] = &first[..] else { panic!("{first:?}") };
    fleet.submission_failed(worker, true, Duration::from_secs(1));
    assert!(decide(5, &mut fleet).is_empty(), "it may exist");
    assert_eq!(decide(12, &mut fleet).len(), 1, "it does not");
    assert!(!fleet.has_given_up());
}

#[test]
fn a_job_that_pends_without_need_is_withdrawn_after_the_idle_time() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 8)));
    (world.slots, world.starts_in) = (3, Some(100_000));
    world.run(&mut fleet, 5);
    world.slots = 1;
    world.run(&mut fleet, IDLE + 5);
    assert_eq!(world.jobs.len(), 1, "one is still wanted");
}

/// A stage continues on the instruction set of its earlier workers, which the machines of this engine lack.
#[test]
fn no_more_workers_come_for_a_slot_that_those_of_this_engine_do_not_fit() {
    let (mut world, mut fleet) = (World::new(), Fleet::new(plan(0, 8)));
    let mut submitted = 0;
    for now in 1..=IDLE {
        world.advance();
        let (mut demand, jobs) = (world.demand(), world.listed());
        demand.groups[0].ready = 1;
        demand.groups[0].instruction_set = Some("avx512".into());
        let now = Duration::from_secs(now);
        for action in fleet.decide(Observation { now, stamp: 1, demand: &demand, jobs: &jobs }) {
            let Action::Submit { worker } = action else { panic!("{action:?}") };
            world.jobs.insert(worker, Simulated::default());
            submitted += 1;
        }
    }
    assert_eq!(submitted, 1);
}
