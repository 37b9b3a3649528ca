//! Attacks by a valid worker token or a faulty worker on others: names, grants, manifests and blobs.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic, and prints what it counted")]

mod blobs;
mod bystanders;
mod fuzz;
mod grants;
mod matrix;
mod names;
