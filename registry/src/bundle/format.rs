//! The format of bundles: names of entries, limits, the description, and the errors of readers.

use std::collections::BTreeMap;

use checkpoint::BlobError;
use protocol::{Digest, Manifest, ModelName};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Version of the format that this build writes and reads.
pub const FORMAT: u32 = 1;
/// Suffix of a bundle's file name.
pub const SUFFIX: &str = ".tar.zst";
/// Largest window of the compression, as a power of two: 32 MiB. `zstd -22` uses up to four times that.
pub const WINDOW_LOG: u32 = 25;
/// Size limit of `bundle.json` and of `card.md`.
pub const TEXT_BYTES: u64 = 1 << 20;
/// Size limit of all manifests together; ours have some kilobytes.
pub const MANIFESTS_BYTES: u64 = 32 << 20;
/// Limit of the number of files.
pub const FILES: usize = 10_000;

pub(super) const HEAD: &str = "bundle.json";
pub(super) const MANIFEST: &str = "manifest.json";
pub(super) const CARD: &str = "card.md";

/// Description of a bundle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Head {
    /// [`FORMAT`] of the build that wrote it.
    pub format: u32,
    /// The model's name in the exporting store.
    pub model: ModelName,
    /// Version number in the exporting store.
    pub version: u64,
    /// Digest of the model's manifest.
    pub artifact: Digest,
    /// Metrics by name; null for values that are not numbers.
    pub metrics: BTreeMap<String, Option<f64>>,
    /// Origin of the version: run, stage, stage key, and the metric that ranks the model's versions.
    pub source: Value,
}

/// A bundle that was read and verified.
#[derive(Debug, Clone, PartialEq)]
pub struct Bundle {
    /// Model, version, metrics and origin, as the bundle states them.
    pub head: Head,
    /// The model's manifest.
    pub manifest: Manifest,
    /// The card, if there is one.
    pub card: Option<String>,
}

/// Reason why a bundle is refused.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// The file is not a bundle.
    #[error("it is not a bundle: {0}")]
    NotABundle(String),
    /// A later build wrote the bundle.
    #[error("it has bundle format {found}, but this build reads {FORMAT}; use a newer build")]
    Newer {
        /// Format number of the bundle.
        found: u64,
    },
    /// An entry is cut, changed or malicious.
    #[error("entry `{entry}`: {why}")]
    Entry {
        /// The entry's name in the archive, or its number.
        entry: String,
        /// Description of the error.
        why: String,
    },
    /// The archive is damaged, or its files do not fit together.
    #[error("{0}")]
    Damaged(String),
    /// The store refused a file.
    #[error(transparent)]
    Blob(#[from] BlobError),
}
