//! The types that two builds of Stride must agree on: names, settings of stages, sweeps and messages.
//!
//! Not its job: I/O, clocks, async, tensors. Everything here is plain data with serde, so that the control plane builds
//! in seconds and a message can be read without running anything.

pub mod artifact;
mod bounded;
pub mod canonical;
pub mod demand;
pub mod digest;
pub mod id;
pub mod labels;
pub mod limits;
pub mod message;
pub mod model_ref;
pub mod owner;
pub mod printable;
pub mod proof;
pub mod spelling;
pub mod stage;
pub mod sweep;
pub mod units;

pub use artifact::{ArtifactKind, FileEntry, Manifest};
pub use digest::Digest;
pub use id::{Alias, Attempt, Fence, Generation, Incarnation, ModelName, RunId, Seed, StageName, TaskId, WorkerId};
pub use labels::Labels;
pub use model_ref::{ModelRef, Pick};
pub use owner::{Group, GroupLimits, Owner};
pub use printable::{excerpt, excerpts, json_mistake, printable, show_excerpts};
pub use units::Steps;
