//! Common settings of evaluations: the clips, and the direction of a metric.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Clips that an evaluation uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Clips of `train.txt`.
    Train,
    /// Clips of `val.txt`.
    Val,
    /// Clips of `test.txt`.
    Test,
    /// Clips of all three lists.
    All,
}

/// Direction of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}
