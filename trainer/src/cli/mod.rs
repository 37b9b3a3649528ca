//! Command line: one type and one function per verb.

mod allowance_args;
mod args;
mod config;
mod control;
mod data;
mod datasets;
mod demo;
mod dispatch;
mod doctor;
mod endpoint_args;
mod explain;
mod export;
mod files;
mod gallery;
mod generate;
mod import;
mod keep;
mod launch;
mod metrics;
mod model;
mod out;
mod plan;
mod push;
mod refused;
mod remote;
mod resume;
mod run;
mod sampler;
mod sentences;
mod serve;
mod shell;
mod spectrum;
mod stream;
pub(crate) mod sweep;
mod time;
mod unknown_words;
mod verbs;

pub(crate) use self::dispatch::main;

#[cfg(test)]
mod tests;
