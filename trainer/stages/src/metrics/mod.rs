//! Metrics over plain arrays, in f64 and in a fixed order of summation. No tensors, no devices, no artifacts.

pub mod control;
pub mod frechet;
pub mod interval;
pub mod jerk;
pub mod joints;
pub mod junction;
pub mod latent_fid;
pub mod physics;
pub mod procrustes;
pub mod recognition;
pub mod reconstruction;
pub mod retrieval;
pub mod skating;
pub mod spectrum;
pub mod spread;
