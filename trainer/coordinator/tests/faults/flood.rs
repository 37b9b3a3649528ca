//! Overload: calls that exceed a queue are refused temporarily, heartbeats are not delayed, and accepted calls are
//! completed.

use std::time::{Duration, Instant};

use access::Server;
use coordinator::Handle;
use fail::FailScenario;
use protocol::limits;
use protocol::message::{DesiredAssignments, Join, Joined, MetricBatch, MetricRow, Poll};
use protocol::proof::SECRET_HEADER;
use reqwest::{Method, StatusCode};
use tokio::task::JoinSet;

use crate::shell::{SECRET, TestResult, offer, start, submission};

/// A client of a coordinator.
struct Caller {
    handle: Handle,
    server: Server,
    /// The secret that its calls show.
    secret: String,
}

impl Caller {
    async fn start(dir: &std::path::Path) -> TestResult<Self> {
        let (handle, server) = start(dir, 1).await?;
        Ok(Self { handle, server, secret: SECRET.to_owned() })
    }

    fn post(&self, path: &str, body: &impl serde::Serialize) -> reqwest::RequestBuilder {
        self.server.request(Method::POST, path).header(SECRET_HEADER, &self.secret).json(body)
    }

    /// Sends 40 calls more than the `wait` that fit into the queue, while the server is paused at `point`. Resumes the
    /// server after the excess calls are refused.
    async fn flood(&self, path: &str, body: &impl serde::Serialize, wait: usize, point: &str) -> TestResult {
        const TOO_MANY: usize = 40;
        let mut calls = JoinSet::new();
        for _ in 0..wait + TOO_MANY {
            calls.spawn(self.post(path, body).send());
        }
        for told in 0..TOO_MANY {
            let answer = tokio::time::timeout(Duration::from_secs(60), calls.join_next()).await;
            let answer =
                answer.map_err(|_| format!("only {told} were told to come again"))?.ok_or("a call each")???;
            assert_eq!(answer.status(), StatusCode::TOO_MANY_REQUESTS);
            assert_eq!(answer.headers()["retry-after"], limits::COME_AGAIN_S.to_string());
            assert!(answer.text().await?.contains("already"));
        }
        fail::remove(point);
        while let Some(answer) = calls.join_next().await {
            let status = answer??.status();
            assert!(status != StatusCode::TOO_MANY_REQUESTS && !status.is_server_error(), "{status}");
        }
        Ok(())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_flood_of_submissions_fills_a_short_queue_and_delays_no_heartbeat() -> TestResult {
    let scenario = FailScenario::setup();
    let dir = tempfile::tempdir()?;
    let caller = Caller::start(dir.path()).await?;
    let join = offer();
    let joined: Joined = caller.post("/v1/workers", &join).send().await?.json().await?;
    let submit = submission()?;

    fail::cfg("actor::decide", "pause")?;
    let beats = async {
        let poll =
            Poll { incarnation: joined.incarnation, doing: Vec::new(), ready: Vec::new(), version: 0, leaving: false };
        for _ in 0..20 {
            let begun = Instant::now();
            let status = caller.post("/v1/workers/a/poll", &poll).send().await?.status();
            assert!(status.is_success() && begun.elapsed() < Duration::from_secs(2), "{status} {:?}", begun.elapsed());
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        TestResult::Ok(())
    };
    let flood = caller.flood("/v1/runs", &submit, limits::CLIENTS_WAITING, "actor::decide");
    let (flood, beats) = tokio::join!(flood, beats);
    beats?;
    flood?;
    // Workers do not use the clients' queue.
    assert!(caller.post("/v1/workers", &Join { worker: "b".into(), ..join }).send().await?.status().is_success());
    caller.handle.shutdown().await;
    scenario.teardown();
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_flood_of_values_is_told_to_come_again() -> TestResult {
    let scenario = FailScenario::setup();
    let dir = tempfile::tempdir()?;
    let mut caller = Caller::start(dir.path()).await?;
    caller.handle.submit(submission()?).await?;
    let joined: Joined = caller.post("/v1/workers", &offer()).send().await?.json().await?;
    let poll =
        Poll { incarnation: joined.incarnation, doing: Vec::new(), ready: Vec::new(), version: 0, leaving: false };
    let assignment = loop {
        let desired: DesiredAssignments = caller.post("/v1/workers/a/poll", &poll).send().await?.json().await?;
        if let Some(assignment) = desired.assignments.into_iter().next() {
            break assignment;
        }
    };
    caller.secret = assignment.secret;
    let grant = assignment.grant;
    let batch = MetricBatch { grant, rows: vec![MetricRow { step: 1, key: "loss".into(), value: 1.0 }] };
    fail::cfg("db::before_commit", "pause")?;
    caller.flood("/v1/metrics", &batch, limits::BATCHES_WAITING, "db::before_commit").await?;
    caller.handle.shutdown().await;
    scenario.teardown();
    Ok(())
}
