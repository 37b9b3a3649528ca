//! How rectified flows are followed, by whichever kind trains or imports one.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the flow is followed when motion is decoded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowSolver {
    /// One evaluation of the network a step; the paper's text says 16 steps.
    Euler,
    /// Two; the released code makes 15 steps.
    #[default]
    Midpoint,
}
