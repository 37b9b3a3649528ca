//! A pipeline: stages, the inputs of each, and their common settings.
//!
//! [`read`] makes one from YAML and reports every mistake of the file at once. [`Pipeline::check`] applies the rules
//! that do not need the text, for pipelines that arrive as JSON. Not its job: accessing the file system. The caller
//! supplies the content digests of folders ([`Pipeline::fill_external`]).

mod check;
mod copies;
mod definition;
mod described;
mod diagnostic;
mod graph;
mod overrides;
mod ranges;
mod read;
mod reader;
mod reference;
mod rules;
mod schema;
mod sweep;
mod sweep_rules;
mod trial;
mod trial_values;
mod yaml;

pub use definition::{Pipeline, PipelineStage, StageInput, keyed_as};
pub use diagnostic::{Diagnostic, Diagnostics};
pub use read::read;
pub use reference::{json_schema, markdown};
pub use rules::broken_rules;
pub use trial_values::with_values;
pub use yaml::yaml_as_json;

#[cfg(test)]
mod copies_tests;
#[cfg(test)]
mod mdm_tests;
#[cfg(test)]
mod range_tests;
#[cfg(test)]
mod sweep_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod token_tests;
#[cfg(test)]
mod version_tests;
