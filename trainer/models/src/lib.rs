//! The published networks, their samplers, and the CPU kernels under them.
//!
//! Not its job: stages, stores, workers, where data comes from.

pub mod diffusion;
pub mod flat;
pub mod kernels;
pub mod losses;
pub mod names;
pub mod networks;
