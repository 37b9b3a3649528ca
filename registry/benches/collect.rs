//! A collection (`registry gc`) in a store with 1,000,000 results, of whose blobs 1 % are garbage: time and peak memory of
//! the process. `cargo bench -p registry --bench collect`; with `STRIDE_TEST_CATALOG=durable` the catalog is in PostgreSQL,
//! moved there by `registry migrate`.
//!
//! Each result has a manifest of its own, with one file out of 10,000 and two parents. The files of the store take 4 GB,
//! written without waiting for the disk. Their put times are two hours ago, outside the grace period.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use cluster_tests::postgres::Postgres;
use protocol::artifact::FileEntry;
use protocol::{ArtifactKind, Digest, Manifest};
use registry::{Holder, Store};
use serde_json::json;
use sqlx::sqlite::{SqliteConnectOptions, SqliteSynchronous};
use sqlx::{Connection as _, QueryBuilder, SqliteConnection};

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error>>;

const RESULTS: u64 = 1_000_000;
const FILES: u64 = 10_000;
const GARBAGE: u64 = RESULTS / 100;
/// Rows of an insertion.
const BATCH: u64 = 1_000;

fn file(number: u64) -> Vec<u8> {
    format!("weights {number}").into_bytes()
}

/// The manifest of result `number`.
fn manifest(number: u64) -> Vec<u8> {
    let bytes = file(number % FILES);
    let mut manifest = Manifest::new(ArtifactKind::Report, json!({"number": number}));
    manifest.list([("report.json".to_owned(), FileEntry::of_blob(Digest::of(&bytes), bytes.len() as u64))]);
    manifest.to_bytes()
}

/// Writes a blob where a store has it.
fn put(blobs: &Path, bytes: &[u8], at: SystemTime) -> Result<Digest> {
    let digest = Digest::of(bytes);
    let (shard, name) = (&digest.hex()[..2], &digest.hex()[2..]);
    let mut file = File::create(blobs.join(shard).join(name))?;
    file.write_all(bytes)?;
    file.set_modified(at)?;
    Ok(digest)
}

/// Records blobs as stored, as the naming of an artifact does.
async fn present(database: &mut SqliteConnection, blobs: &[Digest]) -> Result {
    let mut rows = QueryBuilder::new("INSERT INTO blobs (digest, bytes, verified_ms) ");
    rows.push_values(blobs, |mut row, blob| {
        row.push_bind(blob.to_string()).push("1").push("0");
    });
    rows.build().execute(database).await?;
    Ok(())
}

/// Fills an empty store.
async fn fill(dir: &Path) -> Result {
    drop(Store::open(dir, Holder::this_process("a bench")).await?);
    let blobs = dir.join("blobs/sha256");
    (0..=255).try_for_each(|shard| fs::create_dir_all(blobs.join(format!("{shard:02x}"))))?;
    let at = SystemTime::now() - Duration::from_secs(7200);
    let files: Vec<Digest> = (0..FILES).map(|number| put(&blobs, &file(number), at)).collect::<Result<_>>()?;
    for number in 0..GARBAGE {
        put(&blobs, format!("garbage {number}").as_bytes(), at)?;
    }
    let options = SqliteConnectOptions::new().filename(dir.join("stride.db")).synchronous(SqliteSynchronous::Off);
    let mut database = SqliteConnection::connect_with(&options).await?;
    for files in files.chunks(BATCH as usize) {
        present(&mut database, files).await?;
    }
    let mut before = [Digest::of(b"a"); 2];
    for first in (0..RESULTS).step_by(BATCH as usize) {
        let results: Vec<_> =
            (first..first + BATCH).map(|n| Ok((n, put(&blobs, &manifest(n), at)?))).collect::<Result<_>>()?;
        let parents: Vec<_> = results
            .iter()
            .flat_map(|(_, digest)| {
                let edges = before.map(|parent| (parent, *digest));
                before = [before[1], *digest];
                edges
            })
            .collect();
        let mut rows = QueryBuilder::new(
            "INSERT INTO stage_results (key, run, stage, kind, outputs, metrics, inputs, wall_s, at_ms) ",
        );
        rows.push_values(&results, |mut row, (number, digest)| {
            row.push_bind(Digest::of(&number.to_le_bytes()).to_string()).push_bind(format!("run-{}", number / 10));
            row.push_bind(format!("stage-{}", number % 10)).push_bind("evaluate.t2m");
            row.push_bind(json!({"report": digest}).to_string()).push("'{}'").push("'{}'").push("1.0").push("0");
        });
        rows.build().execute(&mut database).await?;
        let mut rows = QueryBuilder::new("INSERT INTO edges (parent, child, role) ");
        rows.push_values(parents.iter().enumerate(), |mut row, (i, (parent, child))| {
            row.push_bind(parent.to_string()).push_bind(child.to_string()).push_bind(["dataset", "model"][i % 2]);
        });
        rows.build().execute(&mut database).await?;
        let digests: Vec<Digest> = results.iter().map(|(_, digest)| *digest).collect();
        present(&mut database, &digests).await?;
        let mut rows = QueryBuilder::new("INSERT INTO manifests (digest, refers) ");
        rows.push_values(&results, |mut row, (number, digest)| {
            let refers = json!({"blobs": [files[(number % FILES) as usize]], "mentioned": []});
            row.push_bind(digest.to_string()).push_bind(refers.to_string());
        });
        rows.build().execute(&mut database).await?;
    }
    database.close().await?;
    Ok(())
}

/// Runs a command of the program, and returns its time and peak memory in bytes.
fn run(arguments: &[&OsStr]) -> Result<(Duration, u64)> {
    let mut program = Command::new(env!("CARGO_BIN_EXE_registry"));
    let begun = Instant::now();
    let mut child = program.args(arguments).stdout(Stdio::inherit()).spawn()?;
    let mut peak = 0;
    let ended = loop {
        if let Some(ended) = child.try_wait()? {
            break ended;
        }
        let status = fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<u64>().ok());
        peak = kib.map_or(peak, |kib| kib * 1024);
        std::thread::sleep(Duration::from_millis(20));
    };
    assert!(ended.success(), "{arguments:?}: {ended}");
    Ok((begun.elapsed(), peak))
}

#[tokio::main]
async fn main() -> Result {
    let dir = tempfile::tempdir()?;
    let begun = Instant::now();
    fill(dir.path()).await?;
    writeln!(std::io::stdout(), "{RESULTS} results written in {:.0?}", begun.elapsed())?;
    let folder = dir.path().as_os_str();
    if std::env::var("STRIDE_TEST_CATALOG").is_ok_and(|catalog| catalog == "durable") {
        let server = Postgres::shared().ok_or("PostgreSQL is not installed")?;
        let address = server.address(&server.create());
        let (took, _) = run(&["migrate".as_ref(), "--from".as_ref(), folder, "--to".as_ref(), address.as_ref()])?;
        writeln!(std::io::stdout(), "moved to PostgreSQL in {took:.0?}")?;
    }
    let (took, peak) = run(&["gc".as_ref(), "--store".as_ref(), folder])?;
    writeln!(std::io::stdout(), "collected in {took:.1?} with {} MB at most", peak / 1_000_000)?;
    let left = fs::read_dir(dir.path().join("blobs/sha256"))?
        .map(|shard| Ok(fs::read_dir(shard?.path())?.count() as u64))
        .collect::<Result<Vec<_>>>()?
        .iter()
        .sum::<u64>();
    assert_eq!(left, RESULTS + FILES, "all garbage and nothing else is removed");
    Ok(())
}
