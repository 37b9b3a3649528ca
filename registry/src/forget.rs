//! Deletion of ended runs: their rows are deleted now, their blobs by the next collection. Each kind of data is deleted
//! at its time:
//!
//! | data | deleted |
//! |---|---|
//! | a checkpoint | while its stage trains, by the stage's `checkpoint.keep` |
//! | a shard | once its run is finished |
//! | the values, states, logs and curves of a sweep's trials that are not the best | with the run, or earlier by [`Store::forget_leftovers`] |
//! | checkpoints, shards, logs and curves of cancelled, failed or replaced work without a value | likewise |
//! | everything else of a run | with the run |
//! | a model version, and its lineage | never |
//!
//! A stage of the run stays, with all its rows, as long as one of these holds:
//!
//! - A model version or a pin has the stage in its lineage.
//! - Another run has the stage's value.
//! - A running run has a stage of the same name and may be about to use the value.
//!
//! Stages that stayed are checked again whenever a run is forgotten.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Counts of deleted rows, and the stages that were kept.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Forgotten {
    /// Number of metric values.
    pub values: u64,
    /// Number of log lines.
    pub lines: u64,
    pub checkpoints: u64,
    /// Number of stage values; the next collection removes their artifacts.
    pub results: u64,
    /// Stages that are still needed, as `run/stage`.
    pub kept: Vec<String>,
}
