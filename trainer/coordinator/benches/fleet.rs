//! A thousand workers over TCP against one coordinator with a store on disk, all on this machine: how long a heartbeat
//! takes, how many claims and metric rows a second become durable, how long a restart takes. `cargo bench -p coordinator`.
//!
//! A claim is a report of a finished shard: in one transaction it ends the shard and gives its worker the next one.

use std::collections::{BTreeMap, HashMap};
use std::io::Write as _;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use coordinator::{Config, Connections, Coordinator};
use protocol::message::{
    Assignment, DesiredAssignments, Join, Joined, MetricBatch, MetricRow, PROTOCOL_VERSION, Poll, ReportOutcome,
    Submit, TaskOutcome,
};
use protocol::pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::proof::{BlobStored, GRANT_HEADER, SECRET_HEADER, Vouched};
use protocol::stage::{Backend, DataSynthetic, EncodeLatents, Placement, StageSettings, TrainVae, WorkerRange};
use protocol::{ArtifactKind, Digest, Incarnation, Manifest, Seed, TaskId};
use registry::{Holder, Store};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

const WORKERS: usize = 1000;
const RUNS: u64 = 50;
const SHARDS: usize = 100;

/// One connection that is kept.
struct Connection {
    stream: TcpStream,
    buffer: Vec<u8>,
    token: String,
}

impl Connection {
    async fn open(address: SocketAddr, token: &str) -> Result<Self> {
        let stream = TcpStream::connect(address).await?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, buffer: Vec::new(), token: token.to_owned() })
    }

    async fn send(&mut self, what: &str, headers: &str, body: &[u8]) -> Result<Vec<u8>> {
        let length = body.len();
        let token = &self.token;
        let headers = format!("authorization: Bearer {token}\r\n{headers}content-length: {length}");
        let head = format!("{what} HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n\r\n");
        let mut request = head.into_bytes();
        request.extend_from_slice(body);
        self.stream.write_all(&request).await?;
        self.buffer.clear();
        let (mut end, mut length) = (None, 0);
        loop {
            if end.is_none()
                && let Some(at) = self.buffer.windows(4).position(|w| w == b"\r\n\r\n")
            {
                let head = std::str::from_utf8(&self.buffer[..at])?.to_lowercase();
                let value = head.lines().find_map(|line| line.strip_prefix("content-length: "));
                length = value.ok_or("no length")?.trim().parse()?;
                end = Some(at + 4);
            }
            if let Some(end) = end
                && self.buffer.len() >= end + length
            {
                let answer = self.buffer[end..end + length].to_vec();
                if &self.buffer[9..12] == b"200" {
                    return Ok(answer);
                }
                return Err(String::from_utf8_lossy(&answer).into_owned().into());
            }
            if self.stream.read_buf(&mut self.buffer).await? == 0 {
                return Err("the server closed the connection".into());
            }
        }
    }

    async fn post<T: DeserializeOwned>(&mut self, path: &str, secret: &str, body: &impl Serialize) -> Result<T> {
        let body = serde_json::to_vec(body)?;
        let headers = format!("content-type: application/json\r\n{SECRET_HEADER}: {secret}\r\n");
        let answer = self.send(&format!("POST {path}"), &headers, &body).await?;
        Ok(serde_json::from_slice(&answer)?)
    }

    /// Uploads a blob; its receipt.
    async fn put(&mut self, assignment: &Assignment, bytes: &[u8]) -> Result<String> {
        let grant = serde_json::to_string(&assignment.grant)?;
        let header = format!("{GRANT_HEADER}: {grant}\r\n{SECRET_HEADER}: {}\r\n", assignment.secret);
        let answer = self.send(&format!("PUT /v1/blobs/{}", Digest::of(bytes)), &header, bytes).await?;
        Ok(serde_json::from_slice::<BlobStored>(&answer)?.receipt.ok_or("a stored blob has a receipt")?)
    }
}

/// A worker that does not compute.
struct Worker {
    name: String,
    incarnation: Incarnation,
    connection: Connection,
    /// Receipts by task and blob.
    uploaded: HashMap<(TaskId, Digest), String>,
}

/// What every worker of the bench shows.
const SECRET: &str = "the-secret-of-each-worker-of-this-bench";

impl Worker {
    async fn join(address: SocketAddr, token: &str, i: usize) -> Result<Self> {
        let mut connection = Connection::open(address, token).await?;
        let name = format!("w{i}");
        let join = Join {
            protocol: PROTOCOL_VERSION,
            worker: name.as_str().into(),
            pid: 1,
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            peer_address: "127.0.0.1:1".into(),
        };
        let joined: Joined = connection.post("/v1/workers", SECRET, &join).await?;
        Ok(Self { name, incarnation: joined.incarnation, connection, uploaded: HashMap::new() })
    }

    /// A heartbeat that is answered at once.
    async fn poll(&mut self) -> Result<Option<Assignment>> {
        let poll = Poll { incarnation: self.incarnation, doing: vec![], ready: vec![], version: 0 };
        let desired: DesiredAssignments =
            self.connection.post(&format!("/v1/workers/{}/poll", self.name), SECRET, &poll).await?;
        Ok(desired.assignments.into_iter().next())
    }

    /// Something of the right kind, uploaded once by each worker.
    async fn output(&mut self, assignment: &Assignment) -> Result<Digest> {
        let kind = match assignment.stage.name.as_str() {
            "dataset" => ArtifactKind::Dataset,
            "vae" => ArtifactKind::Vae,
            _ => ArtifactKind::Latents,
        };
        let manifest = Manifest::new(kind, serde_json::json!({}));
        let place = (assignment.grant.task.clone(), manifest.digest());
        if !self.uploaded.contains_key(&place) {
            let receipt = self.connection.put(assignment, &manifest.to_bytes()).await?;
            self.uploaded.insert(place, receipt);
        }
        Ok(manifest.digest())
    }

    async fn finish(&mut self, assignment: Assignment, output: Digest) -> Result {
        let Assignment { grant, secret, .. } = assignment;
        let receipt = self.uploaded.get(&(grant.task.clone(), output)).map(|receipt| (output, receipt.clone()));
        let outcome = TaskOutcome::Finished { output, metrics: BTreeMap::new() };
        let report = Vouched { what: ReportOutcome { grant, outcome }, receipts: receipt.into_iter().collect() };
        self.connection.post("/v1/outcomes", &secret, &report).await
    }
}

fn pipeline(seed: u64) -> Pipeline {
    let stage = |name: &str, settings: StageSettings| {
        let inputs = settings.inputs().into_iter();
        let inputs =
            inputs.map(|(field, stage, kind)| StageInput { field, stage: stage.as_str().into(), kind }).collect();
        let placement = Placement { workers: WorkerRange { min: 1, max: 1 }, ..Placement::default() };
        PipelineStage {
            name: name.into(),
            settings,
            placement,
            inputs,
            external: BTreeMap::new(),
            sweep: None,
            derived: None,
        }
    };
    Pipeline {
        name: "bench".into(),
        seed: Seed(seed),
        backend: Backend::Flex,
        stages: vec![
            stage("dataset", StageSettings::DataSynthetic(DataSynthetic::default())),
            stage("vae", StageSettings::TrainVae(TrainVae::default())),
            stage("latents", StageSettings::EncodeLatents(EncodeLatents { shards: SHARDS, ..Default::default() })),
        ],
        code_versions: BTreeMap::new(),
    }
}

fn percentile(sorted: &[Duration], percent: usize) -> Duration {
    sorted[(sorted.len() * percent / 100).min(sorted.len() - 1)]
}

/// Every worker polls once a second for `seconds`; the time that each poll took.
async fn heartbeats(workers: Vec<Worker>, seconds: u64) -> Result<(Vec<Worker>, Vec<Duration>)> {
    let tasks: Vec<_> = workers
        .into_iter()
        .enumerate()
        .map(|(i, mut worker)| {
            tokio::spawn(async move {
                let mut times = Vec::new();
                tokio::time::sleep(Duration::from_millis(i as u64 * 1000 / WORKERS as u64)).await;
                let mut clock = tokio::time::interval(Duration::from_secs(1));
                for _ in 0..seconds {
                    clock.tick().await;
                    let begun = Instant::now();
                    worker.poll().await?;
                    times.push(begun.elapsed());
                }
                Ok::<_, Box<dyn std::error::Error + Send + Sync>>((worker, times))
            })
        })
        .collect();
    let (mut workers, mut times) = (Vec::new(), Vec::new());
    for task in tasks {
        let (worker, own) = task.await??;
        workers.push(worker);
        times.extend(own);
    }
    times.sort_unstable();
    Ok((workers, times))
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a bench")).await?;
    coordinator::shell::raise_descriptor_limit();
    // Workers that wait for their turn in this bench are silent for longer than any real one.
    let connections = Connections { idle: Duration::from_secs(600), ..Connections::default() };
    let config = Config { alone: false, park: false, connections, ..Config::embedded() };
    let handle = Coordinator::start(store, config).await?;
    let (address, token) = (handle.address(), handle.token().secret().to_owned());
    let mut out = std::io::stdout();

    for seed in 0..RUNS {
        let pipeline = serde_json::to_value(pipeline(seed))?;
        handle.submit(Submit { pipeline, source: String::new(), idempotency_key: None, until: None }).await?;
    }
    let begun = Instant::now();
    let mut workers = Vec::new();
    for i in 0..WORKERS {
        workers.push(Worker::join(address, &token, i).await?);
    }
    writeln!(
        out,
        "{WORKERS} workers joined one by one: {:.0} joins/s",
        WORKERS as f64 / begun.elapsed().as_secs_f64()
    )?;

    let (mut workers, times) = heartbeats(workers, 5).await?;
    let [p50, p99, max] = [50, 99, 100].map(|percent| percentile(&times, percent));
    writeln!(out, "{} heartbeats, 1,000 a second: median {p50:.1?}, p99 {p99:.1?}, longest {max:.1?}", times.len())?;

    // The data sets of all runs, so that every worker has something to do; then their VAEs.
    for _ in 0..2 {
        for worker in &mut workers {
            if let Some(assignment) = worker.poll().await?
                && assignment.stage.name.as_str() != "latents"
            {
                let output = worker.output(&assignment).await?;
                worker.finish(assignment, output).await?;
            }
        }
    }

    // Metric rows, in batches as a worker sends them, under the grants that 16 workers hold.
    let rows = Arc::new(AtomicU64::new(0));
    let begun = Instant::now();
    let mut tasks = Vec::new();
    for mut worker in workers.drain(..16) {
        let rows = Arc::clone(&rows);
        tasks.push(tokio::spawn(async move {
            let Assignment { grant, secret, .. } = worker.poll().await?.ok_or("every worker holds a shard")?;
            for batch in 0..40u64 {
                let row = |i: u64| MetricRow { step: batch * 1000 + i, key: "loss".into(), value: 0.5 };
                let batch = MetricBatch { grant: grant.clone(), rows: (0..1000).map(row).collect() };
                worker.connection.post::<()>("/v1/metrics", &secret, &batch).await?;
                rows.fetch_add(1000, Ordering::Relaxed);
            }
            Ok::<_, Box<dyn std::error::Error + Send + Sync>>(worker)
        }));
    }
    let mut back = Vec::new();
    for task in tasks {
        back.push(task.await??);
    }
    let rate = rows.load(Ordering::Relaxed) as f64 / begun.elapsed().as_secs_f64();
    writeln!(out, "metric rows in batches of 1,000: {rate:.0} a second")?;
    workers.append(&mut back);

    // Claims by half of the workers while the other half sends heartbeats.
    let claims = Arc::new(AtomicU64::new(0));
    let beating = workers.split_off(WORKERS / 2);
    let begun = Instant::now();
    let tasks: Vec<_> = workers
        .into_iter()
        .map(|mut worker| {
            let claims = Arc::clone(&claims);
            tokio::spawn(async move {
                for _ in 0..8 {
                    let Some(assignment) = worker.poll().await? else { break };
                    let output = worker.output(&assignment).await?;
                    worker.finish(assignment, output).await?;
                    claims.fetch_add(1, Ordering::Relaxed);
                }
                Ok::<_, Box<dyn std::error::Error + Send + Sync>>(())
            })
        })
        .collect();
    let beats = tokio::spawn(heartbeats(beating, 3));
    for task in tasks {
        task.await??;
    }
    let took = begun.elapsed();
    let claims = claims.load(Ordering::Relaxed);
    let (_, times) = beats.await??;
    let [p50, p99] = [50, 99].map(|percent| percentile(&times, percent));
    writeln!(out, "{claims} claims by 500 workers: {:.0} a second", claims as f64 / took.as_secs_f64())?;
    writeln!(out, "heartbeats of the other 500 meanwhile: median {p50:.1?}, p99 {p99:.1?}")?;
    handle.shutdown().await;

    // The connections of the workers end when their tasks get to it; until then they hold the store.
    let store = loop {
        match Store::open(dir.path(), Holder::this_process("a bench")).await {
            Err(registry::OpenError::Busy { .. }) => tokio::time::sleep(Duration::from_millis(20)).await,
            opened => break opened?,
        }
    };
    let entries = store.recovery().await?.facts.len();
    let begun = Instant::now();
    let handle = Coordinator::start(store, Config { alone: false, park: false, ..Config::embedded() }).await?;
    let took = begun.elapsed();
    let rate = entries as f64 / took.as_secs_f64();
    writeln!(out, "a restart came back from {entries} decisions after a snapshot in {took:.2?}: {rate:.0} a second")?;
    handle.shutdown().await;
    Ok(())
}
