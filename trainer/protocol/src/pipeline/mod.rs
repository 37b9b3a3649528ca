//! A pipeline: stages, what each reads from which other, and what all of them share.
//!
//! [`read`] makes one from YAML and reports every mistake of the file at once; [`Pipeline::check`] repeats the rules that
//! do not need the text, for pipelines that arrive as JSON. Not its job: touching the file system. The content digests of
//! folders are put in by the caller ([`Pipeline::fill_external`]).

mod check;
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
mod yaml;

pub use definition::{Pipeline, PipelineStage, StageInput, keyed_as};
pub use diagnostic::{Diagnostic, Diagnostics};
pub use read::read;
pub use reference::{json_schema, markdown};
pub use rules::broken_rules;
pub use yaml::yaml_as_json;

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
