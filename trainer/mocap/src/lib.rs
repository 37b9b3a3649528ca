//! Motion of other programs: recordings in, animations out. No tensors, no stages.

pub mod bvh;
pub mod rotations;
