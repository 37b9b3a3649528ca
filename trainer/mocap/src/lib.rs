//! Exchange of motion with other programs: recordings in, animations out. No tensors, no stages.

pub mod arrays;
pub mod bandai;
pub mod body;
pub mod bvh;
pub mod captions;
pub mod corpus;
pub mod detect;
pub mod export;
pub mod glb;
pub mod html;
pub mod joint_map;
pub mod listing;
pub mod plant;
pub mod requests;
pub mod rig;
pub mod sample;
pub mod take;

pub use body::Body;
