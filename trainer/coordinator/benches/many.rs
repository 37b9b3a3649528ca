//! A coordinator that has been running for long, with 10,000 ended runs and 1,000,000 facts. Measures time and memory
//! of a restart, durable submissions per second compared with an empty store, and heartbeat latency while clients send
//! expensive calls. `cargo bench -p coordinator --bench many`.
//!
//! The restarted coordinator is a separate process, and its clients are in this one, so that its memory is its own.
//! Compared values are measured alternately within one run and by medians, so that other load on the machine affects
//! both equally.

mod common;

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use coordinator::{Config, Control, Coordinator, Handle};
use pipeline::Pipeline;
use protocol::limits;
use protocol::message::{
    Assignment, DesiredAssignments, Join, Joined, LogBatch, MetricBatch, MetricRow, PROTOCOL_VERSION, Poll, Submit,
};
use protocol::proof::SECRET_HEADER;
use protocol::stage::Backend;
use registry::cli::Command;

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

const RUNS: u64 = 10_000;
const FACTS: u64 = 1_000_000;
/// Number of concurrent clients.
const CLIENTS: u64 = 64;
/// Number of measurements per store, and of submissions per measurement.
const ROUNDS: u64 = 7;
const TIMED: u64 = 300;
/// Duration of the heartbeat measurement beside each kind of call.
const BESIDE: Duration = Duration::from_secs(8);
/// Pause between two heartbeats.
const PAUSE: Duration = Duration::from_millis(3);
/// Size of the exported blob in bytes.
const EXPORT: usize = 256 << 20;

fn pipeline(seed: u64) -> Result<Pipeline> {
    let text = format!(
        "name: many\nseed: {seed}\ndataset: {{format: synthetic}}\nstages:\n  vae: {{kind: train.vae}}\n  latents: {{kind: encode.latents}}\n"
    );
    pipeline::read("many.yaml", &text, &[]).map_err(|mistakes| mistakes.to_string().into())
}

async fn start(dir: &Path) -> Result<Handle> {
    let store = common::open(dir).await?;
    Ok(Coordinator::start(store, Config { alone: false, park: false, ..Config::embedded() }).await?)
}

/// Submits the pipelines of `seeds` and cancels each, with `CLIENTS` clients. Returns submissions per second.
async fn submit_and_cancel(handle: &Arc<Handle>, seeds: std::ops::Range<u64>) -> Result<f64> {
    let (begun, count) = (Instant::now(), seeds.end - seeds.start);
    let clients: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let (handle, seeds) = (Arc::clone(handle), seeds.clone());
            tokio::spawn(async move {
                for seed in seeds.skip(usize::try_from(client)?).step_by(usize::try_from(CLIENTS)?) {
                    let pipeline = serde_json::to_value(pipeline(seed)?)?;
                    let submit = Submit { pipeline, source: String::new(), idempotency_key: None, until: None };
                    let run = handle.submit(submit).await?;
                    handle.control(&run, Control::Cancel).await?;
                }
                Result::Ok(())
            })
        })
        .collect();
    for client in clients {
        client.await??;
    }
    Ok(count as f64 / begun.elapsed().as_secs_f64())
}

/// Pauses and resumes runs until `facts` facts are recorded.
async fn record_facts(handle: &Arc<Handle>, facts: u64) -> Result {
    let clients: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let handle = Arc::clone(handle);
            tokio::spawn(async move {
                let pipeline = serde_json::to_value(pipeline(u64::MAX / 2 + client)?)?;
                let submit = Submit { pipeline, source: String::new(), idempotency_key: None, until: None };
                let run = handle.submit(submit).await?;
                while handle.facts() < facts {
                    handle.control(&run, Control::Pause).await?;
                    handle.control(&run, Control::Resume).await?;
                }
                handle.control(&run, Control::Cancel).await?;
                Result::Ok(())
            })
        })
        .collect();
    for client in clients {
        client.await??;
    }
    Ok(())
}

/// The restarted coordinator.
struct Restarted {
    address: String,
    token: String,
    pid: u32,
}

fn resident_mb(pid: u32) -> Result<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.split_whitespace().nth(1).ok_or("no number")?.parse::<u64>()? / 1024)
}

async fn shut(handle: Arc<Handle>) -> Result {
    Arc::into_inner(handle).ok_or("somebody still uses the coordinator")?.shutdown().await;
    // Tasks that wait for the coordinator release the store with some delay.
    tokio::time::sleep(Duration::from_millis(200)).await;
    Ok(())
}

/// The secret of every worker here.
const SECRET: &str = "the-secret-of-a-worker-of-this-bench";

/// A persistent connection.
struct Caller {
    stream: TcpStream,
    token: String,
}

impl Caller {
    fn connect(server: &Restarted) -> Result<Self> {
        let stream = TcpStream::connect(&server.address)?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, token: server.token.clone() })
    }

    /// Sends a call with the secret of the worker and returns its status and body.
    fn call(&mut self, method: &str, path: &str, body: &[u8]) -> Result<(u16, Vec<u8>)> {
        self.call_with(SECRET, method, path, body)
    }

    fn call_with(&mut self, secret: &str, method: &str, path: &str, body: &[u8]) -> Result<(u16, Vec<u8>)> {
        let head = format!("authorization: Bearer {}\r\ncontent-type: application/json\r\n", self.token);
        let head = format!("{head}{SECRET_HEADER}: {secret}\r\n");
        let length = body.len();
        let head = format!("{method} {path} HTTP/1.1\r\nhost: localhost\r\n{head}content-length: {length}\r\n\r\n");
        self.stream.write_all(&[head.as_bytes(), body].concat())?;
        let (mut answer, mut part) = (Vec::new(), vec![0; 256 << 10]);
        let end = loop {
            if let Some(end) = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n") {
                break end + 4;
            }
            let n = self.stream.read(&mut part)?;
            answer.extend_from_slice(part.get(..n).filter(|part| !part.is_empty()).ok_or("the server hung up")?);
        };
        let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
        let status = head.split(' ').nth(1).ok_or("no status")?.parse()?;
        let length: usize =
            head.lines().find_map(|l| l.strip_prefix("content-length: ")).ok_or("no length")?.parse()?;
        let mut body = answer.split_off(end);
        while body.len() < length {
            let n = self.stream.read(&mut part)?;
            body.extend_from_slice(part.get(..n).filter(|part| !part.is_empty()).ok_or("the server hung up")?);
        }
        Ok((status, body))
    }

    fn post<T: serde::de::DeserializeOwned>(&mut self, path: &str, body: &impl serde::Serialize) -> Result<T> {
        self.post_with(SECRET, path, body)
    }

    fn post_with<T: serde::de::DeserializeOwned>(
        &mut self,
        secret: &str,
        path: &str,
        body: &impl serde::Serialize,
    ) -> Result<T> {
        let (status, answer) = self.call_with(secret, "POST", path, &serde_json::to_vec(body)?)?;
        if status != 200 {
            return Err(format!("{path}: {status} {}", String::from_utf8_lossy(&answer)).into());
        }
        Ok(serde_json::from_slice(&answer)?)
    }
}

/// Sends heartbeats until `stop` and returns the sorted latencies. Each is answered at once, because its version is
/// never current.
fn beat(server: &Restarted, stop: &AtomicBool) -> Result<Vec<Duration>> {
    let mut caller = Caller::connect(server)?;
    let join = Join {
        protocol: PROTOCOL_VERSION,
        worker: "w".into(),
        pid: 7,
        backend: Backend::Ndarray,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels: Default::default(),
    };
    let joined: Joined = caller.post("/v1/workers", &join)?;
    let poll =
        Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: u64::MAX, leaving: false };
    let mut times = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        let begun = Instant::now();
        let _: DesiredAssignments = caller.post("/v1/workers/w/poll", &poll)?;
        times.push(begun.elapsed());
        std::thread::sleep(PAUSE);
    }
    times.sort();
    Ok(times)
}

/// Measures heartbeats while `clients` threads call `work` repeatedly, and counts these calls.
fn beside(server: &Restarted, what: &str, clients: usize, work: impl Fn(&mut Caller) -> Result + Sync) -> Result {
    let (stop, calls) = (AtomicBool::new(false), std::sync::atomic::AtomicU64::new(0));
    let times = std::thread::scope(|scope| {
        let heartbeats = scope.spawn(|| beat(server, &stop));
        let clients: Vec<_> = (0..clients)
            .map(|_| {
                scope.spawn(|| {
                    let mut caller = Caller::connect(server)?;
                    while !stop.load(Ordering::Relaxed) {
                        work(&mut caller)?;
                        calls.fetch_add(1, Ordering::Relaxed);
                    }
                    Result::Ok(())
                })
            })
            .collect();
        std::thread::sleep(BESIDE);
        stop.store(true, Ordering::Relaxed);
        for client in clients {
            client.join().map_err(|_| "a client panicked")??;
        }
        heartbeats.join().map_err(|_| "the heartbeats panicked")?
    })?;
    let of = |percent: usize| times[(times.len() - 1) * percent / 100];
    let calls = calls.into_inner();
    let mut out = std::io::stdout();
    writeln!(
        out,
        "| {what} | {calls} | {} | {:.2?} | {:.2?} | {:.2?} |",
        times.len(),
        of(50),
        of(99),
        times[times.len() - 1]
    )?;
    Ok(())
}

/// A pipeline of `stages` stages as JSON.
fn large(stages: usize, seed: u64) -> Result<serde_json::Value> {
    let mut text =
        format!("name: large\nseed: {seed}\ndataset: {{format: synthetic}}\nstages:\n  vae: {{kind: train.vae}}\n");
    for i in 0..stages.saturating_sub(2) {
        text += &format!("  latents{i}: {{kind: encode.latents}}\n");
    }
    let read = pipeline::read("large.yaml", &text, &[]).map_err(|mistakes| mistakes.to_string())?;
    Ok(serde_json::to_value(read)?)
}

fn heartbeats(server: &Restarted, export: protocol::Digest) -> Result {
    let mut out = std::io::stdout();
    writeln!(out, "\n| beside | calls | heartbeats | median | p99 | longest |\n|---|---|---|---|---|---|")?;
    beside(server, "nothing", 0, |_| Ok(()))?;
    let small = serde_json::to_value(pipeline(77)?)?;
    let submit = |caller: &mut Caller, pipeline: &serde_json::Value| {
        let submit = Submit { pipeline: pipeline.clone(), source: String::new(), idempotency_key: None, until: None };
        let submitted: coordinator::shell::Submitted = caller.post("/v1/runs", &submit)?;
        caller.post::<serde_json::Value>(&format!("/v1/runs/{}/cancel", submitted.run), &())?;
        Result::Ok(())
    };
    beside(server, "submissions, 8 clients", 8, |caller| submit(caller, &small))?;
    let most = large(limits::STAGES, 78)?;
    beside(server, "submissions of 1,000 stages, 4 clients", 4, |caller| submit(caller, &most))?;
    let ask = |caller: &mut Caller, path: &str| match caller.call("GET", path, b"")? {
        (200, _) => Result::Ok(()),
        (status, answer) => Err(format!("{path}: {status} {}", String::from_utf8_lossy(&answer)).into()),
    };
    let blob = format!("/v1/blobs/{export}");
    beside(server, "exports of 256 MiB, 4 clients", 4, |caller| ask(caller, &blob))?;
    let command = |caller: &mut Caller, command: serde_json::Value| {
        caller.post::<serde_json::Value>("/v1/registry", &command).map(drop)
    };
    let (task, poll) = recorded(server)?;
    writeln!(out, "| (recorded {CURVES} curves of {STEPS} values; resident {} MB) |", resident_mb(server.pid)?)?;
    let run = task.grant.task.as_str().split('/').next().unwrap_or_default();
    let curves = format!("/v1/metrics?run={run}&buckets=500");
    beside(server, "four curves of a million values, 4 clients", 4, |caller| ask(caller, &curves))?;
    let line = std::sync::atomic::AtomicU64::new(0);
    let log = |caller: &mut Caller| {
        // Keeps the recorder's lease alive.
        caller.post::<DesiredAssignments>("/v1/workers/recorder/poll", &poll)?;
        let first = line.fetch_add(10_000, Ordering::Relaxed);
        let batch = LogBatch { grant: task.grant.clone(), first, lines: vec!["x".to_owned(); 10_000] };
        caller.post_with::<()>(&task.secret, "/v1/logs", &batch)
    };
    beside(server, "log lines of one byte, 2 clients", 2, log)?;
    let lines = format!("/v1/runs/{run}/logs?limit=10000");
    beside(server, "10,000 log lines read, 4 clients", 4, |caller| ask(caller, &lines))?;
    beside(server, "gc, 1 client", 1, |caller| {
        command(caller, serde_json::to_value(Command::Gc { dry_run: false, grace_minutes: None })?)
    })?;
    queue(server)?;
    writeln!(out, "| (10,000 runs wait; resident {} MB) |", resident_mb(server.pid)?)?;
    beside(server, "10,000 queued runs", 0, |_| Ok(()))?;
    beside(server, "10,000 queued runs and submissions, 8 clients", 8, |caller| submit(caller, &small))?;
    // A client that reads all runs, page by page.
    let list = |caller: &mut Caller| {
        let mut after = String::new();
        loop {
            let (status, answer) = caller.call("GET", &format!("/v1/runs?limit=500{after}"), b"")?;
            let list: serde_json::Value = serde_json::from_slice(&answer)?;
            match list["next"].as_str() {
                Some(next) if status == 200 => after = format!("&after={next}"),
                _ => return Result::Ok(()),
            }
        }
    };
    beside(server, "lists of all 20,000 runs, 4 clients", 4, list)?;
    beside(server, "four curves again, beside 10,000 queued runs, 4 clients", 4, |caller| ask(caller, &curves))?;
    Ok(())
}

/// Number of curves, and of values per curve.
const CURVES: usize = 4;
const STEPS: u64 = 1_000_000;

/// Starts a worker that holds a task and records the curves. Returns its task and its heartbeat.
fn recorded(server: &Restarted) -> Result<(Assignment, Poll)> {
    let mut caller = Caller::connect(server)?;
    let submit = Submit {
        pipeline: serde_json::to_value(pipeline(99)?)?,
        source: String::new(),
        idempotency_key: None,
        until: None,
    };
    caller.post::<serde_json::Value>("/v1/runs", &submit)?;
    let join = Join {
        protocol: PROTOCOL_VERSION,
        worker: "recorder".into(),
        pid: 7,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels: Default::default(),
    };
    let joined: Joined = caller.post("/v1/workers", &join)?;
    let poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
    let task = loop {
        let desired: DesiredAssignments = caller.post("/v1/workers/recorder/poll", &poll)?;
        if let Some(assignment) = desired.assignments.into_iter().next() {
            break assignment;
        }
    };
    for first in (0..STEPS).step_by(10_000 / CURVES) {
        let rows = (first..first + (10_000 / CURVES) as u64).flat_map(|step| {
            (0..CURVES).map(move |curve| MetricRow { step, key: format!("curve-{curve}"), value: (step as f64).sin() })
        });
        let batch = MetricBatch { grant: task.grant.clone(), rows: rows.collect() };
        caller.post_with::<()>(&task.secret, "/v1/metrics", &batch)?;
        caller.post::<DesiredAssignments>("/v1/workers/recorder/poll", &poll)?;
    }
    Ok((task, poll))
}

/// Submits 10,000 runs that wait for a worker of their backend.
fn queue(server: &Restarted) -> Result {
    std::thread::scope(|scope| {
        let clients: Vec<_> = (0..16)
            .map(|client| {
                scope.spawn(move || {
                    let mut caller = Caller::connect(server)?;
                    for seed in (0..RUNS).filter(|seed| seed % 16 == client) {
                        let pipeline = serde_json::to_value(pipeline(5_000_000 + seed)?)?;
                        let submit = Submit { pipeline, source: String::new(), idempotency_key: None, until: None };
                        caller.post::<serde_json::Value>("/v1/runs", &submit)?;
                    }
                    Result::Ok(())
                })
            })
            .collect();
        for client in clients {
            client.join().map_err(|_| "a client panicked")??;
        }
        Ok(())
    })
}

/// The restarted process: a timed restart, submissions alternating with an empty store, and service until its input ends.
async fn again(dir: &Path) -> Result {
    let mut out = std::io::stdout();
    let begun = Instant::now();
    let handle = Arc::new(start(dir).await?);
    let took = begun.elapsed();
    writeln!(out, "restart in {took:.2?}, resident {} MB", resident_mb(std::process::id())?)?;
    let store = tempfile::tempdir()?;
    let empty = Arc::new(start(store.path()).await?);
    let (mut old, mut new, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..ROUNDS {
        let first = 2_000_000 + round * TIMED;
        new.push(submit_and_cancel(&empty, first..first + TIMED).await?);
        old.push(submit_and_cancel(&handle, first..first + TIMED).await?);
        ratios.push(old[old.len() - 1] / new[new.len() - 1]);
    }
    let median = |rates: &mut Vec<f64>| {
        rates.sort_by(f64::total_cmp);
        rates[rates.len() / 2]
    };
    writeln!(
        out,
        "submissions a second, each with its cancellation, {CLIENTS} clients, medians of {ROUNDS} times {TIMED}: {:.0} on an empty store, {:.0} on the old one; the median ratio is {:.2}",
        median(&mut new),
        median(&mut old),
        median(&mut ratios),
    )?;
    shut(empty).await?;
    match handle
        .submit(Submit {
            pipeline: large(limits::STAGES + 1, 79)?,
            source: String::new(),
            idempotency_key: None,
            until: None,
        })
        .await
    {
        Err(refused) => writeln!(out, "a pipeline of one stage too many: {refused}")?,
        Ok(_) => return Err("a pipeline of too many stages was taken".into()),
    }
    writeln!(out, "{SERVES}{} {}", handle.address(), handle.token().secret())?;
    // Until the clients' process closes it.
    tokio::task::spawn_blocking(|| std::io::stdin().read_to_end(&mut Vec::new())).await??;
    shut(handle).await
}

/// Begins the line with the restarted coordinator's address and token.
const SERVES: &str = "serves ";

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    if let Some(dir) = std::env::var_os("MANY_AGAIN") {
        return again(Path::new(&dir)).await;
    }
    let mut out = std::io::stdout();
    let dir = tempfile::tempdir()?;
    let store = common::open(dir.path()).await?;
    let export = store.blobs().put(&vec![7; EXPORT])?;
    drop(store);
    let handle = Arc::new(start(dir.path()).await?);
    let begun = Instant::now();
    submit_and_cancel(&handle, 0..RUNS - CLIENTS).await?;
    record_facts(&handle, FACTS).await?;
    writeln!(out, "{RUNS} runs ended, {} facts recorded, in {:.0?}", handle.facts(), begun.elapsed())?;
    shut(handle).await?;
    let mut child = std::process::Command::new(std::env::current_exe()?);
    // As `trainer serve` sets it.
    child.env("MALLOC_ARENA_MAX", "2");
    let mut child = child.env("MANY_AGAIN", dir.path()).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
    let mut serving = None;
    for line in BufReader::new(child.stdout.take().ok_or("no output")?).lines() {
        let line = line?;
        if let Some((address, token)) = line.strip_prefix(SERVES).and_then(|line| line.split_once(' ')) {
            serving = Some(Restarted { address: address.to_owned(), token: token.to_owned(), pid: child.id() });
            break;
        }
        writeln!(out, "{line}")?;
    }
    let serving = serving.ok_or("the restarted coordinator does not serve")?;
    heartbeats(&serving, export)?;
    writeln!(out, "\nresident at the end {} MB", resident_mb(serving.pid)?)?;
    drop(child.stdin.take());
    if child.wait()?.success() { Ok(()) } else { Err("the restarted coordinator failed".into()) }
}
