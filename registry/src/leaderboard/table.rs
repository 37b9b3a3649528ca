//! Tables of models and of evaluations.

use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::column::{Better, COLUMNS, better};
use super::measures::{measured, measures};
use super::published;
use super::row::{Measure, Row};
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

/// Values of an evaluation of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    /// Name of its stage.
    pub name: String,
    /// The stage that it is a copy of, for one of several trainings or folds.
    pub copy_of: Option<String>,
    /// Values by metric.
    pub metrics: BTreeMap<String, f64>,
}

/// Builds a table of evaluations in the given order; `None` if no metric has a column. Copies of one stage follow each
/// other, and then their mean.
pub fn evaluations(title: &str, all: &[Evaluation]) -> Option<Leaderboard> {
    let row = |evaluation: &Evaluation| {
        let measures = measures(&evaluation.metrics);
        let shown = COLUMNS.iter().any(|column| measures.contains_key(column.key));
        let label = evaluation.name.clone();
        shown.then(|| Row { source: label.clone(), label, published: false, measures })
    };
    let mut rows = Vec::new();
    let mut shown: BTreeSet<&str> = BTreeSet::new();
    for evaluation in all {
        let Some(of) = &evaluation.copy_of else {
            rows.extend(row(evaluation));
            continue;
        };
        if !shown.insert(of) {
            continue;
        }
        let copies: Vec<Row> = all.iter().filter(|other| other.copy_of.as_ref() == Some(of)).filter_map(row).collect();
        let mean = (copies.len() > 1).then(|| mean(of, &copies));
        rows.extend(copies);
        rows.extend(mean);
    }
    (!rows.is_empty()).then(|| Leaderboard { title: title.to_owned(), rows })
}

/// The mean of the copies of a stage, with the 95 % interval of Student's distribution, for the metrics that all of them
/// have.
fn mean(of: &str, copies: &[Row]) -> Row {
    let mut measures = BTreeMap::new();
    for key in copies[0].measures.keys() {
        let values: Vec<f64> =
            copies.iter().filter_map(|copy| copy.measures.get(key)).map(|measure| measure.value).collect();
        if values.len() < copies.len() {
            continue;
        }
        measures.extend(Measure::of_trainings(&values).map(|mean| (key.clone(), mean)));
    }
    let label = format!("{of}, mean of {}", copies.len());
    Row { source: label.clone(), label, published: false, measures }
}
