//! History: each change of a decision is recorded, with its reason.

use coordinator::{Control, Event, Policy};
use protocol::Digest;
use protocol::message::{CommitCheckpoint, FailureClass, TaskOutcome};
use protocol::stage::WorkerRange;
use registry::HistoryKind::{self, *};

use crate::common::{PureCoordinator, failed, gang_of_three};

/// Events since the last call: kind, worker, reason.
fn news(coordinator: &mut PureCoordinator) -> Vec<(HistoryKind, String, String)> {
    let entries = std::mem::take(&mut coordinator.store.history);
    let worker = |worker: Option<protocol::WorkerId>| worker.map_or_else(String::new, |worker| worker.to_string());
    entries.into_iter().map(|it| (it.kind, worker(it.worker), it.why.unwrap_or_default())).collect()
}

fn told(kind: HistoryKind, worker: &str, why: &str) -> (HistoryKind, String, String) {
    (kind, worker.to_owned(), why.to_owned())
}

#[test]
fn a_gang_that_grows_and_loses_a_worker_is_told_member_by_member() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let (run, _) = gang_of_three(&mut coordinator);
    let began = news(&mut coordinator);
    assert_eq!(began[..3], [told(Submitted, "", ""), told(Joined, "a", ""), told(Granted, "a", "")]);
    assert!(began.contains(&told(Finished, "", "")), "{began:?}");
    assert!(began.iter().filter(|it| it.0 == Joined).count() == 3, "{began:?}");

    let grant = coordinator.assignment("a").expect("it trains").grant;
    let commit = CommitCheckpoint { grant, step: 7, manifest: Digest::of(b"saved"), metrics: Default::default() };
    coordinator.happen(Event::Checkpoint { commit }).expect("saved");
    let saved = &coordinator.store.history[0];
    assert_eq!((saved.kind, saved.step, saved.run.as_ref()), (Checkpoint, Some(7), Some(&run)));
    assert_eq!(saved.stage.as_ref().map(|stage| stage.as_str()), Some("vae"));
    news(&mut coordinator);

    coordinator.happen(Event::WorkerGone { worker: "a".into(), incarnation: None }).expect("taken");
    assert_eq!(news(&mut coordinator)[0], told(Left, "a", ""));
}

#[test]
fn a_failed_attempt_says_why_and_the_last_one_ends_the_run() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let run = coordinator.submit("vae", WorkerRange { min: 1, max: 1 });
    coordinator.join("a");
    let dataset = coordinator.assignment("a").expect("the only worker gets it");
    news(&mut coordinator);
    coordinator.report(&dataset, failed(FailureClass::Infrastructure));
    assert_eq!(news(&mut coordinator), [told(Retried, "a", "made up")]);
    // Past the back-off, and within the worker's lease.
    coordinator.now += 10_000;
    coordinator.control(&run, Control::Pause).expect("paused");
    coordinator.control(&run, Control::Resume).expect("resumed");
    let kinds: Vec<HistoryKind> = news(&mut coordinator).into_iter().map(|it| it.0).collect();
    assert_eq!(kinds[..2], [Paused, Resumed]);
    coordinator.tick();
    let incarnation = coordinator.state.workers[&"a".into()].incarnation;
    coordinator.poll("a", incarnation);
    coordinator.tick();
    let again = coordinator.assignment("a").expect("it is tried again");
    news(&mut coordinator);
    coordinator.report(&again, failed(FailureClass::Input));
    assert_eq!(news(&mut coordinator), [told(Failed, "", "made up"), told(Ended, "", "failed")]);
}

#[test]
fn a_worker_that_falls_silent_is_lost_and_its_task_is_tried_again() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.submit("vae", WorkerRange { min: 1, max: 1 });
    let incarnation = coordinator.join("a");
    let dataset = coordinator.assignment("a").expect("the only worker gets it");
    news(&mut coordinator);
    coordinator.happen(Event::LeaseExpired { worker: "a".into(), incarnation }).expect("taken");
    let lost = "it was silent until its lease expired";
    assert_eq!(news(&mut coordinator), [told(Lost, "a", lost), told(Retried, "a", "lost worker a")]);
    coordinator.happen(Event::WorkerBack { worker: "a".into() }).expect("taken");
    assert_eq!(news(&mut coordinator)[0], told(Returned, "a", ""));
    let late = TaskOutcome::Finished { output: Digest::of(b"clips"), metrics: Default::default() };
    let report = protocol::message::ReportOutcome::new(dataset.grant, late);
    assert!(coordinator.happen(Event::Outcome { report }).is_err());
    assert_eq!(news(&mut coordinator), []);
}
