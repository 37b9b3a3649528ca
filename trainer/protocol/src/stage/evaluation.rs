//! What evaluations share: which clips, which direction of a metric is better.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which clips an evaluation looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// `train.txt`.
    Train,
    /// `val.txt`.
    Val,
    /// `test.txt`.
    Test,
    /// All three.
    All,
}

/// Whether a smaller or a larger value is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}
