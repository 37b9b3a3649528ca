//! Content-addressed bytes: the name of a blob is its hash.
//!
//! [`BlobStore`] verifies what is read and reused, stores equal bytes once, repairs damaged blobs, and keeps garbage
//! collection away from blobs that are being put. Bytes are passed in parts; no function holds a whole blob unless
//! asked to. A [`Backend`] decides where bytes are stored: a folder ([`fs::Folder`]), an object store
//! ([`objects::Objects`]) or memory ([`memory::Memory`]). All backends pass the same functions in
//! `registry/tests/conformance.rs`.
//!
//! Other modules decide which blobs are needed ([`crate::retention`]) and which writers are allowed.

mod backend;
mod begun;
mod direct;
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
pub(crate) use self::manifest::listed;
