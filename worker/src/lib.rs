//! The data plane: a process that takes assignments from a coordinator, runs their stages and uploads the results.
//!
//! Threads of a worker:
//! - one computes (`stage_thread`);
//! - one drives all HTTP, including the poll (`assignments`);
//! - one prefetches the inputs of the next task (`prepare`);
//! - one per running attempt sends metrics and logs (`telemetry_buffer`);
//! - a few with small stacks serve the connections of a gang (`gang::mesh`).
//!
//! They share `active_assignment::ActiveAssignment`: an assignment, its newest grant, and whether it has ended.
//!
//! Not its job: the computation of a stage (`stages`), and the distribution of work (the coordinator).

mod active_assignment;
mod assignments;
mod blobs;
mod cache;
mod cli;
mod client;
mod context;
mod direct;
mod errors;
mod event_count;
pub mod failpoints;
mod gang;
mod join;
mod kinds;
mod mapped;
mod prepare;
pub mod process;
mod receipts;
mod retry;
mod sandbox;
mod saver;
mod stage_limits;
mod stage_log;
mod stage_thread;
mod telemetry_buffer;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
#[cfg(test)]
mod tests;

pub use cli::JoinArgs;
pub use join::{Files, JoinError, LOGGED, Options, join};
pub use stage_limits::StageLimits;
