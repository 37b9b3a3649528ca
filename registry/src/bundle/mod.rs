//! A bundle: one version of a model in one file, `*.tar.zst`, to be drawn from on another machine.
//!
//! ```text
//! bundle.json      first: what it is (`Head`), as JSON
//! manifest.json    second: the model's manifest, whose digest is the version's artifact
//! card.md          for people: what it is, how it was measured, how to draw from it
//! ROLE/...         every file of the manifest under the name that it has there, a part's manifest among them
//! ```
//!
//! The archive is a plain POSIX one (`ustar`): regular files only, no extensions, so that a name is at most 255 bytes and nothing but names
//! stands between files; `tar --zstd -xf` unpacks it. Owners and times are zero, so one version always gives the same bytes. Compression is
//! zstd with a window of at most 2^[`WINDOW_LOG`] bytes. Statistics of the data, the text encoder and how the model is drawn from are in the
//! manifests already.
//!
//! Who reads a bundle trusts nothing in it. The manifest must have the digest that the head says, every file the length and digest that the
//! manifest says, and parts must make the model; whatever else is there is refused, and no more is unpacked than was announced. `format`
//! grows when an older build would misread a newer bundle; keys that only say more join without.

mod card;
mod import;
mod read;
mod write;

use std::collections::BTreeMap;

use checkpoint::BlobError;
use protocol::{Digest, Manifest, ModelName};
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use card::card;
pub use import::ImportError;
pub(crate) use import::origin;
pub use read::{Sink, read};
pub use write::{WriteError, Writer};

/// The version of the format that this build writes and reads.
pub const FORMAT: u32 = 1;
/// What a bundle's file is called at its end.
pub const SUFFIX: &str = ".tar.zst";
/// The largest window of the compression, as a power of two: 32 MiB, as `zstd -22` has at most by a quarter.
pub const WINDOW_LOG: u32 = 25;
/// Bytes of `bundle.json`, and of `card.md`.
pub const TEXT_BYTES: u64 = 1 << 20;
/// Bytes of all manifests together; ours have some kilobytes.
pub const MANIFESTS_BYTES: u64 = 32 << 20;
/// Files of a model.
pub const FILES: usize = 10_000;

const HEAD: &str = "bundle.json";
const MANIFEST: &str = "manifest.json";
const CARD: &str = "card.md";

/// What a bundle says of itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Head {
    /// [`FORMAT`] of the build that wrote it.
    pub format: u32,
    /// What the model was called there.
    pub model: ModelName,
    /// Its number there.
    pub version: u64,
    /// The model's manifest.
    pub artifact: Digest,
    /// Metrics by name; what was no number is null.
    pub metrics: BTreeMap<String, Option<f64>>,
    /// Where the version came from: run, stage, stage key, and which metric decides which version is best.
    pub source: Value,
}

/// A bundle that was read and is whole.
#[derive(Debug, Clone, PartialEq)]
pub struct Bundle {
    /// What it says of itself.
    pub head: Head,
    /// The model.
    pub manifest: Manifest,
    /// The card, if there is one.
    pub card: Option<String>,
}

/// Why a bundle is not taken.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// Something else.
    #[error("it is no bundle: {0}")]
    NotABundle(String),
    /// Of a later build.
    #[error("it is a bundle of format {found}, and this build reads {FORMAT}; use a newer build")]
    Newer {
        /// Its format.
        found: u64,
    },
    /// Cut, changed, or made to harm.
    #[error("entry `{entry}`: {why}")]
    Entry {
        /// The entry's name in the archive, or its number.
        entry: String,
        /// What is wrong with it.
        why: String,
    },
    /// The archive itself, or what it holds together.
    #[error("{0}")]
    Damaged(String),
    /// The store does not take it.
    #[error(transparent)]
    Blob(#[from] BlobError),
}
