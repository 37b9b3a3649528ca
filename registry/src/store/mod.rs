//! The store: a folder with a database, blobs and a lock. The database may be in PostgreSQL instead.
//!
//! ```text
//! .stride/
//!   stride.db        SQLite, WAL
//!   CATALOG          address of the database, if it is in PostgreSQL
//!   witness          lower bound of the number of transactions in the database
//!   blobs/IDENTITY   the store that the blobs belong to
//!   blobs/sha256/    bytes by digest
//!   blobs/PLACE      location of these two, if they are elsewhere
//!   reserve          space released on a full disk for a collection
//!   staging/         arriving blobs; cleared when the store is opened
//!   lock             the operating system's lock, with the holder's name
//! ```
//!
//! One process holds a store. With PostgreSQL several folders may belong to a store, and one process leads
//! ([`Leadership`](crate::Leadership)). A second one gets the holder's name and sends its requests there over HTTP.

mod held;
mod opening;
mod orders;
mod parts;
mod read;

pub use self::held::Store;
pub use self::parts::PostgresCatalog;
pub(crate) use self::parts::{forget_catalog, remember_catalog, remembered_catalog};
pub use self::read::ReadStore;
