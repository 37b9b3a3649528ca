//! What cannot change a stage's value: where it runs and how often it saves.

use serde::{Deserialize, Serialize};

use crate::Steps;

/// What cannot change a stage's value: where it runs and how often it saves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
#[serde(default)]
pub struct Placement {
    /// How many workers a gang takes.
    pub workers: WorkerRange,
    /// Checkpoint cadence and retention.
    pub checkpoint: CheckpointPolicy,
}

/// How many workers a gang takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct WorkerRange {
    /// Below this many it yields and waits.
    pub min: usize,
    /// Above this many it takes no more; 0 is no bound.
    pub max: usize,
}

impl Default for WorkerRange {
    fn default() -> Self {
        Self { min: 1, max: 0 }
    }
}

/// When checkpoints are saved and which are kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct CheckpointPolicy {
    /// Saved after every so many steps; 0 saves only when the stage yields.
    pub every: Steps,
    /// Kept.
    pub keep: Keep,
}

impl Default for CheckpointPolicy {
    fn default() -> Self {
        Self { every: Steps(2000), keep: Keep::default() }
    }
}

/// Which checkpoints of a task are kept; the union.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Keep {
    /// Newest.
    pub latest: usize,
    /// Best by the stage's loss.
    pub best: usize,
}

impl Default for Keep {
    fn default() -> Self {
        Self { latest: 2, best: 0 }
    }
}
