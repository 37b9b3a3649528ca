//! The data plane: a process that takes assignments from a coordinator, runs their stages and uploads what they make.
//!
//! Its threads: one computes (`stage_thread`), one drives all HTTP, on which the poll (`assignments`) lives, one fetches ahead what
//! the next task needs (`prepare`), one a running attempt sends metrics and logs (`telemetry_buffer`), and a few short-stacked ones
//! serve the connections of a gang (`gang::mesh`). What binds them is `active_assignment::ActiveAssignment`: an assignment, its
//! newest grant, and whether it has ended.
//!
//! Not its job: what a stage computes (`stages`), and every decision about who does what (the coordinator's).

mod active_assignment;
mod assignments;
mod blobs;
mod cache;
mod cli;
mod client;
mod context;
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
mod stage_limits;
mod stage_thread;
mod telemetry_buffer;
#[cfg(test)]
mod tests;

pub use cli::JoinArgs;
pub use join::{Files, JoinError, Options, init_logging, join};
pub use stage_limits::StageLimits;
