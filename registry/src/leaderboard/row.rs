//! A row of a table: the measurements of one model.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A value with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Measure {
    /// Mean over the repeats.
    pub value: f64,
    /// Half the width of the interval, if repeats were measured.
    pub half: Option<f64>,
}

/// One evaluation of one model, or a published result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Row {
    /// Name of the row in tables.
    pub label: String,
    /// `MODEL:VERSION` of our rows; the paper of published rows.
    pub source: String,
    /// True for a row from a paper.
    pub published: bool,
    /// Measures by metric.
    pub measures: BTreeMap<String, Measure>,
}
