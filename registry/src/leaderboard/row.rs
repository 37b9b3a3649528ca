//! A row of a table: what was measured of one model.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A value with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Measure {
    /// The mean.
    pub value: f64,
    /// Half the width of its interval, if repeats were measured.
    pub half: Option<f64>,
}

/// One evaluation of one model, or a published result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// What a table calls it.
    pub label: String,
    /// `MODEL:VERSION` of ours; the paper of a published row.
    pub source: String,
    /// Whether a paper says so.
    pub published: bool,
    /// By metric.
    pub measures: BTreeMap<String, Measure>,
}
