//! Motion data without tensors: folders, features, skeletons, captions, synthetic clips, drawings, keyed randomness.
//!
//! Not its job: Burn, training, asynchronous code. Everything here works on plain slices, so that the numbers can be
//! compared with the published files without a backend.
//!
//! Shapes: `T` raw frames, `L = T - 1` feature frames, `J` joints, `D` feature width (263 or 251). All arrays are
//! row-major and frame-major.

pub mod data_access;
pub mod dataset;
pub mod draw;
pub mod features;
pub mod files;
pub mod folder_digest;
pub mod footing;
pub mod npy;
pub mod paths;
pub mod placement;
pub mod quaternion;
pub mod random;
pub mod roots;
pub mod skeleton;
pub mod synthetic;
pub mod tensor_header;
pub mod text;
mod values;
pub mod vocabulary;
pub mod waypoints;

pub use dataset::Dataset;
pub use files::DataPath;
pub use random::Stream;
pub use skeleton::Skeleton;
pub use values::{Floats, Values};
