//! Curves of a million values: how fast values are stored with their roll-ups and without, and how long a curve takes to read.
//! `cargo bench -p registry --bench curves`.
//!
//! Values without roll-ups go into a database of the same schema by the statements that a writer of rows alone needs, in turns with those
//! that a store takes. Curves are read by a store that has just been opened.

use std::io::Write as _;
use std::path::Path;
use std::time::{Duration, Instant};

use protocol::message::{Grant, MetricRow};
use protocol::{Attempt, Fence, Incarnation, TaskId};
use registry::{Axis, Holder, ReadStore, Store, Window, Write};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{Connection as _, QueryBuilder, Sqlite, SqliteConnection};

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error>>;

const VALUES: u64 = 1_000_000;
const BATCH: u64 = 1_000;
/// Keys of a stage; the first has all values, the others what a trainer records beside it.
const KEYS: u64 = 20;
const BUCKETS: usize = 800;
/// Number of reads of a curve.
const TIMES: usize = 9;

fn grant(task: &str) -> Grant {
    let task = TaskId::new(task);
    Grant { task, attempt: Attempt(1), fence: Fence(1), worker: "w".into(), incarnation: Incarnation(1) }
}

fn value(step: u64) -> f64 {
    (step as f64 / 1e4).sin() + (step.wrapping_mul(2_654_435_761) % 1_000) as f64 / 1e4
}

/// The rows of a batch: of one key, or of `KEYS` as a trainer sends them that records every step.
fn batch(first: u64, keys: u64) -> Vec<MetricRow> {
    let row =
        |i: u64| MetricRow { step: first / keys + i / keys, key: format!("key-{}", i % keys), value: value(first + i) };
    (0..BATCH).map(row).collect()
}

/// A writer of rows alone.
struct Plain(SqliteConnection);

impl Plain {
    async fn open(dir: &Path) -> Result<Self> {
        drop(Store::open(dir, Holder::this_process("bench")).await?);
        let options = SqliteConnectOptions::new().filename(dir.join("stride.db")).journal_mode(SqliteJournalMode::Wal);
        let options = options.synchronous(SqliteSynchronous::Full).foreign_keys(true).statement_cache_capacity(200);
        Ok(Self(SqliteConnection::connect_with(&options).await?))
    }

    async fn write(&mut self, task: &str, rows: &[MetricRow]) -> Result {
        let conn = &mut self.0;
        sqlx::query("BEGIN IMMEDIATE").execute(&mut *conn).await?;
        sqlx::query("UPDATE store SET commits = commits + 1").execute(&mut *conn).await?;
        sqlx::query("SELECT fence FROM fences WHERE task = ?").bind(task).fetch_optional(&mut *conn).await?;
        let mut all = Vec::new();
        let mut known = std::collections::BTreeMap::new();
        for row in rows {
            if !known.contains_key(row.key.as_str()) {
                let add = "INSERT INTO series (run, stage, task, attempt, key) VALUES ('r', 's', ?1, 1, ?2) ON CONFLICT DO NOTHING";
                sqlx::query(add).bind(task).bind(&row.key).execute(&mut *conn).await?;
                let find = sqlx::query_scalar("SELECT id FROM series WHERE task = ? AND attempt = 1 AND key = ?");
                let id: i64 = find.bind(task).bind(&row.key).fetch_one(&mut *conn).await?;
                known.insert(row.key.as_str(), id);
            }
            all.push((known[row.key.as_str()], i64::try_from(row.step)?, row.value));
        }
        for rows in all.chunks(250) {
            let mut insert = QueryBuilder::<Sqlite>::new("INSERT INTO metrics (series, step, value) ");
            insert.push_values(rows, |mut row, (id, step, value)| {
                row.push_bind(*id).push_bind(*step).push_bind(*value);
            });
            insert.push(" ON CONFLICT DO NOTHING").build().persistent(false).execute(&mut *conn).await?;
        }
        let usage = "INSERT INTO usage (run, \"values\") VALUES ('r', ?1) ON CONFLICT (run) DO UPDATE SET \"values\" = \"values\" + ?1";
        sqlx::query(usage).bind(i64::try_from(rows.len())?).execute(&mut *conn).await?;
        sqlx::query("COMMIT").execute(&mut *conn).await?;
        Ok(())
    }
}

/// Resident memory of this process.
fn resident_mb() -> Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.trim().trim_end_matches(" kB").trim().parse::<f64>()? / 1024.0)
}

#[tokio::main]
async fn main() -> Result {
    let (dir, other) = (tempfile::tempdir()?, tempfile::tempdir()?);
    let mut out = std::io::stdout().lock();
    let store = Store::open(dir.path(), Holder::this_process("bench")).await?;
    let mut plain = Plain::open(other.path()).await?;
    for (name, task, keys) in [("one key", "one/s", 1), ("20 keys", "many/s", KEYS)] {
        let grant = grant(task);
        store.write(vec![Write::Fence { task: grant.task.clone(), fence: Fence(1) }]).await?;
        let mut spent = [Duration::ZERO; 2];
        for number in 0..VALUES / BATCH {
            let rows = batch(number * BATCH, keys);
            let started = Instant::now();
            plain.write(task, &rows).await?;
            spent[0] += started.elapsed();
            let started = Instant::now();
            store.write(vec![Write::Metrics { grant: grant.clone(), rows }]).await?;
            spent[1] += started.elapsed();
        }
        let [alone, rolled] = spent.map(|spent| VALUES as f64 / spent.as_secs_f64());
        writeln!(
            out,
            "{name}, batches of {BATCH}: {alone:.0} values/s alone, {rolled:.0} with roll-ups ({:+.1} %)",
            (rolled / alone - 1.0) * 100.0
        )?;
    }
    drop(store);

    let before = resident_mb()?;
    let window = Window { axis: Axis::Step, from: None, to: None, buckets: BUCKETS };
    let zoomed = Window { from: Some(400_000.0), to: Some(464_000.0), ..window };
    let near = Window { from: Some(400_000.0), to: Some(410_000.0), ..window };
    let times = Window { axis: Axis::Hours, ..window };
    let one = ["key-0".to_owned()];
    for (name, run, keys, window) in [
        ("1,000,000 values", "one", Some(&one[..]), window),
        ("64,000 of them", "one", Some(&one[..]), zoomed),
        ("10,000 of them", "one", Some(&one[..]), near),
        ("all by hours", "one", Some(&one[..]), times),
        ("20 curves of 50,000 values", "many", None, window),
    ] {
        // The fastest of several, for the machine does other work. A store that was just opened has read nothing.
        let (mut cold, mut warm, mut rows) = (Duration::MAX, Duration::MAX, 0);
        for _ in 0..TIMES {
            let opened = ReadStore::open(dir.path()).await?;
            let started = Instant::now();
            opened.buckets(&run.into(), &"s".into(), keys, &window).await?;
            cold = cold.min(started.elapsed());
            let started = Instant::now();
            let curves = opened.buckets(&run.into(), &"s".into(), keys, &window).await?;
            warm = warm.min(started.elapsed());
            rows = curves.values().map(|curve| curve.x.len()).sum();
            opened.close().await;
        }
        let [cold, warm] = [cold, warm].map(|took| took.as_secs_f64() * 1e3);
        writeln!(out, "{name}: {rows} buckets, {cold:.1} ms cold, {warm:.1} ms warm")?;
    }
    writeln!(out, "memory: {:+.1} MB", resident_mb()? - before)?;
    Ok(())
}
