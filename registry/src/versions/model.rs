//! Models and their versions, as clients see them.

use std::collections::BTreeMap;

use protocol::stage::Mode;
use protocol::{Digest, ModelName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A model in a listing.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Model {
    pub model: ModelName,
    /// The metric that ranks `@best`.
    pub metric: Option<String>,
    /// Direction of that metric.
    pub mode: Option<Mode>,
    /// Number of versions, which is also the newest version's number.
    pub versions: u64,
    /// The best version, if one has a finite value of the metric.
    pub best: Option<u64>,
    /// Aliases with their versions.
    pub aliases: BTreeMap<String, u64>,
}

/// A registered artifact. Only its metrics can be extended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Version {
    pub model: ModelName,
    /// Number of the version, from 1.
    pub version: u64,
    /// Digest of a manifest of kind `model`.
    pub artifact: Digest,
    /// Metrics by name.
    #[schemars(with = "BTreeMap<String, Option<f64>>")]
    pub metrics: BTreeMap<String, f64>,
    /// Origin: run, stage, stage key.
    pub source: Value,
    /// Time of registration, in milliseconds since 1970.
    pub created_ms: i64,
    /// Aliases that point at this version.
    pub aliases: Vec<String>,
}
