//! One file per stage kind, and the table that finds it.

mod data;
pub mod text;

use protocol::stage::StageSettings;

use crate::context::{AttemptContext, GangContext, Outcome, Part, StageError};

/// Where a report's details are.
pub const REPORT_FILE: &str = "report.json";

/// Runs a plain stage.
pub fn run_alone(cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
    match cx.task().settings.clone() {
        StageSettings::DataOpen(settings) => data::open(cx, &settings),
        StageSettings::DataSynthetic(settings) => data::synthetic(cx, &settings),
        StageSettings::TextEmbed(settings) => text::run(cx, &settings),
        other => Err(misplaced(&other, "by one worker alone")),
    }
}

/// Runs one shard of a map stage, or merges them.
pub fn run_part(cx: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError> {
    let _ = part;
    Err(misplaced(&cx.task().settings.clone(), "in shards"))
}

/// Runs a training stage as a member of its gang.
pub fn run_gang(cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
    Err(misplaced(&cx.task().settings.clone(), "by a gang"))
}

fn misplaced(settings: &StageSettings, how: &str) -> StageError {
    StageError::Fault(format!("stage kind `{}` does not run {how}", settings.kind()))
}
