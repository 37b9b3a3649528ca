//! Running stages outside a worker: to verify a result, and to estimate the cost of a pipeline.

mod clock;
pub mod estimate;
mod solo;
pub mod verify;
