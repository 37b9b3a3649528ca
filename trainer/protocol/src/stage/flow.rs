//! Solvers of rectified flows, for kinds that train or import one.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Solver of the flow for decoding motion.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FlowSolver {
    /// One evaluation of the network per step; the paper's text says 16 steps.
    Euler,
    /// Two evaluations of the network per step; the released code makes 15 steps.
    #[default]
    Midpoint,
}
