//! Motion of other programs: recordings in, animations out. No tensors, no stages.

pub mod bvh;
pub mod detect;
pub mod joint_map;
pub mod rotations;
pub mod take;
