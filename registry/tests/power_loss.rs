//! The database survives a power loss with all acknowledged data.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use common::database_power::{lose_power, stand_between};
use common::{artifact, open, version};
use protocol::ArtifactKind;
use registry::Write;
use serde_json::json;

fn run(number: u32) -> Write {
    Write::Run {
        run: number.to_string().as_str().into(),
        pipeline: json!({}),
        source: "x".repeat(60_000),
        state: "running".into(),
        idempotency_key: None,
    }
}

/// Writers continue through repeated power losses and several cycles of the database's log. Sampled: 12 moments.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn p2_what_the_database_has_acknowledged_outlives_a_loss_of_power() {
    stand_between();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().canonicalize().unwrap();
    let store = open(&path).await;
    let model = artifact(store.blobs(), ArtifactKind::Model, "model");
    store.write(vec![version("m", model, 0.5)]).await.unwrap();
    let acknowledged = Arc::new(Mutex::new(BTreeSet::new()));
    let mut writers = Vec::new();
    for writer in 0..4 {
        let (store, acknowledged) = (store.clone(), Arc::clone(&acknowledged));
        writers.push(tokio::spawn(async move {
            for i in 0..30 {
                let number = writer * 1000 + i;
                store.write(vec![run(number)]).await.unwrap();
                acknowledged.lock().unwrap().insert(number);
            }
        }));
    }
    for moment in 1..=12 {
        while acknowledged.lock().unwrap().len() < moment * 10 {
            tokio::task::yield_now().await;
        }
        // Taken before the power loss; later acknowledgements need not survive.
        let expected = acknowledged.lock().unwrap().clone();
        let after = tempfile::tempdir().unwrap();
        lose_power(&path, after.path());
        let left = open(after.path()).await;
        let found: BTreeSet<u32> =
            left.runs().await.unwrap().iter().map(|row| row.run.as_str().parse().unwrap()).collect();
        let lost: Vec<_> = expected.difference(&found).collect();
        assert!(lost.is_empty(), "of {} acknowledged {lost:?} are lost", expected.len());
        assert_eq!(left.resolve("m:1").await.unwrap().artifact, model);
        assert!(left.fsck().await.unwrap().problems.is_empty());
    }
    for writer in writers {
        writer.await.unwrap();
    }
}
