//! Thousands of random calls with valid worker tokens do not change the task of another worker.

use std::collections::BTreeMap;

use protocol::message::{
    CommitCheckpoint, Doing, FailureClass, Gone, Grant, LogBatch, LossCause, LostPeer, MetricBatch, MetricRow, Poll,
    Progress, ReportOutcome, RunState, StageState, TaskOutcome,
};
use protocol::proof::{GRANT_HEADER, PROCESS_HEADER, Process, SECRET_HEADER, Vouched};
use protocol::{ArtifactKind, Attempt, Digest, Fence, Incarnation, RunId};
use reqwest::{Method, RequestBuilder};
use serde_json::Value;

use crate::front::Protocol;

use super::bystanders::{Site, Worker, answer, join_of};

const CALLS: u64 = 4000;
/// Text in the uploads of the other worker that no answer may contain.
const CANARY: &str = "canary-of-another-worker";

/// A seeded random generator.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        // Source: the SplitMix64 algorithm.
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        usize::try_from((z ^ (z >> 31)) % n as u64).unwrap()
    }

    fn one_of<'a, T>(&mut self, all: &'a [T]) -> &'a T {
        let i = self.below(all.len());
        &all[i]
    }
}

/// Values from which random calls are built.
struct Known {
    grants: Vec<Grant>,
    secrets: Vec<String>,
    digests: Vec<Digest>,
    receipts: BTreeMap<Digest, String>,
    names: Vec<String>,
}

impl Known {
    fn grant(&self, random: &mut Random) -> Grant {
        let mut grant = random.one_of(&self.grants).clone();
        if random.below(2) == 0 {
            grant.task = random.one_of(&self.grants).task.clone();
        }
        if random.below(2) == 0 {
            grant.fence = Fence(random.below(12) as u64);
        }
        if random.below(3) == 0 {
            grant.attempt = Attempt(random.below(4) as u64);
        }
        if random.below(2) == 0 {
            let other = random.one_of(&self.grants);
            (grant.worker, grant.incarnation) = (other.worker.clone(), other.incarnation);
        }
        if random.below(4) == 0 {
            grant.incarnation = Incarnation(random.below(6) as u64);
        }
        grant
    }

    fn outcome(&self, random: &mut Random) -> TaskOutcome {
        let classes = [FailureClass::Input, FailureClass::Fault, FailureClass::Damaged, FailureClass::Infrastructure];
        match random.below(3) {
            0 => TaskOutcome::Finished { output: *random.one_of(&self.digests), metrics: BTreeMap::new() },
            1 => TaskOutcome::Yielded { at: random.below(9) as u64 },
            _ => TaskOutcome::Failed { class: *random.one_of(&classes), message: "fuzz".into() },
        }
    }

    fn call(&self, server: &access::Server, random: &mut Random) -> RequestBuilder {
        let grant = self.grant(random);
        let secret = random.one_of(&self.secrets).clone();
        let digest = *random.one_of(&self.digests);
        let name = random.one_of(&self.names).clone();
        let incarnation = Incarnation(random.below(6) as u64);
        let post = |path: &str| server.request(Method::POST, path).header(SECRET_HEADER, &secret);
        let header = serde_json::to_string(&grant).unwrap();
        match random.below(11) {
            0 => post("/v1/workers").json(&join_of(&name)),
            1 => {
                let progress = Progress { done: 99, total: 99, unit: "fuzz".into(), ..Progress::default() };
                let worker = random.one_of(&self.names).as_str().into();
                let lost = vec![LostPeer { worker, cause: LossCause::Unreachable }];
                let doing = vec![Doing { lost, ..Doing::new(grant, progress) }];
                let poll = Poll { incarnation, doing, ready: vec![], version: 0, leaving: false };
                post(&format!("/v1/workers/{name}/poll")).json(&poll)
            }
            2 => post(&format!("/v1/workers/{name}/gone")).json(&Gone { incarnation }),
            3 => {
                let rows = vec![MetricRow { step: 1, key: "fuzz".into(), value: 0.0 }];
                post("/v1/metrics").json(&MetricBatch { grant, rows })
            }
            4 => post("/v1/logs").json(&LogBatch { grant, first: 0, lines: vec!["fuzz".into()] }),
            5 => {
                let commit = CommitCheckpoint { grant, step: 3, manifest: digest, metrics: BTreeMap::new() };
                post("/v1/checkpoints").json(&Vouched { what: commit, receipts: self.receipts.clone() })
            }
            6 => {
                let outcome = self.outcome(random);
                let report = ReportOutcome::new(grant, outcome);
                post("/v1/outcomes").json(&Vouched { what: report, receipts: self.receipts.clone() })
            }
            7 => {
                let request = server.request(Method::PUT, &format!("/v1/blobs/{}", Digest::of(b"fuzz")));
                request.header(GRANT_HEADER, header).header(SECRET_HEADER, secret).body("fuzz")
            }
            8 => {
                let request = server.request(Method::GET, &format!("/v1/blobs/{digest}/staged"));
                request.header(GRANT_HEADER, header).header(SECRET_HEADER, secret)
            }
            9 => {
                let request = server.request(Method::POST, &format!("/v1/blobs/{digest}/sent"));
                request.header(GRANT_HEADER, header).header(SECRET_HEADER, secret)
            }
            _ => {
                let process = Process { worker: name.as_str().into(), incarnation };
                let request = server.request(Method::GET, &format!("/v1/blobs/{digest}"));
                let request = request.header(PROCESS_HEADER, serde_json::to_string(&process).unwrap());
                request.header(SECRET_HEADER, secret)
            }
        }
    }
}

async fn all_of(site: &Site, run: &RunId) -> Value {
    let reader = site.server("reader");
    let mut all = vec![serde_json::to_value(site.view(run).await).unwrap()];
    for path in [format!("/v1/runs/{run}/logs"), format!("/v1/runs/{run}/metrics")] {
        all.push(answer(reader.request(Method::GET, &path)).await.1);
    }
    Value::from(all)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn random_calls_of_workers_change_nothing_of_anothers_task() {
    try_calls(Protocol::Http1).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn random_calls_of_workers_over_http2_change_nothing_of_anothers_task() {
    try_calls(Protocol::Http2).await;
}

async fn try_calls(protocol: Protocol) {
    let site = Site::over(protocol, 600_000).await;
    let run = site.submit(1).await;
    let victim = Worker::join(&site, "nodes", "nodes-1").await;
    let data = victim.given("dataset").await;
    let (dataset, receipts) = victim.artifact(&data, ArtifactKind::Dataset, CANARY.as_bytes()).await;
    assert_eq!(victim.finish(&data, dataset, receipts.clone()).await.0, 200);
    let held = victim.given("vae").await;

    site.submit(2).await;
    let same_token = Worker::join(&site, "nodes", "nodes-2").await;
    let own = same_token.given("dataset").await;
    let other_token = Worker::join(&site, "lab", "lab-1").await;
    let known = Known {
        grants: vec![held.grant.clone(), data.grant.clone(), own.grant.clone()],
        // All secrets except the victim's, which stay hidden from others.
        secrets: vec![
            own.secret.clone(),
            same_token.secret.clone(),
            other_token.secret.clone(),
            "0".repeat(64),
            String::new(),
        ],
        digests: vec![dataset, Digest::of(CANARY.as_bytes()), Digest::of(b"fuzz"), Digest::of(b"none")],
        receipts,
        names: ["nodes-1", "nodes-2", "lab-1", "nodes-3", "lab-2"].map(str::to_owned).into(),
    };
    let before = all_of(&site, &run).await;
    let mut random = Random(25);
    let mut counts = BTreeMap::<u16, u64>::new();
    for _ in 0..CALLS {
        let server = if random.below(2) == 0 { &same_token.server } else { &other_token.server };
        let (status, answer) = answer(known.call(server, &mut random)).await;
        assert!(status < 500, "{status} {answer}");
        assert!(!answer.to_string().contains(CANARY), "{answer}");
        *counts.entry(status).or_default() += 1;
    }
    println!("{CALLS} random calls: {counts:?}");
    assert!(counts[&403] > CALLS / 2 && counts.get(&200).is_some_and(|calls| *calls > 20), "{counts:?}");
    assert_eq!(before, all_of(&site, &run).await);
    assert_eq!(victim.holds().await, std::slice::from_ref(&held), "the victim holds what it held");

    let (output, receipts) = victim.artifact(&held, ArtifactKind::Vae, b"weights").await;
    assert_eq!(victim.finish(&held, output, receipts).await.0, 200);
    let view = site.handle.run_view(&run).await.unwrap();
    assert_eq!((view.state, view.stages[1].state), (RunState::Finished, StageState::Ran));
    assert!(view.stages[1].outputs.values().all(|value| *value == output), "{view:?}");
    site.handle.shutdown().await;
}
