//! Views of large stores, as a browser asks for them: a curve of a million values, twenty of them over each other, and pages of
//! long lists of runs. `cargo bench -p coordinator --bench views`; with `-p registry --bench curves` also the cost of storing.
//!
//! The server is a process of its own, so that its memory is its own. It is started anew for each cold call. Times are medians of
//! calls from this process over one connection.

mod common;
#[path = "common/serve.rs"]
mod serve;

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use coordinator::{Config, Coordinator};
use protocol::message::{Grant, MetricRow, Submit};
use protocol::{Attempt, Fence, Incarnation, RunId, StageName, TaskId};
use registry::{Store, Write};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions as _, Connection as _};

use crate::common::{Connection, Result};

const VALUES: u64 = 1_000_000;
const BATCH: u64 = 10_000;
const CURVES: usize = 20;
const BUCKETS: usize = 800;
/// Fewest bytes of a packed curve, and of a row in the list of runs.
const CURVE: usize = BUCKETS * 4;
const ROW: usize = 150;
/// The stage that every run has begun: others have no curves yet.
const STAGE: &str = "dataset";
/// Starts of a server, and calls of each.
const ROUNDS: usize = 9;
/// Names the store in the process that serves it.
const SERVE: &str = "STRIDE_BENCH_SERVE";

/// Fills the list of runs up to `?1`, as submissions would, without their pipelines.
const LIST: &str =
    "WITH RECURSIVE n (i) AS (SELECT count(*) FROM run_list UNION ALL SELECT i + 1 FROM n WHERE i + 1 < ?1)
    INSERT INTO run_list (run, pipeline, owner, token, state, created_ms, changed_ms, done, stages, wall_s, note)
    SELECT 'pipe' || (i % 37) || '-0a1b2c3d-' || (i + 1), 'pipe' || (i % 37),
        CASE i % 3 WHEN 0 THEN '@motion' WHEN 1 THEN 'bob' ELSE 'carol' END, 'anna',
        CASE i % 7 WHEN 0 THEN 'failed' ELSE 'finished' END, i, i + 60 - i % 50, 6, 6, 12.5,
        CASE WHEN i % 7 = 0 THEN 'vae: the loss is not finite at step ' || i ELSE 'fid: fid 0.' || i END FROM n";

/// Copies the values of the first series to the run `?1`.
const COPY: [&str; 5] = [
    "INSERT INTO recorders (run, stage, task, attempt) VALUES (?1, 'dataset', ?1 || '/dataset', 1)",
    "INSERT INTO recorded SELECT (SELECT max(id) FROM recorders), step, at_ms FROM recorded WHERE recorder = 1 AND ?1 != ''",
    "INSERT INTO series (run, stage, task, attempt, key) VALUES (?1, 'dataset', ?1 || '/dataset', 1, 'loss')",
    "INSERT INTO metrics SELECT (SELECT max(id) FROM series), step, value FROM metrics WHERE series = 1 AND ?1 != ''",
    "INSERT INTO rollups SELECT (SELECT max(id) FROM series), level, last_step, first_step, count, odd, low, high, sum, last \
     FROM rollups WHERE series = 1 AND ?1 != ''",
];

/// A server in another process.
struct Server {
    process: Child,
    address: SocketAddr,
    token: String,
}

impl Server {
    fn start(dir: &Path) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.env(SERVE, dir).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut process = command.spawn()?;
        let mut lines = BufReader::new(process.stdout.take().ok_or("a pipe")?).lines();
        let mut line = || Result::Ok(lines.next().ok_or("the server has ended")??);
        let (url, token) = (line()?, line()?);
        Ok(Self { process, address: url.trim_start_matches("http://").parse()?, token })
    }

    async fn connect(&self) -> Result<Connection> {
        Connection::open(self.address, &self.token).await
    }

    /// Resident memory in MB.
    fn resident_mb(&self) -> Result<f64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id()))?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no VmRSS")?;
        Ok(line.trim().trim_end_matches(" kB").trim().parse::<f64>()? / 1024.0)
    }

    fn stop(mut self) -> Result {
        drop(self.process.stdin.take());
        self.process.wait()?;
        Ok(())
    }
}

async fn submit_runs(dir: &Path) -> Result<Vec<RunId>> {
    let store = common::open(dir).await?;
    let handle = Coordinator::start(store, Config { alone: false, park: false, ..Config::embedded() }).await?;
    let mut runs = Vec::new();
    for seed in 0..CURVES {
        let text = format!(
            "name: views\nseed: {seed}\ndataset: {{format: synthetic, clips: {}}}\nstages: {{vae: {{kind: train.vae}}}}\n",
            100 + seed
        );
        let pipeline = pipeline::read("views.yaml", &text, &[]).map_err(|mistakes| mistakes.to_string())?;
        let pipeline = serde_json::to_value(pipeline)?;
        runs.push(handle.submit(Submit { pipeline, source: text, idempotency_key: None, until: None }).await?);
    }
    handle.shutdown().await;
    Ok(runs)
}

/// Opens the store once the tasks of its last server have ended.
async fn reopen(dir: &Path) -> Result<Store> {
    loop {
        match common::open(dir).await {
            Err(registry::OpenError::Busy { .. }) => tokio::time::sleep(Duration::from_millis(20)).await,
            opened => return Ok(opened?),
        }
    }
}

/// Stores a million values of the first run as a worker's batches are stored, and copies them to the others.
async fn fill(dir: &Path, runs: &[RunId]) -> Result {
    let store = reopen(dir).await?;
    let task = TaskId::of(&runs[0], &StageName::new(STAGE), None);
    let grant = Grant { task, attempt: Attempt(1), fence: Fence(1), worker: "w".into(), incarnation: Incarnation(1) };
    store.write(vec![Write::Fence { task: grant.task.clone(), fence: Fence(1) }]).await?;
    for first in (0..VALUES).step_by(usize::try_from(BATCH)?) {
        let value = |step: u64| (step as f64 / 1e4).sin() + (step.wrapping_mul(2_654_435_761) % 1_000) as f64 / 1e4;
        let row = |step| MetricRow { step, key: "loss".into(), value: value(step) };
        store
            .write(vec![Write::Metrics { grant: grant.clone(), rows: (first..first + BATCH).map(row).collect() }])
            .await?;
    }
    drop(store);
    let mut conn = SqliteConnectOptions::new().filename(dir.join("stride.db")).connect().await?;
    for run in &runs[1..] {
        for copy in COPY {
            sqlx::query(copy).bind(run.as_str()).execute(&mut conn).await?;
        }
    }
    sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(&mut conn).await?;
    conn.close().await?;
    Ok(())
}

async fn fill_list(dir: &Path, runs: i64) -> Result {
    let mut conn = SqliteConnectOptions::new().filename(dir.join("stride.db")).connect().await?;
    sqlx::query(LIST).bind(runs).execute(&mut conn).await?;
    conn.close().await?;
    Ok(())
}

fn median(times: &mut [Duration]) -> f64 {
    times.sort_unstable();
    times[times.len() / 2].as_secs_f64() * 1e3
}

/// Prints the first and the later times of a call, its bytes, and the memory that the first one takes.
///
/// # Errors
/// If the answer has fewer bytes than `least`: then it lacks what is measured.
async fn view(dir: &Path, title: &str, path: &str, least: usize) -> Result {
    let accept = "accept: application/octet-stream\r\n";
    let (mut cold, mut warm, mut bytes, mut memory) = (Vec::new(), Vec::new(), 0, Vec::new());
    for _ in 0..ROUNDS {
        let server = Server::start(dir)?;
        let mut connection = server.connect().await?;
        // The connection and the token are known before.
        connection.send("GET /v1/session", "", b"").await?;
        let before = server.resident_mb()?;
        let mut ask = async || {
            let begun = Instant::now();
            let length = connection.send(&format!("GET {path}"), accept, b"").await?.len();
            Result::Ok((begun.elapsed(), length))
        };
        cold.push(ask().await?.0);
        memory.push(server.resident_mb()? - before);
        let (took, length) = ask().await?;
        warm.push(took);
        if length < least {
            return Err(format!("{title}: {length} bytes; expected at least {least}").into());
        }
        bytes = length;
        server.stop()?;
    }
    memory.sort_unstable_by(f64::total_cmp);
    let (cold, warm, memory) = (median(&mut cold), median(&mut warm), memory[memory.len() / 2]);
    writeln!(std::io::stdout(), "{title:<44}{cold:8.1} ms cold{warm:8.1} ms warm{bytes:9} bytes{memory:7.1} MB more")?;
    Ok(())
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    if let Some(dir) = std::env::var_os(SERVE) {
        return serve::serve(Path::new(&dir)).await;
    }
    let dir = tempfile::tempdir()?;
    let runs = submit_runs(dir.path()).await?;
    fill(dir.path(), &runs).await?;
    let one = format!("/v1/metrics?run={}&stage={STAGE}&key=loss&buckets={BUCKETS}", runs[0]);
    let all: Vec<String> = runs.iter().map(|run| format!("run={run}")).collect();
    let all = format!("/v1/metrics?{}&stage={STAGE}&key=loss&buckets={BUCKETS}", all.join("&"));
    view(dir.path(), "1,000,000 values in 800 buckets", &one, CURVE).await?;
    view(dir.path(), "64,000 of them", &format!("{one}&from=400000&to=464000"), CURVE).await?;
    view(dir.path(), "1,000,000 values by hours", &format!("{one}&x=hours"), CURVE).await?;
    view(dir.path(), "20 runs of 1,000,000 values", &all, CURVES * CURVE).await?;
    for count in [10_000, 100_000] {
        fill_list(dir.path(), count).await?;
        for (what, query, least) in [
            ("the newest", "", 50 * ROW),
            ("by change", "&sort=changed", 50 * ROW),
            ("failed ones of a pipeline", "&state=failed&pipeline=pipe3", 38 * ROW),
            ("with words of few", "&q=step%209800", ROW),
            ("with words of none", "&q=zebra", 0),
        ] {
            let title = format!("50 of {count} runs, {what}");
            view(dir.path(), &title, &format!("/v1/runs?limit=50{query}"), least).await?;
        }
    }
    Ok(())
}
