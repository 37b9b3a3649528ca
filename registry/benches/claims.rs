//! Benchmark of claims (a fence and a fact, durable before the answer) per second, by number of concurrent callers. Run
//! it with `cargo bench -p registry`.

use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use protocol::message::{Grant, MetricRow};
use protocol::{Attempt, Fence, Incarnation, TaskId};
use registry::{Holder, Store, Write};
use serde_json::json;

/// On one thread, so that writes are sent in the order of their decisions, as a coordinator sends them.
#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let dir = tempfile::tempdir()?;
    let store = Store::open(dir.path(), Holder::this_process("bench")).await?;
    let mut out = std::io::stdout().lock();
    let decisions = Arc::new(AtomicU64::new(0));
    for (round, callers) in [1_u64, 8, 64, 256].into_iter().enumerate() {
        let each = (2000 / callers).max(20);
        let started = Instant::now();
        let tasks: Vec<_> = (0..callers)
            .map(|caller| {
                let (store, decisions) = (store.clone(), Arc::clone(&decisions));
                tokio::spawn(async move {
                    for fence in 1..=each {
                        let task = TaskId::new(format!("r{round}/s/{caller}"));
                        let seq = decisions.fetch_add(1, Ordering::Relaxed) + 1;
                        let writes = vec![
                            Write::Fence { task, fence: Fence(fence) },
                            Write::Facts { seq, facts: json!({ "fence": fence }).to_string() },
                        ];
                        store.write(writes).await?;
                    }
                    Ok::<_, registry::WriteError>(())
                })
            })
            .collect();
        for task in tasks {
            task.await??;
        }
        let seconds = started.elapsed().as_secs_f64();
        writeln!(out, "{callers:>4} callers: {:>8.0} claims/s", (callers * each) as f64 / seconds)?;
    }

    let grant = Grant {
        task: TaskId::new("m/s"),
        attempt: Attempt(1),
        fence: Fence(1),
        worker: "w".into(),
        incarnation: Incarnation(1),
    };
    store.write(vec![Write::Fence { task: grant.task.clone(), fence: Fence(1) }]).await?;
    let started = Instant::now();
    for batch in 0..50 {
        let row = |i: u64| MetricRow { step: batch * 1000 + i, key: "loss".into(), value: 0.5 };
        store.write(vec![Write::Metrics { grant: grant.clone(), rows: (0..1000).map(row).collect() }]).await?;
    }
    writeln!(out, "metrics in batches of 1000: {:.0} values/s", 50_000.0 / started.elapsed().as_secs_f64())?;
    Ok(())
}
