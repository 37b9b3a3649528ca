//! The report of an evaluation.

use std::collections::BTreeMap;

use checkpoint::model::Drawn;
use protocol::ArtifactKind;
use protocol::stage::Split;
use serde_json::{Value, json};

use crate::artifacts::{self, word};
use crate::context::{AttemptContext, Outcome, StageError};

/// File of a report's details.
pub const REPORT_FILE: &str = "report.json";

/// The error for an evaluation on a split without entries.
pub(crate) fn no_entries(split: Split) -> StageError {
    StageError::Input(format!("the split `{}` has no entries; set `split` to one that has entries", word(&split)))
}

/// The model and sampler of an evaluation, or null for real motion. Every report contains them, so that its reader
/// knows the settings of the model.
pub(crate) fn drawn(cx: &dyn AttemptContext) -> Result<Value, StageError> {
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
    publish_illustrated(cx, metrics, details, vec![])
}

/// Like [`publish_report`], with pictures given as names and files.
pub(crate) fn publish_illustrated(
    cx: &mut dyn AttemptContext,
    metrics: BTreeMap<String, f64>,
    details: Value,
    pictures: Vec<(&str, Vec<u8>)>,
) -> Result<Outcome, StageError> {
    let report = json!({"metrics": metrics, "details": details});
    let meta = json!({"kind": cx.task().settings.kind(), "metrics": metrics, "drawn": drawn(cx)?});
    let mut draft = artifacts::Draft::new(cx, ArtifactKind::Report, meta);
    draft.add(REPORT_FILE, protocol::canonical::to_bytes(&report))?;
    for (name, bytes) in pictures {
        draft.add(name, bytes)?;
    }
    Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
}
