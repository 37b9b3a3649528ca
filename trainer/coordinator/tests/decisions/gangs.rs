//! Gang members that complain of each other, fail or hang: the right member leaves, and the gang keeps its state.

use std::collections::BTreeMap;

use coordinator::state::worker::Presence;
use coordinator::{Observation, Policy};
use protocol::message::{Doing, FailureClass, LossCause, LostPeer, Poll, Progress, RunState, TaskOutcome};
use protocol::stage::WorkerRange;
use protocol::{Digest, Incarnation, RunId, WorkerId};

use crate::common::{PureCoordinator, failed, pipelines};

/// A coordinator with a training stage, and its workers by name.
struct Gang {
    coordinator: PureCoordinator,
    run: RunId,
    processes: BTreeMap<String, Incarnation>,
}

impl Gang {
    fn new(range: WorkerRange, names: &[&str]) -> Self {
        let mut coordinator = PureCoordinator::new(Policy::default());
        let mut pipeline = pipelines::quickstart(1, range, &[]);
        for stage in &mut pipeline.stages {
            if let Some(training) = stage.settings.training_mut() {
                training.batch.slices = 8;
            }
        }
        let submit = coordinator::Event::Submit {
            submission: None,
            owner: protocol::Owner::local("me"),
            pipeline: Box::new(pipeline),
            source: String::new(),
            idempotency_key: None,
            until: Some("vae".into()),
        };
        let effects = coordinator.happen(submit).expect("submitted");
        let run = effects.into_iter().find_map(|effect| match effect {
            coordinator::Effect::Submitted(run) => Some(run),
            _ => None,
        });
        let mut gang = Self { coordinator, run: run.expect("a run"), processes: BTreeMap::new() };
        gang.join(names[0]);
        let dataset = gang.coordinator.assignment(names[0]).expect("the only worker gets it");
        let finished = TaskOutcome::Finished { output: Digest::of(b"clips"), metrics: Default::default() };
        gang.coordinator.report(&dataset, finished);
        names[1..].iter().for_each(|name| gang.join(name));
        gang
    }

    fn join(&mut self, name: &str) {
        let incarnation = self.coordinator.join(name);
        self.processes.insert(name.to_owned(), incarnation);
    }

    /// Polls for a member, with its step and its complaints.
    fn say_for(&mut self, name: &str, holds: Option<u64>, lost: &[&str], cause: LossCause) {
        let doing = self.coordinator.assignment(name).map(|assignment| {
            let lost = lost.iter().map(|of| LostPeer { worker: (*of).into(), cause }).collect();
            Doing { holds, lost, ..Doing::new(assignment.grant, Progress::default()) }
        });
        let doing = doing.into_iter().collect();
        let poll = Poll { incarnation: self.processes[name], doing, ready: Vec::new(), version: 0, leaving: false };
        self.coordinator.hear(Observation::Poll { worker: name.into(), poll });
    }

    fn say(&mut self, name: &str, holds: Option<u64>, lost: &[&str]) {
        self.say_for(name, holds, lost, LossCause::Unreachable);
    }

    fn pass(&mut self, ms: u64) {
        self.coordinator.now += ms;
        self.coordinator.tick();
    }

    /// The members by rank, and the attempt.
    fn members(&self) -> (Vec<String>, u64) {
        let task = self.coordinator.state.executions.values().flat_map(|execution| &execution.tasks);
        let mut held = task.filter(|task| task.is_held()).map(|task| {
            let names = task.holders().iter().map(|member| member.worker.to_string()).collect();
            (names, task.attempt.0)
        });
        held.next_back().unwrap_or_default()
    }

    fn names(&self) -> Vec<String> {
        self.members().0
    }

    fn shunned_ms(&self, name: &str) -> u64 {
        let until = self.coordinator.state.workers[&WorkerId::from(name)].shunned.expect("shunned");
        until.0 - self.coordinator.now
    }
}

const ANY: WorkerRange = WorkerRange { min: 1, max: 8 };

/// Regression: the peer port of `w1` refused connections and `w2` joined; 3 s later the gang consisted of `w2` at step
/// 0.
#[test]
fn p20_a_joiner_that_cannot_reach_the_holder_is_the_one_that_leaves() {
    let mut gang = Gang::new(ANY, &["w1"]);
    gang.say("w1", Some(159), &[]);
    gang.join("w2");
    assert_eq!(gang.members(), (vec!["w1".into(), "w2".into()], 1));
    gang.pass(3_000);
    gang.say("w2", None, &["w1"]);
    assert_eq!(gang.members(), (vec!["w1".into()], 1), "it holds step 159");
}

/// Regression: both members complained of a slow link, and the run fell back to its checkpoint.
#[test]
fn p20_a_bad_link_between_two_holders_costs_no_step_however_often() {
    let mut gang = Gang::new(ANY, &["w1", "w2"]);
    for round in 0..6 {
        gang.say("w1", Some(136 + round), &["w2"]);
        gang.say("w2", Some(136 + round), &["w1"]);
        assert_eq!(gang.members(), (vec!["w1".into()], 1), "round {round}");
        let shunned = gang.shunned_ms("w2");
        assert_eq!(shunned, 6_000 << round, "each time for longer");
        while gang.names().len() == 1 {
            gang.pass(1_000);
            gang.say("w1", Some(136 + round), &[]);
            gang.say("w2", None, &[]);
        }
    }
}

/// Regression: one poll that named seven peers reduced a gang of eight to one member.
#[test]
fn p20_one_member_that_names_all_others_leaves_alone() {
    let names = ["w1", "w2", "w3", "w4", "w5", "w6", "w7", "w8"];
    for liar in [0, 3, 7] {
        let mut gang = Gang::new(ANY, &names);
        names.iter().for_each(|name| gang.say(name, Some(40), &[]));
        gang.pass(500);
        let others: Vec<&str> = names.iter().copied().filter(|name| *name != names[liar]).collect();
        gang.say(names[liar], Some(41), &others);
        assert_eq!(gang.names().len(), 8, "the others are asked first");
        gang.pass(500);
        others.iter().for_each(|name| gang.say(name, Some(40), &[]));
        assert_eq!(gang.members(), (others.iter().map(|name| (*name).to_owned()).collect(), 1));
    }
}

#[test]
fn a_member_that_several_miss_leaves_at_once_and_a_dead_lead_of_two_after_the_hearing() {
    let mut gang = Gang::new(ANY, &["w1", "w2", "w3"]);
    ["w1", "w2", "w3"].iter().for_each(|name| gang.say(name, Some(7), &[]));
    gang.pass(100);
    gang.say("w2", Some(7), &["w1"]);
    gang.say("w3", Some(7), &["w1"]);
    assert_eq!(gang.members(), (vec!["w2".into(), "w3".into()], 1));
    gang.pass(100);
    gang.say("w3", Some(8), &["w2"]);
    assert_eq!(gang.names(), ["w2", "w3"], "its lead may speak");
    gang.pass(Policy::default().hearing_ms);
    assert_eq!(gang.members(), (vec!["w3".into()], 1));
}

/// A silent holder does not count as gone until its lease expires.
#[test]
fn a_joiner_never_takes_the_place_of_a_silent_holder() {
    let mut gang = Gang::new(ANY, &["w1"]);
    gang.say("w1", Some(9), &[]);
    gang.join("w2");
    for _ in 0..10 {
        gang.pass(1_000);
        gang.say("w2", None, &["w1"]);
        assert!(gang.names().contains(&"w1".to_owned()), "{:?}", gang.members());
    }
    // Reports are lost in a restart. Until the next poll, the holder may or may not have the state.
    gang.coordinator.restart(false);
    gang.say("w1", Some(9), &[]);
    assert_eq!(gang.members().1, 1);
}

/// A removed member held the state before, but returns without it.
#[test]
fn a_member_that_comes_back_is_a_joiner_again() {
    let mut gang = Gang::new(ANY, &["w1", "w2"]);
    gang.say("w2", Some(7), &[]);
    gang.say("w1", Some(7), &["w2"]);
    assert_eq!(gang.names(), ["w1"]);
    while gang.names().len() == 1 {
        gang.pass(1_000);
        gang.say("w1", Some(7), &[]);
        gang.say("w2", None, &[]);
    }
    for _ in 0..5 {
        gang.pass(1_000);
        gang.say("w2", None, &["w1"]);
        assert!(gang.names().contains(&"w1".to_owned()), "{:?}", gang.members());
    }
}

#[test]
fn a_member_that_fails_leaves_its_gang_to_those_who_hold_the_state() {
    for class in [FailureClass::Infrastructure, FailureClass::Fault, FailureClass::Damaged] {
        let mut gang = Gang::new(ANY, &["w1", "w2"]);
        gang.say("w1", Some(7), &[]);
        gang.say("w2", Some(7), &[]);
        let lead = gang.coordinator.assignment("w1").expect("it leads");
        gang.coordinator.report(&lead, failed(class));
        assert_eq!(gang.members(), (vec!["w2".into()], 1), "{class:?}");
    }
    // A problem on the machine of a new member does not fail the run.
    for class in [FailureClass::Input, FailureClass::Storage] {
        let mut gang = Gang::new(ANY, &["w1"]);
        gang.say("w1", Some(7), &[]);
        gang.join("w2");
        let joiner = gang.coordinator.assignment("w2").expect("a member");
        gang.coordinator.report(&joiner, failed(class));
        assert_eq!(gang.members(), (vec!["w1".into()], 1), "{class:?}");
        let holder = gang.coordinator.assignment("w1").expect("it trains");
        gang.coordinator.report(&holder, failed(class));
        assert_eq!(gang.coordinator.run_state(&gang.run), RunState::Failed, "{class:?}");
    }
}

/// A gang that becomes too small saves its state before it is disbanded.
#[test]
fn a_gang_below_its_minimum_saves_first() {
    let mut gang = Gang::new(WorkerRange { min: 2, max: 8 }, &["w1", "w2"]);
    gang.say("w1", Some(7), &[]);
    gang.say("w2", Some(7), &[]);
    gang.coordinator.happen(coordinator::Event::WorkerGone { worker: "w1".into(), incarnation: None }).expect("taken");
    assert_eq!(gang.members(), (vec!["w2".into()], 1));
    let left = gang.coordinator.assignment("w2").expect("it saves");
    assert!(left.drain);
    gang.coordinator.report(&left, TaskOutcome::Yielded { at: 8 });
    assert_eq!(gang.names(), [""; 0]);
}

#[test]
fn a_suspicion_fades_and_a_complaint_alone_weighs_on_its_author() {
    let mut gang = Gang::new(ANY, &["w1", "w2", "w3"]);
    let suspicions = |gang: &Gang, name: &str| gang.coordinator.state.workers[&WorkerId::from(name)].suspicions;
    let quarrel = |gang: &mut Gang| {
        gang.say("w1", Some(5), &["w3"]);
        gang.say("w2", Some(5), &[]);
        gang.say("w3", Some(5), &[]);
        assert_eq!(gang.names(), ["w1", "w2"]);
    };
    let back = |gang: &mut Gang| {
        while gang.names().len() == 2 {
            gang.pass(1_000);
            gang.say("w1", Some(5), &[]);
            gang.say("w2", Some(5), &[]);
            gang.say("w3", None, &[]);
        }
    };
    quarrel(&mut gang);
    assert_eq!(["w1", "w2", "w3"].map(|name| suspicions(&gang, name)), [1, 0, 1]);
    back(&mut gang);
    quarrel(&mut gang);
    assert_eq!((gang.shunned_ms("w3"), suspicions(&gang, "w1")), (12_000, 2));
    back(&mut gang);
    for _ in 0..3 * Policy::default().fade_ms / 10_000 {
        gang.pass(10_000);
        ["w1", "w2", "w3"].iter().for_each(|name| gang.say(name, Some(5), &[]));
    }
    quarrel(&mut gang);
    assert_eq!((gang.shunned_ms("w3"), suspicions(&gang, "w1")), (6_000, 1));
}

impl Gang {
    /// Polls for a member whose process was asked to end.
    fn say_goodbye(&mut self, name: &str, holds: Option<u64>) {
        let doing = self.coordinator.assignment(name);
        let doing = doing.map(|assignment| Doing { holds, ..Doing::new(assignment.grant, Progress::default()) });
        let (incarnation, doing) = (self.processes[name], doing.into_iter().collect());
        let poll = Poll { incarnation, doing, ready: Vec::new(), version: 0, leaving: true };
        self.coordinator.hear(Observation::Poll { worker: name.into(), poll });
    }

    fn state_of(&self, name: &str) -> String {
        let views = self.coordinator.state.worker_views();
        views.into_iter().find(|view| view.worker == WorkerId::from(name)).expect("known").state
    }
}

/// The leader is asked to end. The gang goes on in the same attempt, and the worker gets nothing else.
#[test]
fn a_gang_goes_on_without_a_member_that_is_asked_to_end() {
    let mut gang = Gang::new(ANY, &["w1", "w2", "w3"]);
    ["w1", "w2", "w3"].iter().for_each(|name| gang.say(name, Some(7), &[]));
    gang.say_goodbye("w1", Some(7));
    assert_eq!(gang.members(), (vec!["w2".into(), "w3".into()], 1));
    assert_eq!(gang.state_of("w1"), "leaving");
    let assignment = gang.coordinator.assignment("w2").expect("it goes on");
    assert!(!assignment.drain, "nobody has to save");
    gang.say_goodbye("w1", None);
    gang.pass(1_000);
    assert_eq!(gang.names(), ["w2", "w3"]);
    gang.coordinator.happen(coordinator::Event::WorkerGone { worker: "w1".into(), incarnation: None }).expect("taken");
    assert_eq!(gang.state_of("w1"), "gone");
}

/// All members are asked to end: the last one keeps the task and saves.
#[test]
fn the_last_member_that_is_asked_to_end_keeps_the_task() {
    let mut gang = Gang::new(ANY, &["w1", "w2"]);
    ["w1", "w2"].iter().for_each(|name| gang.say(name, Some(7), &[]));
    gang.say_goodbye("w1", Some(7));
    gang.say_goodbye("w2", Some(7));
    assert_eq!(gang.members(), (vec!["w2".into()], 1));
    let yielded = TaskOutcome::Yielded { at: 7 };
    let assignment = gang.coordinator.assignment("w2").expect("it holds the task");
    gang.coordinator.report(&assignment, yielded);
    assert!(gang.names().is_empty(), "a worker that leaves gets no work");
    gang.join("w3");
    assert_eq!(gang.members(), (vec!["w3".into()], 2));
}

/// The others have no state, or are too few: the member keeps its task, saves and stops.
#[test]
fn a_member_without_which_the_gang_cannot_go_on_stays() {
    let mut gang = Gang::new(ANY, &["w1", "w2"]);
    gang.say("w1", Some(7), &[]);
    gang.say("w2", None, &[]);
    gang.say_goodbye("w1", Some(7));
    assert_eq!(gang.names(), ["w1", "w2"]);
    let mut pair = Gang::new(WorkerRange { min: 2, max: 8 }, &["w1", "w2"]);
    ["w1", "w2"].iter().for_each(|name| pair.say(name, Some(7), &[]));
    pair.say_goodbye("w1", Some(7));
    assert_eq!(pair.names(), ["w1", "w2"]);
}

/// A shunned worker may work alone, and must report its fetched inputs again.
#[test]
fn a_shunned_worker_begins_alone_what_nobody_else_does() {
    let mut gang = Gang::new(ANY, &["w1", "w2"]);
    for _ in 0..8 {
        gang.say("w1", Some(5), &["w2"]);
        gang.say("w2", Some(5), &["w1"]);
        let Presence::Suspect { .. } = gang.coordinator.state.workers[&WorkerId::from("w2")].presence else {
            panic!("it stays")
        };
        assert!(gang.coordinator.state.workers[&WorkerId::from("w2")].ready.is_empty());
        let until = gang.shunned_ms("w2");
        if until > 200_000 {
            break;
        }
        while gang.names().len() == 1 {
            gang.pass(1_000);
            gang.say("w1", Some(5), &[]);
            gang.say("w2", None, &[]);
        }
    }
    gang.pass(4_000);
    gang.say("w1", Some(5), &[]);
    gang.say("w2", None, &[]);
    assert_eq!(gang.names(), ["w1"]);
    gang.coordinator.happen(coordinator::Event::WorkerGone { worker: "w1".into(), incarnation: None }).expect("taken");
    gang.pass(1_000);
    gang.say("w2", None, &[]);
    assert_eq!(gang.members(), (vec!["w2".into()], 2));
}

#[test]
fn a_slow_member_stays_where_there_would_be_too_few_without_it() {
    for (min, left) in [(1, vec!["w1"]), (2, vec!["w1", "w2"])] {
        let mut gang = Gang::new(WorkerRange { min, max: 8 }, &["w1", "w2"]);
        gang.say("w1", Some(5), &[]);
        gang.say_for("w2", Some(5), &["w1"], LossCause::Slow);
        gang.say_for("w1", Some(5), &["w2"], LossCause::Slow);
        assert_eq!(gang.names().len(), 2, "there is time");
        gang.pass(Policy::default().hearing_ms);
        assert_eq!(gang.names(), left);
        if min == 1 {
            assert_eq!(gang.shunned_ms("w2"), Policy::default().shun_slow_ms);
        }
    }
}

/// A lead on a slow processor: the other member would be faster alone, but the lead would not.
#[test]
fn a_member_that_is_called_slow_and_does_not_say_so_leaves() {
    let mut gang = Gang::new(ANY, &["w1", "w2"]);
    gang.say("w1", Some(5), &[]);
    gang.say_for("w2", Some(5), &["w1"], LossCause::Slow);
    gang.say("w1", Some(5), &[]);
    gang.pass(Policy::default().hearing_ms);
    assert_eq!(gang.members(), (vec!["w2".into()], 1));
}

/// Members of different builds, for example: the gang keeps its state and does not admit the member again for long.
#[test]
fn a_member_that_disagrees_is_left_out_for_long_and_costs_no_step() {
    let mut gang = Gang::new(ANY, &["w1"]);
    gang.say("w1", Some(5), &[]);
    gang.join("w2");
    for round in 0..3 {
        gang.say_for("w1", Some(5), &["w2"], LossCause::Disagrees);
        gang.say_for("w2", None, &["w1"], LossCause::Disagrees);
        assert_eq!(gang.members(), (vec!["w1".into()], 1), "round {round}");
        let mut waited = 0;
        while gang.names().len() == 1 {
            waited += 10;
            gang.pass(10_000);
            gang.say("w1", Some(5), &[]);
            gang.say("w2", None, &[]);
        }
        assert!(waited >= 3_600, "tried again after {waited} s");
    }
}

/// A member that polls while its stage hangs blocks the others. It stays if it is the only holder of the state.
#[test]
fn a_lead_that_polls_and_does_nothing_is_left_after_a_while() {
    for other in [Some(9), None] {
        let mut gang = Gang::new(ANY, &["w1", "w2"]);
        let poll = |gang: &mut Gang, name: &str, holds: Option<u64>, waits_for: Option<WorkerId>| {
            let grant = gang.coordinator.assignment(name).expect("a member").grant;
            let doing = vec![Doing { holds, waits_for, ..Doing::new(grant, Progress::default()) }];
            let poll = Poll { incarnation: gang.processes[name], doing, ready: Vec::new(), version: 0, leaving: false };
            gang.coordinator.hear(Observation::Poll { worker: name.into(), poll });
        };
        for second in 0..Policy::default().stall_ms / 5_000 {
            assert_eq!(gang.names().len(), 2, "after {} s", second * 5);
            poll(&mut gang, "w1", Some(9), None);
            poll(&mut gang, "w2", other, Some("w1".into()));
            gang.pass(5_000);
        }
        assert_eq!(gang.names().contains(&"w1".to_owned()), other.is_none(), "{:?}", gang.members());
    }
}
