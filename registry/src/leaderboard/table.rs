//! Tables of models and of evaluations.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::column::{Better, COLUMNS, better};
use super::measures::{measured, measures};
use super::published;
use super::row::Row;
use crate::versions::Version;

/// A table of rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Leaderboard {
    /// Title of the table.
    pub title: String,
    /// Rows of models: ours by the deciding metric, best first, then published ones in their papers' order.
    pub rows: Vec<Row>,
}

fn rows(version: &Version) -> Vec<Row> {
    let source = format!("{}:{}", version.model, version.version);
    let mut rows = Vec::new();
    for (stage, measures) in measured(version) {
        let label = stage.map_or_else(|| source.clone(), |stage| format!("{source} ({stage})"));
        rows.push(Row { label, source: source.clone(), published: false, measures });
    }
    rows
}

/// Builds the rows of `versions`, the best by `metric` first, and adds published rows of the data format `published`,
/// if given.
pub fn leaderboard(title: String, versions: &[Version], metric: Option<&str>, published: Option<&str>) -> Leaderboard {
    let mut ours: Vec<Row> = versions.iter().flat_map(rows).collect();
    let deciding = metric.or_else(|| {
        COLUMNS
            .iter()
            .find(|c| c.better != Better::Neither && ours.iter().any(|row| row.measures.contains_key(c.key)))
            .map(|c| c.key)
    });
    if let Some(metric) = deciding {
        let sign = if better(metric) == Better::Higher { -1.0 } else { 1.0 };
        let rank = |row: &Row| {
            row.measures
                .get(metric)
                .map_or(f64::INFINITY, |m| if m.value.is_nan() { f64::INFINITY } else { sign * m.value })
        };
        ours.sort_by(|a, b| rank(a).total_cmp(&rank(b)));
    }
    ours.extend(published.into_iter().flat_map(published::rows));
    Leaderboard { title, rows: ours }
}

/// Builds a table of named evaluations in the given order; `None` if no metric has a column.
pub fn evaluations(title: &str, all: impl IntoIterator<Item = (String, BTreeMap<String, f64>)>) -> Option<Leaderboard> {
    let mut rows = Vec::new();
    for (label, metrics) in all {
        let measures = measures(&metrics);
        if COLUMNS.iter().any(|column| measures.contains_key(column.key)) {
            rows.push(Row { source: label.clone(), label, published: false, measures });
        }
    }
    (!rows.is_empty()).then(|| Leaderboard { title: title.to_owned(), rows })
}
