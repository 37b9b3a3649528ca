//! Waiting runs beside active ones, with 100, 1,000 and 10,000 live runs. Measures durable claims per second, heartbeat
//! latency, and memory with 10,000 runs. `cargo bench -p coordinator --bench queued`.
//!
//! A claim is a report of a finished shard of the first run: one transaction ends the shard and grants the next one to
//! its worker. Each size has its own store and coordinator. Sizes are measured alternately, so that other load on the
//! machine affects all of them equally.

mod common;

use std::collections::BTreeMap;
use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use coordinator::{Config, Connections, Coordinator, Handle, Policy};
use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::Seed;
use protocol::message::Submit;
use protocol::stage::{Backend, DataSynthetic, EncodeLatents, Placement, StageSettings, TrainVae, WorkerRange};

use crate::common::{Result, Worker};

const SIZES: [u64; 3] = [100, 1_000, 10_000];
const WORKERS: usize = 64;
const SHARDS: usize = 10_000;
/// Stages with so many shards, enough for all rounds.
const SHARDED: usize = 5;
const ROUNDS: usize = 5;
/// Duration of a round of one size.
const ROUND: Duration = Duration::from_secs(3);
const CLIENTS: u64 = 64;

/// The first run has the shards; the others wait for a worker for their dataset.
fn pipeline(seed: u64) -> Pipeline {
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
    let (stages, shards) = if seed == 0 { (SHARDED, SHARDS) } else { (1, 4) };
    let mut all = vec![
        stage("dataset", StageSettings::DataSynthetic(DataSynthetic::default())),
        stage("vae", StageSettings::TrainVae(TrainVae::default())),
    ];
    for n in 0..stages {
        let latents = EncodeLatents { shards, ..Default::default() };
        all.push(stage(&format!("latents{n}"), StageSettings::EncodeLatents(latents)));
    }
    Pipeline {
        name: "queued".into(),
        seed: Seed(seed),
        backend: Backend::Flex,
        priority: 0,
        stages: all,
        code_versions: BTreeMap::new(),
    }
}

struct Size {
    runs: u64,
    handle: Arc<Handle>,
    workers: Vec<Worker>,
    rates: Vec<f64>,
    beats: Vec<Duration>,
    _dir: tempfile::TempDir,
}

async fn submit(handle: &Handle, seed: u64) -> Result {
    let pipeline = serde_json::to_value(pipeline(seed))?;
    handle.submit(Submit { pipeline, source: String::new(), idempotency_key: None, until: None }).await?;
    Ok(())
}

async fn prepare(runs: u64) -> Result<Size> {
    let dir = tempfile::tempdir()?;
    let store = common::open(dir.path()).await?;
    let connections = Connections { idle: Duration::from_secs(600), ..Connections::default() };
    // Workers that wait for their turn in this bench are silent for longer than real ones.
    let policy = Policy { lease_ms: 600_000, ..Policy::default() };
    let config = Config { alone: false, park: false, connections, policy, ..Config::embedded() };
    let handle = Arc::new(Coordinator::start(store, config).await?);
    let (address, token) = (handle.address(), handle.token().secret().to_owned());
    submit(&handle, 0).await?;
    let mut workers = vec![Worker::join(address, &token, 0).await?];
    for _ in 0..2 {
        let assignment = loop {
            if let Some(assignment) = workers[0].poll().await? {
                break assignment;
            }
        };
        let output = workers[0].output(&assignment).await?;
        workers[0].finish(assignment, output).await?;
    }
    workers[0].joins_gangs = false;
    for i in 1..WORKERS {
        let mut worker = Worker::join(address, &token, i).await?;
        worker.joins_gangs = false;
        workers.push(worker);
    }
    let clients: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let handle = Arc::clone(&handle);
            tokio::spawn(async move {
                for seed in (1..runs).filter(|seed| seed % CLIENTS == client) {
                    submit(&handle, seed).await?;
                }
                Result::Ok(())
            })
        })
        .collect();
    for client in clients {
        client.await??;
    }
    Ok(Size { runs, handle, workers, rates: Vec::new(), beats: Vec::new(), _dir: dir })
}

/// All workers except one make claims; the last one sends heartbeats.
async fn round(size: &mut Size) -> Result {
    let (stop, claims) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let mut beating = size.workers.pop().ok_or("a worker")?;
    let begun = Instant::now();
    let claiming: Vec<_> = std::mem::take(&mut size.workers)
        .into_iter()
        .map(|mut worker| {
            let (stop, claims) = (Arc::clone(&stop), Arc::clone(&claims));
            tokio::spawn(async move {
                while !stop.load(Ordering::Relaxed) {
                    let assignment = worker.poll().await?.ok_or("there is always a shard")?;
                    let output = worker.output(&assignment).await?;
                    worker.finish(assignment, output).await?;
                    claims.fetch_add(1, Ordering::Relaxed);
                }
                Result::Ok(worker)
            })
        })
        .collect();
    while begun.elapsed() < ROUND {
        let asked = Instant::now();
        beating.poll().await?;
        size.beats.push(asked.elapsed());
        tokio::time::sleep(Duration::from_millis(3)).await;
    }
    size.rates.push(claims.load(Ordering::Relaxed) as f64 / begun.elapsed().as_secs_f64());
    stop.store(true, Ordering::Relaxed);
    for task in claiming {
        size.workers.push(task.await??);
    }
    size.workers.push(beating);
    Ok(())
}

fn resident_mb() -> Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.split_whitespace().nth(1).ok_or("no number")?.parse::<u64>()? / 1024)
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    coordinator::shell::raise_descriptor_limit();
    let mut out = std::io::stdout();
    let mut sizes = Vec::new();
    for runs in SIZES {
        let (before, begun) = (resident_mb()?, Instant::now());
        sizes.push(prepare(runs).await?);
        let took = begun.elapsed().as_secs_f64();
        let rate = runs as f64 / took;
        writeln!(out, "{runs} live runs: {rate:.0} submissions/s, resident memory {before} -> {} MB", resident_mb()?)?;
    }
    for _ in 0..ROUNDS {
        for size in &mut sizes {
            round(size).await?;
        }
    }
    writeln!(out, "\n| live runs | claims/s, median of {ROUNDS} | share | heartbeats: median | p99 | longest |")?;
    writeln!(out, "|---|---|---|---|---|---|")?;
    let mut first = None;
    for size in &mut sizes {
        size.rates.sort_by(f64::total_cmp);
        size.beats.sort();
        let rate = size.rates[size.rates.len() / 2];
        let share = rate / *first.get_or_insert(rate);
        let of = |percent: usize| size.beats[(size.beats.len() - 1) * percent / 100];
        let (p50, p99, max) = (of(50), of(99), of(100));
        writeln!(out, "| {} | {rate:.0} | {share:.2} | {p50:.2?} | {p99:.2?} | {max:.2?} |", size.runs)?;
    }
    writeln!(out, "\nresident at the end {} MB", resident_mb()?)?;
    let last = sizes.pop().ok_or("sizes")?;
    drop(last.workers);
    let handle = Arc::into_inner(last.handle).ok_or("somebody still uses the coordinator")?;
    let begun = Instant::now();
    handle.shutdown().await;
    writeln!(out, "the snapshot of a stop with 10,000 live runs took {:.2?}", begun.elapsed())?;
    Ok(())
}
