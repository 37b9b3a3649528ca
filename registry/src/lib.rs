//! Storage: blobs, the coordinator's decisions, metrics, checkpoints, stage results, model versions and aliases.
//!
//! [`Store`] is the entry point. Writes are data ([`Write`]). A call of [`Store::write`] is one transaction that also
//! checks the fences of the tasks concerned, and returns when it is durable. A blob is stored before the row that names
//! it; the blob counts from that row on.
//!
//! Not part of this crate: assignment of work (the coordinator) and the meaning of tensors (the stages).

pub mod audit;
pub mod backup;
pub mod blob;
pub mod bundle;
mod calls;
pub mod catalog;
pub mod cli;
mod clock;
mod curve;
pub mod doctor;
mod error;
pub mod failpoints;
mod folder;
pub mod forget;
pub mod fsck;
mod history;
mod identity;
pub mod leaderboard;
mod lease;
mod lock;
pub mod migrate;
mod move_error;
mod open_error;
mod proofs;
mod prove;
mod reserve;
pub mod retention;
mod rollup;
mod scoped;
mod server_key;
mod sql;
mod store;
mod store_id;
mod table;
#[cfg(feature = "testing")]
pub mod testing;
pub mod versions;
mod write;

pub use blob::BlobStore;
pub use blob::place::Place;
pub use catalog::{
    CheckpointRow, EndedRow, HistoryQuery, HistoryRow, KindSize, LineageNode, LogRow, Recovery, RunListQuery, RunOrder,
    RunPage, RunRow, StageResultRow, Usage,
};
pub use curve::{Axis, Buckets, Curve, Page, Point, Window};
pub use error::{QueryError, WriteError};
pub use history::{HistoryEntry, HistoryKind};
pub use identity::Mismatch;
pub use lease::LeaseTerms;
pub use lock::Holder;
pub use open_error::OpenError;
pub use proofs::Proof;
pub use server_key::ServerKey;
pub use sql::{LeaderTerms, Leadership};
pub use store::{PostgresCatalog, ReadStore, Store};
pub use store_id::{StoreId, Stored};
pub use versions::{Expect, Gate, Model, ModelRef, Pick, Promotion, Version};
pub use write::{Write, two_states};
