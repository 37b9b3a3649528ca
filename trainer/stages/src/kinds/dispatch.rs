//! Runs a stage in the way of its kind: alone, in shards, or by a gang.

use protocol::Digest;
use protocol::stage::{Split, StageSettings};

use super::runner;
use super::shape::Stage;
use crate::context::{AttemptContext, GangContext, Outcome, Part, StageError, yielded};

/// Runs a plain stage.
pub fn run_alone(cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match runner(&settings) {
        Some(Stage::Plain(stage)) => yielded(stage.run(cx)),
        _ => Err(misplaced(&settings, "by one worker alone")),
    }
}

/// Runs one shard of a map stage, or merges them.
pub fn run_part(cx: &mut dyn AttemptContext, part: Part) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match (runner(&settings), part) {
        (Some(Stage::Map(stage)), Part::Shard { index, of }) => yielded(stage.shard(cx, index, of)),
        (Some(Stage::Map(stage)), Part::Merge { shards }) => yielded(stage.merge(cx, &shards)),
        _ => Err(misplaced(&settings, "in shards")),
    }
}

/// Runs a training stage as a member of its gang.
pub fn run_gang(cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
    let settings = cx.task().settings.clone();
    match runner(&settings) {
        Some(Stage::Gang(stage)) => yielded(stage.run(cx)),
        _ => Err(misplaced(&settings, "by a gang")),
    }
}

/// Makes a placeholder of the stage's output for an estimate, if its kind has one.
pub(crate) fn stand_in(settings: &StageSettings, cx: &mut dyn AttemptContext) -> Option<Result<Digest, StageError>> {
    match runner(settings)? {
        Stage::Plain(stage) => stage.stand_in(cx),
        Stage::Map(stage) => stage.stand_in(cx),
        Stage::Gang(_) => None,
    }
}

/// The settings that an estimate runs untimed in place of these, if there are any.
pub(crate) fn cheaper(settings: &StageSettings) -> Option<StageSettings> {
    match runner(settings)? {
        Stage::Map(stage) => stage.cheaper(),
        Stage::Plain(_) | Stage::Gang(_) => None,
    }
}

/// The number of times that the stage repeats the work which an estimate times.
pub(crate) fn repetitions(settings: &StageSettings, entries: &dyn Fn(Split) -> f64) -> f64 {
    match runner(settings) {
        Some(Stage::Map(stage)) => stage.repetitions(entries),
        _ => entries(Split::All),
    }
}

fn misplaced(settings: &StageSettings, how: &str) -> StageError {
    StageError::Fault(format!("stage kind `{}` does not run {how}", settings.kind()))
}
