//! A coordinator that has been running for long: 10,000 runs that ended and 1,000,000 facts. How many submissions a second become durable
//! before and after, how long a restart takes, and how much memory it needs. `cargo bench -p coordinator --bench many`.
//!
//! The restarted coordinator is a process of its own, so that its memory is not that of the years before.

use std::io::Write as _;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use coordinator::{Config, Control, Coordinator, Handle};
use protocol::message::Submit;
use protocol::pipeline::Pipeline;
use registry::{Holder, Store};

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

const RUNS: u64 = 10_000;
const FACTS: u64 = 1_000_000;
/// Clients at a time.
const CLIENTS: u64 = 64;
/// Submissions that are timed.
const TIMED: u64 = 2_000;

fn pipeline(seed: u64) -> Result<Pipeline> {
    let text = format!(
        "name: many\nseed: {seed}\ndataset: {{format: synthetic}}\nstages:\n  vae: {{kind: train.vae}}\n  latents: {{kind: encode.latents}}\n"
    );
    protocol::pipeline::read("many.yaml", &text, &[]).map_err(|mistakes| mistakes.to_string().into())
}

async fn start(dir: &Path) -> Result<Handle> {
    let store = Store::open(dir, Holder::this_process("a bench")).await?;
    Ok(Coordinator::start(store, Config { alone: false, park: false, ..Config::embedded() }).await?)
}

/// Submits the pipelines of `seeds` and cancels each, `CLIENTS` at a time; submissions a second.
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

/// Pauses and resumes runs until so many facts were recorded.
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

fn resident_mb() -> Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.split_whitespace().nth(1).ok_or("no number")?.parse::<u64>()? / 1024)
}

async fn shut(handle: Arc<Handle>) -> Result {
    Arc::into_inner(handle).ok_or("somebody still uses the coordinator")?.shutdown().await;
    // What waits for it lets go of the store in its own time.
    tokio::time::sleep(Duration::from_millis(200)).await;
    Ok(())
}

/// The second life: a restart, timed; and submissions.
async fn again(dir: &Path) -> Result {
    let begun = Instant::now();
    let handle = Arc::new(start(dir).await?);
    let took = begun.elapsed();
    let mut out = std::io::stdout();
    writeln!(out, "restart in {took:.2?}, resident {} MB", resident_mb()?)?;
    let rate = submit_and_cancel(&handle, 2_000_000..2_000_000 + TIMED).await?;
    writeln!(out, "then: {rate:.0} submissions a second, resident {} MB", resident_mb()?)?;
    shut(handle).await
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    if let Some(dir) = std::env::var_os("MANY_AGAIN") {
        return again(Path::new(&dir)).await;
    }
    let mut out = std::io::stdout();
    let dir = tempfile::tempdir()?;
    let handle = Arc::new(start(dir.path()).await?);
    let rate = submit_and_cancel(&handle, 1_000_000..1_000_000 + TIMED).await?;
    writeln!(out, "an empty store: {rate:.0} submissions a second (each with its cancellation), {CLIENTS} clients")?;
    submit_and_cancel(&handle, 0..RUNS - TIMED).await?;
    let begun = Instant::now();
    record_facts(&handle, FACTS).await?;
    writeln!(
        out,
        "{RUNS} runs ended, {} facts recorded; the facts beyond the runs took {:.0?}",
        handle.facts(),
        begun.elapsed()
    )?;
    shut(handle).await?;
    let mut child = std::process::Command::new(std::env::current_exe()?);
    let ended = child.env("MANY_AGAIN", dir.path()).status()?;
    if ended.success() { Ok(()) } else { Err("the second life failed".into()) }
}
