//! Measures from a version's metrics: values with their intervals, by evaluation.

use std::collections::BTreeMap;

use super::column::COLUMNS;
use super::row::Measure;
use crate::versions::Version;

/// Combines `fid`, `fid.lower`, `fid.upper` and `fid_sd` into one measure.
pub(super) fn measures(metrics: &BTreeMap<String, f64>) -> BTreeMap<String, Measure> {
    let is_part = |key: &str| {
        let of = |end: &str| key.strip_suffix(end).is_some_and(|base| metrics.contains_key(base));
        of(".lower") || of(".upper") || of("_sd")
    };
    let half = |key: &str| {
        let part = |end: &str| metrics.get(&format!("{key}{end}")).copied();
        match (part(".lower"), part(".upper"), part("_sd")) {
            (Some(lower), Some(upper), _) => Some((upper - lower) / 2.0),
            (_, _, Some(sd)) => Some(1.96 * sd),
            _ => None,
        }
    };
    let whole = metrics.iter().filter(|(key, _)| !is_part(key));
    whole.map(|(key, &value)| (key.clone(), Measure { value, half: half(key) })).collect()
}

/// Groups a version's metrics by evaluation. Metrics with a stage's name belong to that stage; those without one belong
/// to every stage, or to the only evaluation if no metric has a name.
pub(crate) fn measured(version: &Version) -> Vec<(Option<String>, BTreeMap<String, Measure>)> {
    let mut by_stage: BTreeMap<String, BTreeMap<String, Measure>> = BTreeMap::new();
    let mut shared = BTreeMap::new();
    for (key, measure) in measures(&version.metrics) {
        match key.rsplit_once('.') {
            Some((stage, metric)) => drop(by_stage.entry(stage.into()).or_default().insert(metric.into(), measure)),
            None => drop(shared.insert(key, measure)),
        }
    }
    if by_stage.is_empty() {
        return vec![(None, shared)];
    }
    // The value without a stage's name repeats one with a name and is dropped.
    shared.retain(|key, _| !by_stage.values().any(|measures| measures.contains_key(key)));
    by_stage.values_mut().for_each(|measures| measures.extend(shared.clone()));
    by_stage.into_iter().map(|(stage, measures)| (Some(stage), measures)).collect()
}

/// Returns metrics in the order of the tables; other metrics come last, by name.
pub(crate) fn in_order(metrics: &BTreeMap<String, Measure>) -> Vec<(&String, Measure)> {
    let place = |key: &str| COLUMNS.iter().position(|column| column.key == key).unwrap_or(COLUMNS.len());
    let mut all: Vec<_> = metrics.iter().map(|(key, measure)| (key, *measure)).collect();
    all.sort_by_key(|(key, _)| place(key));
    all
}

/// Returns the value of `deciding` and of the first few other metrics with a column.
pub(crate) fn in_brief(version: &Version, deciding: Option<&str>) -> Vec<(String, Measure)> {
    const FEW: usize = 4;
    let plain = version.metrics.iter().filter(|(key, _)| !measures_of_a_stage(&version.metrics, key));
    let all = measures(&plain.map(|(key, value)| (key.clone(), *value)).collect());
    let first = deciding.and_then(|key| Some((key.to_owned(), *all.get(key)?)));
    let known = |key: &str| COLUMNS.iter().any(|column| column.key == key);
    let others = in_order(&all).into_iter().filter(|(key, _)| known(key) && Some(key.as_str()) != deciding);
    let others = others.map(|(key, measure)| (key.clone(), measure));
    first.into_iter().chain(others).take(FEW).collect()
}

/// Returns true if `key` is `STAGE.METRIC` and not the end of an interval.
fn measures_of_a_stage(metrics: &BTreeMap<String, f64>, key: &str) -> bool {
    let base = key.strip_suffix(".lower").or_else(|| key.strip_suffix(".upper")).filter(|b| metrics.contains_key(*b));
    base.unwrap_or(key).contains('.')
}
