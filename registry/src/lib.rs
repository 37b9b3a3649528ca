//! What is kept: blobs, what the coordinator decided, metrics, checkpoints, stage results, model versions and aliases.
//!
//! [`Store`] is the whole. What may be written is data ([`Write`]); a call of [`Store::write`] is one transaction that also
//! checks the fences of the tasks it writes about, and returns once it would survive a loss of power. A blob is stored
//! before the row that names it; the row is the point from which it counts.
//!
//! Not its job: who works on what (the coordinator), what tensors mean (the stages).

pub mod backup;
pub mod blob;
pub mod catalog;
pub mod cli;
mod clock;
mod db;
pub mod failpoints;
pub mod forget;
pub mod fsck;
mod identity;
pub mod leaderboard;
mod lock;
mod metrics;
pub mod query;
mod reserve;
pub mod retention;
mod store;
mod write;

pub use blob::BlobStore;
pub use blob::place::Place;
pub use catalog::{Expect, Gate, Model, ModelRef, Pick, Promotion, Version};
pub use db::apply::two_states;
pub use identity::{Mismatch, StoreId};
pub use lock::Holder;
pub use metrics::{Curve, Point};
pub use query::{CheckpointRow, EndedRow, LineageNode, LogRow, QueryError, Recovery, RunRow, StageResultRow};
pub use store::{OpenError, ReadStore, Store};
pub use write::{Write, WriteError};
