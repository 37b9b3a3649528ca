//! The `trainer` command: composition root of control plane and data plane.
//!
//! No logic of its own: it reads arguments and files, starts a coordinator and worker processes, and prints their
//! results.

mod advice;
mod cli;
mod client;
mod cost;
mod figure;
mod fleet;
mod hub_names;
mod missing;
mod out_of_memory;
mod pictures;
mod pipeline_file;
mod plan;
mod print;
mod problem;
mod progress;
mod reader;
mod run;
mod summary;
mod sweep_plot;
mod verify;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    // First, because the allocator can be tuned only while there is one thread.
    worker::process::tune_allocator();
    registry::failpoints::arm_from_env();
    coordinator::failpoints::arm_from_env();
    cli::main(cli::Cli::parse())
}
