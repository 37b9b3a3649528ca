//! Content-addressed bytes: what a blob is called is what it hashes to.
//!
//! [`BlobStore`] verifies what is read and what is used again, stores equal bytes once, mends what was damaged, and keeps
//! collection away from blobs that are being put. Bytes come and go in parts; nothing here holds a whole blob unless it was
//! asked to. Where bytes lie is a [`Backend`]'s matter: a folder ([`fs::Folder`]), an object store ([`objects::Objects`]) or
//! memory ([`memory::Memory`]); all pass the same functions in `registry/tests/conformance.rs`.
//!
//! Not its job: which blobs are needed ([`crate::retention`]), and who may write.

mod backend;
mod begun;
pub mod disk;
mod disk_error;
pub mod fs;
mod holds;
mod known;
mod manifest;
pub mod memory;
pub mod objects;
pub mod place;
mod reader;
mod seen;
mod staging;
mod store;
mod uploads;

pub use self::backend::{Backend, Entry, Problem, Staged, Stat};
pub use self::begun::Upload;
pub use self::manifest::{MANIFEST_BYTES, ManifestError};
pub use self::reader::{PART_BYTES, Reader};
pub use self::store::BlobStore;
pub use self::uploads::{Arriving, IDLE, Protected, ResumeError};

pub(crate) use self::disk_error::{is_full, is_read_only};
