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

impl Measure {
    /// The mean of several trainings, with the 95 % interval of Student's distribution if there are at least two. `None`
    /// without values.
    pub fn of_trainings(values: &[f64]) -> Option<Self> {
        let count = values.len() as f64;
        let degrees = values.len().checked_sub(1)?;
        let value = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|one| (one - value).powi(2)).sum();
        let half = (degrees > 0).then(|| quantile(degrees) * (squares / degrees as f64 / count).sqrt());
        Some(Self { value, half })
    }
}

/// The 97.5 % quantile of Student's distribution; above ten degrees of freedom by the first terms of its expansion.
fn quantile(degrees: usize) -> f64 {
    const TABLE: [f64; 10] = [12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228];
    let normal = 1.96_f64;
    match TABLE.get(degrees.saturating_sub(1)) {
        Some(value) => *value,
        None => normal + (normal.powi(3) + normal) / (4.0 * degrees as f64),
    }
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
