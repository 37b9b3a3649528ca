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

/// Measures of a motion that need no other motion: the share of steps in which a foot skates, the mean jerk of feet and
/// wrists in m/s^3, the depth of the lowest joint below the floor, and how much bones change their lengths. All
/// evaluations of motions report them, except `evaluate.spectrum`.
pub const PHYSICS: [&str; 4] = ["skating_ratio", "jerk", "penetration_mm", "bone_change_mm"];

/// Direction of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}
