//! Decisions without a disk, a network or a clock.

#[path = "../common/mod.rs"]
#[allow(dead_code, reason = "shared with the simulation")]
mod common;

mod batches;
mod demand;
mod gangs;
mod history;
mod limits;
mod liveness;
mod priorities;
mod promises;
mod queued;
mod resolve;
mod shares;
mod views;
