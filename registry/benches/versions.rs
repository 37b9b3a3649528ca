//! Versions registered a second: by one caller, by many at once, and by importing bundles with their files.
//! `cargo bench -p registry --bench versions`.
//!
//! Each version has an artifact of its own, whose files are stored before the time is taken, as a training has stored
//! them when its version is registered. A version counts once it is durable.

use std::io::Write as _;
use std::time::Instant;

use protocol::ModelName;
use registry::testing::{Whole, archive, compressed};
use registry::{Holder, Store, Write};
use tokio::task::JoinSet;

type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Versions of each measurement.
const VERSIONS: usize = 512;
/// Callers that register at once.
const CALLERS: usize = 64;

/// Stores the files of versions `of` and returns the writes that register them.
fn stored(store: &Store, of: std::ops::Range<usize>) -> Result<Vec<Write>> {
    let mut writes = Vec::with_capacity(of.len());
    for number in of {
        let whole = Whole::of(number.to_le_bytes().to_vec());
        store.blobs().put(&whole.manifest.to_bytes())?;
        for bytes in whole.files.values() {
            store.blobs().put(bytes)?;
        }
        let metrics = [("fid".to_owned(), 1.0 / (1.0 + number as f64))].into();
        let model = ModelName::new("quick");
        writes.push(Write::Version { model, artifact: whole.head.artifact, metrics, source: whole.head.source });
    }
    Ok(writes)
}

/// Registers versions by `callers` at once and returns versions a second. Each caller waits for a version before the next.
async fn registered(store: &Store, writes: Vec<Write>, callers: usize) -> Result<f64> {
    let (count, begun) = (writes.len(), Instant::now());
    let mut tasks = JoinSet::new();
    for part in writes.chunks(count.div_ceil(callers)) {
        let (store, part) = (store.clone(), part.to_vec());
        tasks.spawn(async move {
            for write in part {
                store.write(vec![write]).await?;
            }
            std::result::Result::<(), registry::WriteError>::Ok(())
        });
    }
    while let Some(done) = tasks.join_next().await {
        done??;
    }
    Ok(count as f64 / begun.elapsed().as_secs_f64())
}

/// Imports bundles one after the other and returns versions a second.
async fn imported(store: &Store, of: std::ops::Range<usize>) -> Result<f64> {
    let file = tempfile::NamedTempFile::new()?;
    let bundles: Vec<_> =
        of.map(|number| compressed(&archive(&Whole::of(number.to_le_bytes().to_vec()).entries()))).collect();
    let begun = Instant::now();
    for bundle in &bundles {
        std::fs::write(file.path(), bundle)?;
        store.import_bundle(file.path(), None).await?;
    }
    Ok(bundles.len() as f64 / begun.elapsed().as_secs_f64())
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("a bench")).await?;
    let mut out = std::io::stdout();
    let one = stored(&store, 0..VERSIONS)?;
    writeln!(out, "{:<40}{:8.0} versions/s", "one caller", registered(&store, one, 1).await?)?;
    let many = stored(&store, VERSIONS..8 * VERSIONS)?;
    let speed = registered(&store, many, CALLERS).await?;
    writeln!(out, "{:<40}{speed:8.0} versions/s", format!("{CALLERS} callers"))?;
    let speed = imported(&store, 8 * VERSIONS..9 * VERSIONS).await?;
    writeln!(out, "{:<40}{speed:8.0} versions/s", "one caller, bundles with their files")?;
    Ok(())
}
