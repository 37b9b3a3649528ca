//! What is kept: blobs, what the coordinator decided, metrics, checkpoints, stage results, model versions and aliases.
//!
//! [`Store`] is the whole. What may be written is data ([`Write`]); a call of [`Store::write`] is one transaction that also
//! checks the fences of the tasks it writes about, and returns once it would survive a loss of power. A blob is stored
//! before the row that names it; the row is the point from which it counts.
//!
//! Not its job: who works on what (the coordinator), what tensors mean (the stages).

pub mod audit;
pub mod backup;
pub mod blob;
pub mod bundle;
mod calls;
pub mod catalog;
pub mod cli;
mod clock;
mod curve;
mod error;
pub mod failpoints;
mod folder;
pub mod forget;
pub mod fsck;
mod identity;
pub mod leaderboard;
mod lease;
mod lock;
mod open_error;
mod proofs;
mod prove;
mod reserve;
pub mod retention;
mod scoped;
mod server_key;
mod sqlite;
mod store;
mod store_id;
pub mod testing;
pub mod versions;
mod write;

pub use blob::BlobStore;
pub use blob::place::Place;
pub use catalog::{CheckpointRow, EndedRow, LineageNode, LogRow, Recovery, RunRow, StageResultRow, Usage};
pub use curve::{Curve, Point};
pub use error::{QueryError, WriteError};
pub use identity::Mismatch;
pub use lease::LeaseTerms;
pub use lock::Holder;
pub use open_error::OpenError;
pub use proofs::Proof;
pub use server_key::ServerKey;
pub use store::{ReadStore, Store};
pub use store_id::{StoreId, Stored};
pub use versions::{Expect, Gate, Model, ModelRef, Pick, Promotion, Version};
pub use write::{Write, two_states};
