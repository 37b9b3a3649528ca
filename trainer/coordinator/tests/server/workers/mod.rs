//! Attacks by a valid worker token or a faulty worker on others: names, grants, manifests and blobs.

mod blobs;
pub(super) mod bystanders;
mod fuzz;
mod grants;
mod matrix;
mod names;
