//! Grants belong to their own process.

use std::collections::{BTreeMap, BTreeSet};

use protocol::message::{
    CommitCheckpoint, Doing, FailureClass, Grant, LogBatch, LossCause, LostPeer, MetricBatch, Poll, Progress,
    ReportOutcome, StageState, TaskOutcome,
};
use protocol::{ArtifactKind, Attempt, Fence};

use super::bystanders::{Site, Worker, answer, code, post};

/// Prevents a known attack: answers to wrong fences revealed the right one, and a foreign manifest became another
/// stage's value.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_worker_writes_in_anothers_name_and_no_refusal_helps_it() {
    let site = Site::start(60_000).await;
    let run = site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let held = worker.given("dataset").await;
    let own_run = site.submit(2).await;
    let thief = Worker::join(&site, "nodes", "nodes-2").await;
    let own = thief.given("dataset").await;
    assert_eq!(own.stage.run, own_run);
    let (foreign, receipts) = thief.artifact(&own, ArtifactKind::Dataset, b"other clips").await;

    let mut said = BTreeSet::new();
    let before = site.view(&run).await;
    for fence in 0..=2 * held.grant.fence.0.max(own.grant.fence.0) {
        for worker_name in [&worker, &thief] {
            let grant = Grant {
                fence: Fence(fence),
                worker: worker_name.process.worker.clone(),
                incarnation: worker_name.process.incarnation,
                ..held.grant.clone()
            };
            let finished = TaskOutcome::Finished { output: foreign, metrics: BTreeMap::new() };
            let failed = TaskOutcome::Failed { class: FailureClass::Input, message: "forged".into() };
            for secret in [&own.secret, &thief.secret, &"0".repeat(64), &String::new()] {
                for outcome in [finished.clone(), TaskOutcome::Yielded { at: 1 }, failed.clone()] {
                    let report = ReportOutcome::new(grant.clone(), outcome);
                    let report = protocol::proof::Vouched { what: report, receipts: receipts.clone() };
                    said.insert(post(&thief.server, secret, "/v1/outcomes", &report).await.1.to_string());
                }
                let (step, manifest, metrics) = (1, foreign, BTreeMap::new());
                let commit = CommitCheckpoint { grant: grant.clone(), step, manifest, metrics };
                said.insert(post(&thief.server, secret, "/v1/checkpoints", &commit).await.1.to_string());
                let metrics = MetricBatch { grant: grant.clone(), rows: vec![] };
                said.insert(post(&thief.server, secret, "/v1/metrics", &metrics).await.1.to_string());
                let logs = LogBatch { grant: grant.clone(), first: 0, lines: vec!["forged".into()] };
                said.insert(post(&thief.server, secret, "/v1/logs", &logs).await.1.to_string());
                said.insert(answer(thief.put_request(&grant, secret, b"forged")).await.1.to_string());
            }
        }
    }
    // All refusals are identical: they depend neither on the attempted call nor on the task or its fence.
    assert_eq!(said.len(), 1, "{said:#?}");
    assert!(said.first().unwrap().contains("unproven"), "{said:#?}");
    assert_eq!(before, site.view(&run).await);

    let (output, receipts) = worker.artifact(&held, ArtifactKind::Dataset, b"clips").await;
    assert_eq!(worker.finish(&held, output, receipts).await.0, 200, "its own report counts");
    let view = site.handle.run_view(&run).await.unwrap();
    assert_eq!(view.stages[0].state, StageState::Ran);
    assert!(view.stages[0].outputs.values().all(|value| *value == output), "{view:?}");
    site.handle.shutdown().await;
}

/// An unheld task, one that never existed and another worker's give the same answer.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refusal_does_not_tell_whether_there_is_such_a_task() {
    let site = Site::start(60_000).await;
    site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let held = worker.given("dataset").await;
    let thief = Worker::join(&site, "lab", "lab-1").await;
    let none = Grant { task: "p-none-9/dataset".into(), ..held.grant.clone() };
    let stale = Grant { attempt: Attempt(0), fence: Fence(0), ..held.grant.clone() };
    let mut said = BTreeSet::new();
    for grant in [held.grant, none, stale] {
        let report = ReportOutcome::new(grant, TaskOutcome::Yielded { at: 0 });
        said.insert(format!("{:?}", post(&thief.server, &thief.secret, "/v1/outcomes", &report).await));
    }
    assert_eq!(said.len(), 1, "{said:?}");
    site.handle.shutdown().await;
}

/// A poll may report only on its own process's grants, so it cannot accuse a gang member in another worker's name.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_poll_says_nothing_about_anothers_grant() {
    let site = Site::start(60_000).await;
    let run = site.submit(1).await;
    let worker = Worker::join(&site, "nodes", "nodes-1").await;
    let data = worker.given("dataset").await;
    let (output, receipts) = worker.artifact(&data, ArtifactKind::Dataset, b"clips").await;
    assert_eq!(worker.finish(&data, output, receipts).await.0, 200);
    let held = worker.given("vae").await;
    let thief = Worker::join(&site, "nodes", "nodes-2").await;
    let progress = Progress { done: 77, total: 77, unit: "forged".into(), ..Progress::default() };
    let lost = vec![LostPeer { worker: "nodes-1".into(), cause: LossCause::Unreachable }];
    let doing = Doing { lost, ..Doing::new(held.grant.clone(), progress) };
    let poll = Poll { doing: vec![doing], ..thief.poll_of(vec![], 0) };
    let polled = post(&thief.server, &thief.secret, &thief.poll_path(), &poll).await;
    assert_eq!(polled.0, 200, "{polled:?}");
    let view = site.handle.run_view(&run).await.unwrap();
    assert_eq!(view.stages[1].progress.done, 0, "{view:?}");
    let states: Vec<String> = site.handle.workers().into_iter().map(|view| view.state).collect();
    assert_eq!(states, ["working", "idle"]);

    // Another process cannot poll in its name either.
    for (server, secret) in [(&thief.server, &thief.secret), (&site.server("lab"), &worker.secret)] {
        let refused = post(server, secret, &worker.poll_path(), &worker.poll_of(vec![], 0)).await;
        assert_eq!(code(&refused), (403, "unproven"), "{refused:?}");
    }
    site.handle.shutdown().await;
}
