//! Tests of owners: visibility and control of runs and models, promotion by pipelines, revoked tokens, and the audit
//! log.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic, and prints what it measured")]

mod audit;
mod fuzz;
mod lab;
mod matrix;
#[path = "../simulation/pipelines.rs"]
mod pipelines;
mod promotion;
#[path = "../common/shell.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod shell;
mod tokens;
