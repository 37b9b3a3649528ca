//! Labels of workers, and the demand that launchers follow.

use coordinator::{Event, Policy};
use protocol::demand::DemandGroup;
use protocol::message::{StageState, TaskOutcome};
use protocol::stage::{Backend, WorkerRange};
use protocol::{Digest, Labels, Owner};

use crate::common::{PureCoordinator, pipelines};

/// A run whose stages from `vae` on require a GPU.
fn submit(coordinator: &mut PureCoordinator, workers: WorkerRange, until: &str) {
    let mut pipeline = pipelines::quickstart(1, workers, &[]);
    for stage in pipeline.stages.iter_mut().filter(|stage| stage.name.as_str() == "vae") {
        stage.placement.requires = "gpu=h100".parse().expect("a label");
    }
    let event = Event::Submit {
        submission: None,
        pipeline: Box::new(pipeline),
        source: String::new(),
        idempotency_key: None,
        until: Some(until.into()),
        owner: Owner::local("me"),
    };
    coordinator.happen(event).expect("submitted");
}

fn groups(coordinator: &PureCoordinator) -> Vec<DemandGroup> {
    coordinator.state.demand(coordinator::Millis(coordinator.now)).groups
}

fn group(requires: &str, ready: u64, wanted: u64, idle: u64, oldest_wait_ms: u64) -> DemandGroup {
    let requires: Labels = requires.parse().expect("labels");
    DemandGroup { backend: Backend::Flex, requires, instruction_set: None, ready, wanted, idle, oldest_wait_ms }
}

fn finish(coordinator: &mut PureCoordinator, worker: &str) {
    let held = coordinator.assignment(worker).expect("it holds a task");
    let output = Digest::of(held.grant.task.as_str().as_bytes());
    coordinator.report(&held, TaskOutcome::Finished { output, metrics: Default::default() });
}

#[test]
fn work_goes_to_workers_with_its_labels_and_demand_counts_the_others() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    assert!(groups(&coordinator).is_empty());
    submit(&mut coordinator, WorkerRange { min: 1, max: 3 }, "vae");
    coordinator.now += 500;
    assert_eq!(groups(&coordinator), [group("", 1, 1, 0, 500)], "the dataset, which the training waits for");

    coordinator.join("a");
    let bound = |group: DemandGroup| DemandGroup { instruction_set: Some("avx2".into()), ..group };
    assert_eq!(groups(&coordinator), [bound(group("", 0, 1, 0, 0))], "one worker is at work");
    finish(&mut coordinator, "a");
    coordinator.now += 2_000;
    assert_eq!(groups(&coordinator), [group("gpu=h100", 3, 3, 0, 2_000)], "a worker without the label does not fit");
    assert!(coordinator.assignment("a").is_none());
    let run = coordinator.state.runs.values().next().expect("a run");
    let view = coordinator.state.view(run, coordinator::Millis(coordinator.now));
    let vae = view.stages.iter().find(|stage| stage.name.as_str() == "vae").expect("the stage");
    assert_eq!(vae.state, StageState::Ready);
    assert_eq!(vae.message.as_deref(), Some("waits for 1 idle `flex` worker labelled `gpu=h100`"));

    coordinator.join_labelled("b", "avx2", "gpu=h100,zone=x");
    assert!(coordinator.assignment("b").is_some());
    assert_eq!(groups(&coordinator), [bound(group("gpu=h100", 2, 3, 0, 0))]);
}

#[test]
fn demand_names_idle_workers_and_its_version_ignores_time() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.join_labelled("b", "avx2", "gpu=h100");
    let demand = |coordinator: &PureCoordinator| coordinator.state.demand(coordinator::Millis(coordinator.now));
    let before = demand(&coordinator);
    assert_eq!(before.workers.iter().map(|one| (one.worker.as_str(), one.idle)).collect::<Vec<_>>(), [("b", true)]);
    submit(&mut coordinator, WorkerRange { min: 1, max: 1 }, "dataset");
    let after = demand(&coordinator);
    assert!(!after.workers[0].idle, "a worker may have labels that no stage requires");
    assert_ne!(before.version, after.version);
    coordinator.now += 1_000;
    assert_eq!(demand(&coordinator).version, after.version);
}

#[test]
fn a_worker_with_malformed_labels_is_refused() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    let by = coordinator::state::worker::Identity { caller: "t".into(), secret: Digest::of(b"a") };
    let labels: Labels = ["gpu; rm".to_owned()].into_iter().collect();
    let join = protocol::message::Join {
        protocol: protocol::message::PROTOCOL_VERSION,
        worker: "a".into(),
        pid: 1,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "a:1".into(),
        labels,
    };
    let refused = coordinator.happen(Event::Join { join, by }).expect_err("refused");
    assert!(refused.to_string().contains("KEY=VALUE"), "{refused}");
}
