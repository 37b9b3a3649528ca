//! The catalog of a store: all data except the blobs, behind two traits.
//!
//! [`Records`] answers queries from committed data; [`Catalog`] commits. `sql` implements them over SQLite and PostgreSQL. Every
//! implementation passes the suite `registry/tests/catalog_conformance.rs` and guarantees:
//!
//! - **One order is all or nothing.** [`Catalog::commit`] returns when the order is durable, or has changed nothing.
//!   Orders that are committed together do not see each other's failures.
//! - **Fences are checked where the write is stored**, in the same transaction (those of a
//!   [`Write`](crate::Write) that carries a grant).
//! - **One epoch writes.** Opening for writing raises the epoch; a commit under an older one is refused with
//!   [`WriteError::Superseded`](crate::WriteError::Superseded), from any process or machine. Exclusivity therefore
//!   needs no shared lock.
//! - **Committed transactions are counted** ([`Stored::commits`](crate::Stored::commits)), so that an older copy of a
//!   catalog is recognised.
//! - **A row names only proven artifacts**: one without a [`Proof`](crate::Proof) is refused with
//!   [`WriteError::Unproven`](crate::WriteError::Unproven). A commit sends no request to the blobs' backend. Blobs of
//!   named artifacts are recorded for a running collection and as [present](Records::present).
//! - **An answer is consistent**: it shows one moment, including every commit that was acknowledged before the query.
//!
//! Rules independent of the database are functions beside the types ([`crate::versions`], and `curve`). They cover the
//! best version, gates, the target of a rollback, and the attempt whose values count.

mod address;
mod orders;
mod records;
mod rows;

pub use address::{CatalogPlace, PostgresAddress};
pub use orders::{Catalog, Done, Order, PromoteOrder, RollbackOrder, Which};
pub use records::Records;
pub use rows::{
    CheckpointRow, EndedRow, HistoryQuery, HistoryRow, KindSize, LineageNode, LogRow, Needs, Recovery, References,
    RunListQuery, RunOrder, RunPage, RunRow, StageResultRow, Usage,
};
