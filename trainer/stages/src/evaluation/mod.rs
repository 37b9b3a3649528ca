//! Metrics over plain arrays, in f64 and in a fixed order of summation. No tensors, no devices, no artifacts.

pub mod frechet;
pub mod joints;
pub mod latent_fid;
pub mod reconstruction;
pub mod retrieval;
