//! Rows that a catalog returns.

use std::collections::{BTreeMap, HashMap};

use protocol::message::{RunState, RunSummary};
use protocol::{Attempt, Digest, Group, Manifest, RunId, StageName, TaskId, WorkerId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::history::HistoryEntry;

/// A stored run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRow {
    pub run: RunId,
    /// The validated pipeline.
    pub pipeline: Value,
    /// The YAML as written.
    pub source: String,
    /// `running`, `paused`, `finished`, `failed`, `cancelled`.
    pub state: String,
    /// Unique if given.
    pub idempotency_key: Option<String>,
    /// Digest of the submission as it was sent, if it had an idempotency key.
    pub submission: Option<String>,
    /// Time of submission, in milliseconds since 1970.
    pub created_ms: i64,
    /// Time of the last change, in milliseconds since 1970.
    pub updated_ms: i64,
}

/// A part of the list of runs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RunListQuery {
    /// Only runs in one of these states; all, if there are none.
    pub states: Vec<RunState>,
    /// Only runs of this pipeline, and of this group of tokens.
    pub pipeline: Option<String>,
    pub owner: Option<Group>,
    /// Only runs whose name, pipeline, owner or note contains each of these words, in any case.
    pub words: String,
    pub order: RunOrder,
    /// [`RunPage::next`] of an earlier answer to the same question.
    pub after: Option<String>,
    pub limit: u32,
}

/// Order of a list of runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RunOrder {
    /// The newest submission first.
    #[default]
    Newest,
    /// The oldest submission first.
    Oldest,
    /// The newest change of a run's state first.
    Changed,
}

/// Some runs of a list.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunPage {
    pub rows: Vec<RunSummary>,
    /// Place at which the list continues, unless this is its end. A search may return few rows and still continue.
    pub next: Option<String>,
}

/// Data from which a coordinator recovers, with decision numbers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovery {
    /// The newest snapshot, with its number.
    pub snapshot: Option<(u64, String)>,
    /// Parts of the snapshot by name.
    pub parts: BTreeMap<String, String>,
    /// Facts with their numbers, oldest first; only those after the snapshot apply.
    pub facts: Vec<(u64, String)>,
}

/// A part of the history.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct HistoryQuery {
    /// Only what happened to this run, and to this worker.
    pub run: Option<RunId>,
    pub worker: Option<WorkerId>,
    /// The row after which it begins.
    pub after: i64,
    /// The time from which on, in milliseconds since 1970.
    pub since_ms: Option<i64>,
    pub limit: u32,
}

/// An event as stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct HistoryRow {
    /// Grows from row to row.
    pub id: i64,
    /// In milliseconds since 1970.
    pub at_ms: i64,
    #[serde(flatten)]
    pub entry: HistoryEntry,
}

/// Stored data of an ended run. Only the coordinator interprets it; see [`Write::RunEnded`](crate::Write::RunEnded).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndedRow {
    /// The run as clients see it.
    pub view: String,
    /// The run as the coordinator resumes it.
    pub archive: String,
}

/// A stored result: what a run has computed under a stage's key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageResultRow {
    /// The stage's key.
    pub key: Digest,
    /// The run that computed it.
    pub run: RunId,
    /// The stage that computed it.
    pub stage: StageName,
    pub kind: String,
    /// Outputs by name.
    pub outputs: BTreeMap<String, Digest>,
    /// Final metrics by name.
    pub metrics: BTreeMap<String, f64>,
    /// Digests of the inputs by name.
    pub inputs: BTreeMap<String, Digest>,
    /// Working time in seconds.
    pub wall_s: f64,
    /// Time of the commit, in milliseconds since 1970.
    pub at_ms: i64,
}

/// A committed checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckpointRow {
    pub task: TaskId,
    /// The attempt that saved it.
    pub attempt: Attempt,
    /// Number of applied steps.
    pub step: u64,
    pub manifest: Digest,
    /// Values by which retention may rank checkpoints.
    pub metrics: BTreeMap<String, f64>,
    /// Time of the commit, in milliseconds since 1970.
    pub at_ms: i64,
}

/// The amounts that a run has ever stored, including those that were deleted since.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of log lines.
    pub log_bytes: u64,
    /// Number of values by step.
    pub values: u64,
}

/// The artifacts of one kind that the store knows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, JsonSchema)]
pub struct KindSize {
    /// The kind, such as `model`.
    pub kind: String,
    /// Number of artifacts.
    pub count: u64,
    /// Their bytes; files that several have count for each.
    pub bytes: u64,
}

/// A stored log line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LogRow {
    /// Increasing number; a reader continues after the last one it has seen.
    pub id: i64,
    pub task: TaskId,
    pub attempt: Attempt,
    /// The worker that wrote it.
    pub worker: WorkerId,
    /// Line number within attempt and worker.
    pub line: u64,
    /// Time of storing, in milliseconds since 1970.
    pub at_ms: i64,
    pub text: String,
}

/// An artifact with the artifacts it was made from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LineageNode {
    pub digest: Digest,
    /// Kind of the artifact, if a stage made it.
    pub kind: Option<String>,
    /// The run that made it.
    pub run: Option<String>,
    /// The stage that made it.
    pub stage: Option<String>,
    /// Key of that stage.
    pub key: Option<String>,
    /// Total bytes of its files.
    pub bytes: Option<u64>,
    /// Artifacts it was made from, by the field that named them.
    pub inputs: BTreeMap<String, Digest>,
    /// Distance from the requested artifact.
    pub depth: u32,
}

/// Digests that the manifest of an artifact names.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct References {
    /// Blobs of its files.
    pub blobs: Vec<Digest>,
    /// Digests in its `meta`; each may be an artifact.
    pub mentioned: Vec<Digest>,
}

impl References {
    /// Reads them from a manifest. If this finds more, a migration must empty the table `manifests`.
    pub(crate) fn of(manifest: &Manifest) -> Self {
        Self { blobs: manifest.blobs().map(|blob| blob.digest).collect(), mentioned: manifest.mentions() }
    }
}

/// Blobs that the rows need, as of one moment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Needs {
    /// Artifacts that rows name and whose blobs must be whole, sorted and without repetition. Those of `done_shards` are
    /// left out.
    pub roots: Vec<Digest>,
    /// Artifacts that each artifact was made from, without roots.
    pub parents: HashMap<Digest, Vec<Digest>>,
    /// Tasks whose shards a collection deletes, because the artifact of their finished stage replaces them.
    pub done_shards: Vec<TaskId>,
    /// True while a run is under way.
    pub live: bool,
}
