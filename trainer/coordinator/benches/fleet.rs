//! A thousand workers over TCP against one coordinator with a store on disk, all on one machine. Measures heartbeat
//! latency, durable claims and metric rows per second, and the time of a restart. `cargo bench -p coordinator`.
//!
//! A claim is a report of a finished shard: one transaction ends the shard and grants the next one to its worker.

mod common;

use std::collections::BTreeMap;
use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use coordinator::{Config, Connections, Coordinator};
use pipeline::{Pipeline, PipelineStage, StageInput};
use protocol::Seed;
use protocol::message::{Assignment, MetricBatch, MetricRow, Submit};
use protocol::stage::{Backend, DataSynthetic, EncodeLatents, Placement, StageSettings, TrainVae, WorkerRange};

use crate::common::{Result, Worker};

const WORKERS: usize = 1000;
const RUNS: u64 = 50;
const SHARDS: usize = 100;

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
            copy_of: None,
        }
    };
    Pipeline {
        name: "bench".into(),
        seed: Seed(seed),
        backend: Backend::Flex,
        priority: 0,
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

/// Sends a heartbeat per second from every worker for `seconds`; returns the sorted latencies.
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
    let store = common::open(dir.path()).await?;
    coordinator::shell::raise_descriptor_limit();
    // Workers that wait for their turn in this bench are idle for longer than real ones.
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

    // First the datasets of all runs and their VAEs, so that every worker has a shard.
    let mut prepares = true;
    while std::mem::take(&mut prepares) {
        for worker in &mut workers {
            if let Some(assignment) = worker.poll().await?
                && assignment.stage.name.as_str() != "latents"
            {
                let output = worker.output(&assignment).await?;
                worker.finish(assignment, output).await?;
                prepares = true;
            }
        }
    }

    // Metric rows in batches of a worker's size, under the grants of 16 workers.
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

    // Half of the workers make claims while the other half sends heartbeats.
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

    // Connections hold the store until their tasks notice the stop.
    let store = loop {
        match common::open(dir.path()).await {
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
