//! Decisions without a disk, a network or a clock.

#[path = "../common/mod.rs"]
mod common;

mod batches;
mod gangs;
mod history;
mod liveness;
mod promises;
mod queued;
mod resolve;
mod views;
