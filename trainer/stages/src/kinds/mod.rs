//! The stage kinds. A kind is its file in the folder of its family and a line of the family's list, which says how it
//! runs. The name, settings and outputs of a kind are in its file in `protocol::stage`.
//!
//! Not its job: helpers of several kinds. `train`, `evaluation` and `shards` have those.

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
mod dispatch;
mod distill;
mod draw;
mod encode;
mod evaluate;
mod import;
mod model;
mod shape;
mod text;
mod train;

use protocol::stage::StageSettings;
use shape::Stage;

pub(crate) use dispatch::{cheaper, repetitions, stand_in};
pub use dispatch::{run_alone, run_gang, run_part};

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
