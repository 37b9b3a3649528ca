//! The stage kinds: artifacts in, artifacts out, training in between.
//!
//! A folder uses only folders before it in this list: `metrics` (formulas over arrays), `parts` (trained networks from
//! artifacts), `generate` (motions from models), `train` (the loop and its data), `evaluation`, `kinds`, `run`
//! (running a kind outside a worker). Not its job: leases, databases, HTTP. A stage's only access to the world is
//! [`context`].

pub mod artifacts;
pub mod context;
mod dataset;
pub mod evaluation;
pub mod external;
pub mod generate;
pub mod kinds;
pub mod metrics;
pub mod parts;
pub mod published;
pub mod run;
mod shards;
mod stand_in;
pub mod train;
pub mod tree;
