//! Blobs in an object store: S3 and compatible servers, Google Cloud Storage, Azure.
//!
//! ```text
//! PREFIX/IDENTITY           the store that the blobs belong to
//! PREFIX/sha256/ab/cdef...  a blob
//! PREFIX/quarantine/...     damaged blobs that were put aside
//! PREFIX/uploads/...        uploads in parts that have not ended
//! PREFIX/arriving/...       blobs that workers have sent by signed requests and that have no name yet
//! PREFIX/SIGNED             a line that shows whether the server checks what a signed request stores
//! ```
//!
//! The store's folder keeps the database, the lock and arriving blobs. A blob is sent when all of it has arrived and
//! hashes to its name. A small blob is sent by a put that fails if the name is taken; a large one in parts
//! (`multipart`). The time of an object cannot be set, so this process remembers the times of its own puts. For older
//! objects the server's time counts; the blobs of a held task are protected by rows, not by their age.

mod backend;
mod health;
mod multipart;
mod ranges;
mod remote;
mod requests;
mod signed;
mod staged;

pub use self::backend::Objects;
pub(super) use self::remote::check_url;
pub use self::remote::{Bucket, Remote};
