//! The stage kinds. A kind is its file in the folder of its family and a line of the family's list, which says how it
//! runs. The name, settings and outputs of a kind are in its file in `protocol::stage`.
//!
//! Not its job: helpers of several kinds. `train`, `evaluation` and `shards` have those.

use protocol::Digest;
use protocol::stage::{Split, StageSettings};

use crate::context::{AttemptContext, GangContext, Outcome, Part, StageError, yielded};

/// Generates `runner` of a family from the list of its kinds.
macro_rules! runners {
    ($($shape:ident: $($name:ident),+;)*) => {
        /// The runner of a stage with these settings; `None` for the kinds of other families.
        pub(super) fn runner(settings: &protocol::stage::StageSettings) -> Option<crate::kinds::shape::Stage<'_>> {
            match settings {
                $($(protocol::stage::StageSettings::$name(settings) => Some(crate::kinds::shape::Stage::$shape(settings)),)+)*
                _ => None,
            }
        }
    };
}

mod data;
mod distill;
mod draw;
mod encode;
mod evaluate;
mod import;
mod model;
mod shape;
mod text;
mod train;

use shape::Stage;

/// The families of kinds.
const FAMILIES: [fn(&StageSettings) -> Option<Stage<'_>>; 9] = [
    data::runner,
    text::runner,
    import::runner,
    train::runner,
    encode::runner,
    distill::runner,
    model::runner,
    evaluate::runner,
    draw::runner,
];

/// The runner of a stage with these settings; `None` for kinds that the coordinator runs itself.
fn runner(settings: &StageSettings) -> Option<Stage<'_>> {
    FAMILIES.iter().find_map(|family| family(settings))
}

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

#[cfg(test)]
mod tests {
    use protocol::stage::Shape;

    use super::*;

    #[test]
    fn every_kind_is_in_the_file_of_its_name() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/kinds");
        for settings in StageSettings::all().iter().filter(|settings| settings.shape() != Shape::Registry) {
            let file = folder.join(format!("{}.rs", settings.kind().replace('.', "/")));
            let text = std::fs::read_to_string(&file).unwrap_or_default();
            let begin = format!("//! `{}`", settings.kind());
            assert!(text.starts_with(&begin), "{} does not begin with {begin}", file.display());
        }
    }

    #[test]
    fn every_kind_has_a_runner_of_its_shape() {
        for settings in StageSettings::all() {
            let shape = match runner(&settings) {
                Some(Stage::Plain(_)) => Shape::Plain,
                Some(Stage::Map(_)) => Shape::Map,
                Some(Stage::Gang(_)) => Shape::Gang,
                None => Shape::Registry,
            };
            assert_eq!(shape, settings.shape(), "{}", settings.kind());
        }
    }
}
