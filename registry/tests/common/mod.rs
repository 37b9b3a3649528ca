//! Shared helpers of this crate's tests.
#![allow(dead_code, unreachable_pub, reason = "not every test file uses all of it")]

pub mod database_power;
pub mod power;

use std::collections::BTreeMap;

use protocol::message::{Grant, MetricRow};
use protocol::{ArtifactKind, Attempt, Digest, Fence, FileEntry, Incarnation, Manifest, TaskId};
use registry::blob::Backend;
use registry::{BlobStore, Holder, LeaseTerms, OpenError, Store, Write};
use serde_json::json;

/// Opens a store. Retries while it is busy, because a child process of another test may briefly inherit a released
/// lock.
pub async fn try_open(dir: &std::path::Path) -> Result<Store, OpenError> {
    cluster_tests::postgres::place_catalog(dir);
    let until = std::time::Instant::now() + std::time::Duration::from_secs(10);
    loop {
        match Store::open(dir, Holder::this_process("test")).await {
            Err(OpenError::Busy { .. }) if std::time::Instant::now() < until => tokio::task::yield_now().await,
            opened => return opened,
        }
    }
}

/// Opens a store over the test's backend of blobs.
pub async fn open_over(dir: &std::path::Path, blobs: std::sync::Arc<dyn Backend>) -> Store {
    let until = std::time::Instant::now() + std::time::Duration::from_secs(10);
    loop {
        let blobs = std::sync::Arc::clone(&blobs);
        match Store::open_over(dir, blobs, Holder::this_process("test"), LeaseTerms::default()).await {
            Err(OpenError::Busy { .. }) if std::time::Instant::now() < until => tokio::task::yield_now().await,
            opened => return opened.unwrap(),
        }
    }
}

pub async fn open(dir: &std::path::Path) -> Store {
    try_open(dir).await.unwrap()
}

/// Uploads an artifact with one file.
pub fn artifact(blobs: &BlobStore, kind: ArtifactKind, content: &str) -> Digest {
    let bytes = content.as_bytes();
    let mut manifest = Manifest::new(kind, json!({}));
    let digest = blobs.put(bytes).unwrap();
    manifest.files.insert("content".into(), FileEntry::of_blob(digest, bytes.len() as u64));
    blobs.put(&manifest.to_bytes()).unwrap()
}

pub fn grant(task: &str, fence: u64) -> Grant {
    Grant {
        task: TaskId::new(task),
        attempt: Attempt(fence),
        fence: Fence(fence),
        worker: "w".into(),
        incarnation: Incarnation(1),
    }
}

pub fn fence(task: &str, fence: u64) -> Write {
    Write::Fence { task: TaskId::new(task), fence: Fence(fence) }
}

/// The row of run `r` in a state.
pub fn run_in(state: &str) -> Write {
    let (run, source, idempotency_key) = ("r".into(), String::new(), None);
    Write::Run { run, pipeline: json!({}), source, state: state.into(), idempotency_key }
}

/// A write that no other row refers to.
pub fn note(what: impl Into<serde_json::Value>) -> Write {
    static NEXT: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(1);
    let seq = NEXT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    Write::Facts { seq, facts: what.into().to_string() }
}

/// Returns all notes in the order in which they were stored.
pub async fn notes(store: &Store) -> Vec<serde_json::Value> {
    let facts = store.recovery().await.unwrap().facts;
    facts.iter().map(|(_, text)| serde_json::from_str(text).unwrap()).collect()
}

pub fn metrics(pairs: &[(&str, f64)]) -> BTreeMap<String, f64> {
    pairs.iter().map(|(key, value)| ((*key).to_owned(), *value)).collect()
}

pub fn version(model: &str, artifact: Digest, fid: f64) -> Write {
    Write::Version {
        model: model.into(),
        artifact,
        metrics: metrics(&[("latent_fid", fid)]),
        source: json!({"run": "r", "stage": "release", "metric": "latent_fid", "mode": "min"}),
    }
}

/// Values of one curve.
pub fn rows(steps: std::ops::Range<u64>, value: f64) -> Vec<MetricRow> {
    steps.map(|step| MetricRow { step, key: "loss".into(), value }).collect()
}

/// A stage's value computed by the coordinator.
pub fn result(key: &str, output: Digest) -> Write {
    Write::StageResult {
        grant: None,
        key: Digest::of(key.as_bytes()),
        run: "r".into(),
        stage: "s".into(),
        kind: "train.vae".into(),
        outputs: [("vae".to_owned(), output)].into(),
        metrics: metrics(&[("loss", 0.5), ("bad", f64::NAN)]),
        inputs: [("dataset".to_owned(), Digest::of(b"data"))].into(),
        wall_s: 1.5,
    }
}
