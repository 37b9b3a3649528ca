//! Forgetting runs that have ended: their rows go, and their blobs with the next collection. What each may take:
//!
//! | what | goes |
//! |---|---|
//! | a checkpoint | as its stage's `checkpoint.keep` says, while it is trained |
//! | a shard | once its run is finished |
//! | the values, states, logs and curves of a sweep's trials that are not the best | with the run, or before it by [`Store::forget_leftovers`] |
//! | checkpoints, shards, logs and curves of work that was cancelled, failed or taken over and has no value | likewise |
//! | everything else of a run | with the run |
//! | a model version, and what it was made of | never |
//!
//! A stage of the run stays, with all its rows, as long as somebody needs it: a model version or a pin whose lineage it is in,
//! another run that has its value, or a run under way that has a stage of its name and may be about to use it. What stays is
//! looked at again whenever a run is forgotten.

use serde::{Deserialize, Serialize};

/// What went of a run.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Forgotten {
    /// Values by step.
    pub values: u64,
    /// Log lines.
    pub lines: u64,
    pub checkpoints: u64,
    /// Values of stages; their artifacts are collected next.
    pub results: u64,
    /// Stages that somebody still needs, as `run/stage`.
    pub kept: Vec<String>,
}
