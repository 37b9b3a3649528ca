//! Blobs in a bucket that takes 30 ms per request, or never answers. Only calls that need the bucket wait.

#[path = "common/shell.rs"]
#[allow(dead_code, reason = "not every test that shares this file starts it so")]
mod shell;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use access::Server;
use coordinator::{Config, Coordinator, Handle};
use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::message::{
    Assignment, DesiredAssignments, Join, Joined, Poll, ReportOutcome, RunView, Submit, TaskOutcome,
};
use protocol::proof::{BlobStored, GRANT_HEADER, SECRET_HEADER, Vouched};
use protocol::stage::{Backend, DataSynthetic, EncodeLatents, Placement, StageSettings, TrainVae, WorkerRange};
use protocol::{ArtifactKind, Digest, FileEntry, Incarnation, Manifest, RunId, Seed, TaskId};
use registry::testing::slow::SlowBucket;
use registry::{Holder, LeaseTerms, Store};
use reqwest::{Method, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::task::JoinSet;

use self::shell::{SECRET, TestResult, offer};

fn pipeline(shards: usize) -> Pipeline {
    let stage = |name: &str, settings: StageSettings| {
        let inputs = settings.inputs().into_iter();
        let inputs =
            inputs.map(|(field, stage, kind)| StageInput { field, stage: stage.as_str().into(), kind }).collect();
        PipelineStage {
            name: name.into(),
            settings,
            placement: Placement { workers: WorkerRange { min: 1, max: 1 }, ..Placement::default() },
            inputs,
            external: BTreeMap::new(),
            sweep: None,
            derived: None,
            copy_of: None,
        }
    };
    Pipeline {
        name: "slow".into(),
        seed: Seed(1),
        backend: Backend::Flex,
        priority: 0,
        stages: vec![
            stage("dataset", StageSettings::DataSynthetic(DataSynthetic::default())),
            stage("vae", StageSettings::TrainVae(TrainVae::default())),
            stage("latents", StageSettings::EncodeLatents(EncodeLatents { shards, ..Default::default() })),
        ],
        code_versions: BTreeMap::new(),
    }
}

/// A bucket that answers again once a test is over. The threads that wait for it would keep a failing test from ending.
struct Answering(SlowBucket);

impl Drop for Answering {
    fn drop(&mut self) {
        self.0.silence(false);
    }
}

/// A coordinator with a slow bucket.
struct Slow {
    handle: Handle,
    server: Arc<Server>,
    bucket: SlowBucket,
}

impl Slow {
    async fn start(dir: &Path) -> TestResult<Self> {
        let bucket = SlowBucket::default();
        let blobs = bucket.place("p", dir);
        let store = Store::open_over(dir, blobs, Holder::this_process("a test"), LeaseTerms::default()).await?;
        let mut config = Config { alone: false, park: false, ..Config::embedded() };
        config.policy.poll_ms = 1;
        let handle = Coordinator::start(store, config).await?;
        let server = Arc::new(Server::new(&handle.url(), Some(handle.token().clone()), None)?);
        Ok(Self { handle, server, bucket })
    }

    async fn submit(&self, shards: usize) -> TestResult<RunId> {
        let pipeline = serde_json::to_value(pipeline(shards))?;
        let submit = Submit { pipeline, source: String::new(), idempotency_key: None, until: None };
        Ok(self.handle.submit(submit).await?)
    }

    async fn worker(&self, name: &str) -> TestResult<Worker> {
        Worker::join(Arc::clone(&self.server), name, Backend::Flex).await
    }

    /// Joins a worker whose backend no run uses.
    async fn idle(&self) -> TestResult<Worker> {
        Worker::join(Arc::clone(&self.server), "idle", Backend::Ndarray).await
    }

    async fn run(&self, run: &RunId) -> TestResult<RunView> {
        let sent = self.server.request(Method::GET, &format!("/v1/runs/{run}")).send().await?;
        Ok(sent.error_for_status()?.json().await?)
    }

    /// Completes the stages before the shards.
    async fn up_to_the_shards(&self, worker: &Worker) -> TestResult<Assignment> {
        loop {
            let Some(assignment) = worker.poll().await? else { continue };
            if assignment.stage.name.as_str() == "latents" {
                return Ok(assignment);
            }
            worker.finish(&assignment).await?.error_for_status()?;
        }
    }
}

/// An uploaded artifact.
#[derive(Clone)]
struct Output {
    digest: Digest,
    receipts: BTreeMap<Digest, String>,
}

/// A worker that does not compute.
struct Worker {
    server: Arc<Server>,
    name: String,
    incarnation: Incarnation,
    ready: Mutex<Vec<TaskId>>,
}

impl Worker {
    async fn join(server: Arc<Server>, name: &str, backend: Backend) -> TestResult<Self> {
        let join = Join { worker: name.into(), backend, ..offer() };
        let joined: Joined = post(&server, "/v1/workers", &join).await?;
        Ok(Self { server, name: name.to_owned(), incarnation: joined.incarnation, ready: Mutex::default() })
    }

    async fn poll(&self) -> TestResult<Option<Assignment>> {
        let ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let poll = Poll { incarnation: self.incarnation, doing: vec![], ready, version: 0, leaving: false };
        let path = format!("/v1/workers/{}/poll", self.name);
        let desired: DesiredAssignments = post(&self.server, &path, &poll).await?;
        // This worker does not really fetch inputs, so all of them are ready at once.
        let prepared = desired.prepare.into_iter().map(|prepare| prepare.task).collect();
        *self.ready.lock().unwrap_or_else(PoisonError::into_inner) = prepared;
        Ok(desired.assignments.into_iter().next())
    }

    /// Uploads a blob; returns its digest and receipt.
    async fn put(&self, assignment: &Assignment, bytes: Vec<u8>) -> TestResult<(Digest, String)> {
        let digest = Digest::of(&bytes);
        let request = self.server.request(Method::PUT, &format!("/v1/blobs/{digest}"));
        let request = request.header(GRANT_HEADER, serde_json::to_string(&assignment.grant)?);
        let request = request.header(SECRET_HEADER, &assignment.secret);
        let stored: BlobStored = request.body(bytes).send().await?.error_for_status()?.json().await?;
        Ok((digest, stored.receipt.ok_or("an upload gives a receipt")?))
    }

    /// Uploads an artifact of one file; returns its digest and the receipts of its blobs.
    async fn output(&self, assignment: &Assignment) -> TestResult<Output> {
        let kind = match assignment.stage.name.as_str() {
            "dataset" => ArtifactKind::Dataset,
            "vae" => ArtifactKind::Vae,
            _ => ArtifactKind::Latents,
        };
        let content = assignment.grant.task.as_str().as_bytes().to_vec();
        let bytes = content.len() as u64;
        let mut manifest = Manifest::new(kind, serde_json::json!({}));
        let file = self.put(assignment, content).await?;
        manifest.files.insert("content".into(), FileEntry::of_blob(file.0, bytes));
        let own = self.put(assignment, manifest.to_bytes()).await?;
        Ok(Output { digest: own.0, receipts: [file, own].into() })
    }

    async fn report(&self, assignment: &Assignment, output: Output) -> TestResult<reqwest::Response> {
        let outcome = TaskOutcome::Finished { output: output.digest, metrics: BTreeMap::new() };
        let report = ReportOutcome::new(assignment.grant.clone(), outcome);
        let vouched = Vouched { what: report, receipts: output.receipts };
        let request = self.server.request(Method::POST, "/v1/outcomes").header(SECRET_HEADER, &assignment.secret);
        Ok(request.json(&vouched).send().await?)
    }

    async fn finish(&self, assignment: &Assignment) -> TestResult<reqwest::Response> {
        let output = self.output(assignment).await?;
        self.report(assignment, output).await
    }
}

async fn post<T: DeserializeOwned>(server: &Server, path: &str, body: &impl Serialize) -> TestResult<T> {
    let sent = server.request(Method::POST, path).header(SECRET_HEADER, SECRET).json(body).send().await?;
    let (status, text) = (sent.status(), sent.text().await?);
    if !status.is_success() {
        return Err(format!("{path}: {status} {text}").into());
    }
    Ok(serde_json::from_str(&text)?)
}

/// Sorted latencies of consecutive heartbeats until `stop`.
async fn heartbeats(worker: Worker, stop: tokio::sync::watch::Receiver<bool>) -> TestResult<Vec<Duration>> {
    let mut times = Vec::new();
    while !*stop.borrow() {
        let begun = Instant::now();
        worker.poll().await?;
        times.push(begun.elapsed());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    times.sort_unstable();
    Ok(times)
}

fn p99(sorted: &[Duration]) -> Duration {
    sorted[sorted.len() * 99 / 100]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bucket_of_30_ms_slows_no_more_than_what_asks_it() -> TestResult {
    const WORKERS: usize = 100;
    const SHARDS: usize = 600;
    let dir = tempfile::tempdir()?;
    let slow = Slow::start(dir.path()).await?;
    let idle = slow.idle().await?;
    slow.submit(SHARDS).await?;
    let first = slow.worker("w0").await?;
    slow.up_to_the_shards(&first).await?;
    let mut workers = vec![first];
    for i in 1..WORKERS {
        workers.push(slow.worker(&format!("w{i}")).await?);
    }
    slow.bucket.delay(Duration::from_millis(30));
    let (stop, stopped) = tokio::sync::watch::channel(false);
    let beats = tokio::spawn(heartbeats(idle, stopped));
    let (mut working, begun) = (JoinSet::new(), Instant::now());
    for worker in workers {
        working.spawn(async move {
            let mut done = 0_u32;
            while let Some(assignment) = worker.poll().await? {
                // The merge is granted after all shards are done.
                if !matches!(assignment.role, protocol::message::Role::Shard { .. }) {
                    break;
                }
                worker.finish(&assignment).await?.error_for_status()?;
                done += 1;
            }
            TestResult::Ok(done)
        });
    }
    let mut outcomes = 0;
    while let Some(done) = working.join_next().await {
        outcomes += done??;
    }
    let rate = f64::from(outcomes) / begun.elapsed().as_secs_f64();
    stop.send(true)?;
    let times = beats.await??;
    eprintln!("{outcomes} outcomes, {rate:.0} a second; heartbeats: p99 {:.1?} of {}", p99(&times), times.len());
    assert!(outcomes as usize >= SHARDS / 2, "{outcomes}");
    // Sequential requests would take 240 ms per outcome, 4 a second. A debug build is bound by its processor: two slow cores,
    // beside other work, did 12.
    assert!(rate > 7.0, "{rate}");
    assert!(p99(&times) < Duration::from_millis(500), "{:?}", p99(&times));
    slow.handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bucket_that_never_answers_stops_what_needs_it_and_status_says_so() -> TestResult {
    let dir = tempfile::tempdir()?;
    let slow = Slow::start(dir.path()).await?;
    let idle = slow.idle().await?;
    let run = slow.submit(4).await?;
    let worker = slow.worker("w0").await?;
    let assignment = slow.up_to_the_shards(&worker).await?;
    let output = worker.output(&assignment).await?;
    assert_eq!(slow.run(&run).await?.storage, None);

    let _answering = Answering(slow.bucket.clone());
    slow.bucket.silence(true);
    let silent = Instant::now();
    let (stop, stopped) = tokio::sync::watch::channel(false);
    let beats = tokio::spawn(heartbeats(idle, stopped));
    // Many uploads that need the bucket at the same time.
    let mut needing = JoinSet::new();
    for i in 0..300 {
        let (server, assignment) = (Arc::clone(&slow.server), assignment.clone());
        let worker = Worker { server, name: "w0".into(), incarnation: worker.incarnation, ready: Mutex::default() };
        needing.spawn(async move { worker.put(&assignment, format!("blob {i}").into_bytes()).await.is_err() });
    }
    // Calls that do not need the bucket succeed long before those uploads fail.
    let other = slow.submit(4).await?;
    slow.worker("late").await?;
    slow.handle.control(&other, coordinator::Control::Pause).await?;
    assert_eq!(slow.run(&other).await?.state, protocol::message::RunState::Paused);
    assert!(silent.elapsed() < Duration::from_secs(5), "{:?}", silent.elapsed());

    let problem = loop {
        if let Some(problem) = slow.run(&run).await?.storage {
            break problem;
        }
        assert!(silent.elapsed() < Duration::from_secs(10), "nothing is said");
        tokio::time::sleep(Duration::from_millis(50)).await;
    };
    assert!(problem.what.contains("s3://slow/p") && problem.what.contains("no answer"), "{problem:?}");
    eprintln!("said after {:.1?}: {}", silent.elapsed(), problem.what);
    while let Some(refused) = needing.join_next().await {
        assert!(refused?, "a blob was stored nowhere");
    }
    // An artifact verified earlier is accepted while the bucket's lease is valid; otherwise the call must be repeated.
    let report = worker.report(&assignment, output.clone()).await?.status();
    assert!(report.is_success() || report == StatusCode::SERVICE_UNAVAILABLE, "{report}");
    stop.send(true)?;
    let times = beats.await??;
    eprintln!("heartbeats: p99 {:.1?}, longest {:.1?} of {}", p99(&times), times[times.len() - 1], times.len());
    assert!(p99(&times) < Duration::from_millis(500), "{:?}", p99(&times));

    slow.bucket.silence(false);
    let again = Instant::now();
    while worker.report(&assignment, output.clone()).await?.status() == StatusCode::SERVICE_UNAVAILABLE {
        assert!(again.elapsed() < Duration::from_secs(60), "the bucket answers, and nobody asks");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    while slow.run(&run).await?.storage.is_some() {
        assert!(again.elapsed() < Duration::from_secs(60), "what is over is still said");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    slow.handle.shutdown().await;
    Ok(())
}
