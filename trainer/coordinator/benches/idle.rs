//! A thousand workers without work, each with a poll that the server holds as long as it may. Measures what that costs the
//! server. `cargo bench -p coordinator --bench idle`.
//!
//! The workers are in this process too, on a thread of their own, whose processor time is not counted.

mod common;

use std::fs;
use std::io::Write as _;
use std::time::{Duration, Instant};

use coordinator::{Config, Coordinator};
use tokio::runtime::Runtime;

use crate::common::{Result, Worker};

const WORKERS: usize = 1000;
const MEASURED: Duration = Duration::from_secs(30);
const CLIENTS: &str = "bench-clients";
/// The unit of processor time in `/proc`, in seconds.
const TICK: f64 = 0.01;

/// Processor time of the threads of this process that are not the clients'.
fn server_time() -> Result<f64> {
    let mut ticks = 0;
    for thread in fs::read_dir("/proc/self/task")? {
        let thread = thread?.path();
        if fs::read_to_string(thread.join("comm"))?.trim() == CLIENTS {
            continue;
        }
        let stat = fs::read_to_string(thread.join("stat"))?;
        let fields = stat.rsplit_once(')').ok_or("no name in the statistics of a thread")?.1;
        for field in fields.split_whitespace().skip(11).take(2) {
            ticks += field.parse::<u64>()?;
        }
    }
    Ok(ticks as f64 * TICK)
}

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Result {
    let clients: Runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name(CLIENTS).enable_all().build()?;
    let dir = tempfile::tempdir()?;
    let store = common::open(dir.path()).await?;
    coordinator::shell::raise_descriptor_limit();
    let handle = Coordinator::start(store, Config { alone: false, park: false, ..Config::embedded() }).await?;
    let (address, token) = (handle.address(), handle.token().secret().to_owned());
    let joining = clients.spawn(async move {
        for i in 0..WORKERS {
            let mut worker = Worker::join(address, &token, i).await?;
            tokio::spawn(async move { while worker.wait().await.is_ok() {} });
        }
        Result::Ok(())
    });
    joining.await??;
    // The first polls end together; later ones are spread.
    tokio::time::sleep(Duration::from_secs(5)).await;
    let (begun, before) = (Instant::now(), server_time()?);
    tokio::time::sleep(MEASURED).await;
    let share = (server_time()? - before) / begun.elapsed().as_secs_f64();
    writeln!(std::io::stdout(), "{WORKERS} idle workers cost the server {:.1} % of a core", share * 100.0)?;
    clients.shutdown_background();
    handle.shutdown().await;
    Ok(())
}
