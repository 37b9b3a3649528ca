//! The `trainer` command: composition root of control plane and data plane.
//!
//! No logic of its own: it reads arguments and files, starts a coordinator and worker processes, and prints their
//! results.

mod cli;
mod client;
mod local;
mod reader;
mod report;

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: worker::process::Allocator = worker::process::Allocator;

fn main() -> ExitCode {
    registry::failpoints::arm_from_env();
    coordinator::failpoints::arm_from_env();
    cli::main()
}
