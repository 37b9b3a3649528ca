//! The report of an evaluation.

use std::collections::BTreeMap;

use checkpoint::model::Drawn;
use protocol::ArtifactKind;
use protocol::stage::Split;
use serde_json::{Value, json};

use crate::artifacts::{self, word};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::metrics::interval::Interval;

/// File of a report's details.
pub const REPORT_FILE: &str = "report.json";

/// The error for an evaluation on a split without entries.
pub(crate) fn no_entries(split: Split) -> StageError {
    StageError::Input(format!("the split `{}` has no entries; set `split` to one that has entries", word(&split)))
}

/// The model and sampler of an evaluation, or null for real motion. Every report contains them, so that its reader
/// knows the settings of the model.
fn drawn(cx: &dyn AttemptContext) -> Result<Value, StageError> {
    let task = cx.task();
    let Some(sampler) = task.settings.sampler() else { return Ok(Value::Null) };
    let drawn = Drawn { model: artifacts::input(cx, "model", ArtifactKind::Model)?.0, sampler: sampler.clone() };
    Ok(artifacts::to_meta(&drawn))
}

/// Uploads a report and ends the stage with its metrics.
pub(crate) fn publish_report(
    cx: &mut dyn AttemptContext,
    metrics: BTreeMap<String, f64>,
    details: Value,
) -> Result<Outcome, StageError> {
    publish_illustrated(cx, metrics, json!({}), details, vec![])
}

/// Like [`publish_report`], with more in the meta, and with pictures given as names and files.
pub(crate) fn publish_illustrated(
    cx: &mut dyn AttemptContext,
    metrics: BTreeMap<String, f64>,
    meta: Value,
    details: Value,
    pictures: Vec<(&str, Vec<u8>)>,
) -> Result<Outcome, StageError> {
    let report = json!({"metrics": metrics, "details": details});
    let common = json!({"kind": cx.task().settings.kind(), "metrics": metrics, "drawn": drawn(cx)?});
    let meta = joined(common, meta);
    let mut draft = artifacts::Draft::new(cx, ArtifactKind::Report, meta);
    draft.add(REPORT_FILE, protocol::canonical::to_bytes(&report))?;
    for (name, bytes) in pictures {
        draft.add(name, bytes)?;
    }
    Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
}

/// An object with the fields of two.
pub(crate) fn joined(mut one: Value, other: Value) -> Value {
    if let (Value::Object(one), Value::Object(other)) = (&mut one, other) {
        one.extend(other);
    }
    one
}

/// Values of every repeat, by metric.
pub(crate) type Repeats = BTreeMap<String, Vec<f64>>;

/// Measures each repeat, and takes the mean of each metric. The ends of its 95% interval are metrics too if `bounded`
/// accepts its name.
///
/// # Errors
/// If a metric is not finite.
pub(crate) fn over_repeats(
    repeats: usize,
    bounded: impl Fn(&str) -> bool,
    measure: impl Fn(usize) -> BTreeMap<String, f64>,
) -> Result<(BTreeMap<String, f64>, Repeats), StageError> {
    let mut values = Repeats::new();
    for (name, value) in (0..repeats).flat_map(measure) {
        values.entry(name).or_default().push(value);
    }
    let mut metrics = BTreeMap::new();
    for (name, values) in &values {
        let interval = Interval::of(values);
        metrics.insert(name.clone(), interval.mean);
        if bounded(name) {
            metrics.insert(format!("{name}.lower"), interval.lower());
            metrics.insert(format!("{name}.upper"), interval.upper());
        }
    }
    finite(&metrics)?;
    Ok((metrics, values))
}

/// Refuses metrics that are not finite.
pub(crate) fn finite(metrics: &BTreeMap<String, f64>) -> Result<(), StageError> {
    match metrics.iter().find(|(_, value)| !value.is_finite()) {
        Some((name, value)) => Err(StageError::Input(format!(
            "`{name}` is {value}: the embeddings are not finite; train the evaluator again"
        ))),
        None => Ok(()),
    }
}
