//! `worker join URL`, for machines that only compute.

use std::process::ExitCode;

use clap::Parser;

#[global_allocator]
static ALLOCATOR: worker::process::Allocator = worker::process::Allocator;

/// Computes stages for a Stride coordinator.
#[derive(Debug, Parser)]
#[command(name = "worker", version)]
enum Command {
    /// Offer this machine to a coordinator
    Join(worker::JoinArgs),
}

fn main() -> ExitCode {
    // First, because the allocator can be tuned only while there is one thread.
    worker::process::tune_allocator();
    let Command::Join(args) = Command::parse();
    let _traces = telemetry::init("stride-worker", worker::LOGGED, false);
    match worker::Options::try_from(args).and_then(worker::join) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error}");
            ExitCode::from(error.exit_code())
        }
    }
}
