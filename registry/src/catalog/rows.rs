//! What a catalog answers with.

use std::collections::{BTreeMap, HashMap};

use protocol::{Attempt, Digest, RunId, StageName, TaskId, WorkerId};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A run as stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRow {
    /// Which.
    pub run: RunId,
    /// The validated pipeline.
    pub pipeline: Value,
    /// The YAML as written.
    pub source: String,
    /// `running`, `paused`, `finished`, `failed`, `cancelled`.
    pub state: String,
    /// Unique when given.
    pub idempotency_key: Option<String>,
    /// When it was submitted, in milliseconds since 1970.
    pub created_ms: i64,
    /// When it last changed, in milliseconds since 1970.
    pub updated_ms: i64,
}

/// What a coordinator recovers from, each with the number of its decision.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovery {
    /// The newest snapshot.
    pub snapshot: Option<(u64, String)>,
    /// Its parts by name.
    pub parts: BTreeMap<String, String>,
    /// Facts, oldest first; those after the snapshot count.
    pub facts: Vec<(u64, String)>,
}

/// What is kept of a run that ended. What each says is the coordinator's business; see [`Write::RunEnded`](crate::Write::RunEnded).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndedRow {
    /// The run as clients see it.
    pub view: String,
    /// The run as the coordinator takes it up again.
    pub archive: String,
}

/// A stage's value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageResultRow {
    /// The stage's key.
    pub key: Digest,
    /// Which run made it.
    pub run: RunId,
    /// Which stage.
    pub stage: StageName,
    pub kind: String,
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final values.
    pub metrics: BTreeMap<String, f64>,
    /// What it was made of.
    pub inputs: BTreeMap<String, Digest>,
    /// Seconds of work.
    pub wall_s: f64,
    /// When, in milliseconds since 1970.
    pub at_ms: i64,
}

/// A committed checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckpointRow {
    pub task: TaskId,
    /// Which attempt saved it.
    pub attempt: Attempt,
    /// Steps applied.
    pub step: u64,
    pub manifest: Digest,
    /// Values that retention may rank by.
    pub metrics: BTreeMap<String, f64>,
    /// When, in milliseconds since 1970.
    pub at_ms: i64,
}

/// The amounts that a run has ever stored, including those that were deleted since.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of log lines.
    pub log_bytes: u64,
    /// Values by step.
    pub values: u64,
}

/// A log line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogRow {
    /// Grows; ask for what comes after the last one seen.
    pub id: i64,
    pub task: TaskId,
    /// The try.
    pub attempt: Attempt,
    /// Who wrote it.
    pub worker: WorkerId,
    /// Its number within attempt and worker.
    pub line: u64,
    /// When it was stored, in milliseconds since 1970.
    pub at_ms: i64,
    /// The line.
    pub text: String,
}

/// An artifact and what it was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LineageNode {
    /// The artifact.
    pub digest: Digest,
    /// Its kind, if a stage made it.
    pub kind: Option<String>,
    /// The run that made it.
    pub run: Option<String>,
    /// The stage that made it.
    pub stage: Option<String>,
    /// Its stage's key.
    pub key: Option<String>,
    /// Bytes of its files.
    pub bytes: Option<u64>,
    /// What it was made of, by the field that named it.
    pub inputs: BTreeMap<String, Digest>,
    /// How many steps from the artifact asked for.
    pub depth: u32,
}

/// A digest that a row names, so that it must be whole.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Root {
    /// The manifest.
    pub digest: Digest,
    /// The row in words.
    pub what: String,
    /// The task, if the row is a shard.
    pub shard: Option<TaskId>,
}

/// What the rows need of the blobs, as of one moment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Needs {
    /// What rows name.
    pub roots: Vec<Root>,
    /// What each artifact was made of.
    pub parents: HashMap<Digest, Vec<Digest>>,
    /// Shards that a collection forgets, by task: the artifact of their finished stage stands for them.
    pub done_shards: Vec<TaskId>,
    /// Whether a run is under way.
    pub live: bool,
}
