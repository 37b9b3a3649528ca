//! Models, their versions, and the aliases that point at them.
//!
//! The transaction that registers a version numbers it: 1, 2, 3, without gaps. `promote` and `rollback` move an alias
//! in one transaction that compares, checks the gates on stored metrics, moves and logs. `@best` is a query over stored
//! metrics and never stored itself.

mod gate;
mod rules;

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use protocol::stage::Mode;
use protocol::{Alias, Digest, ModelName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use gate::{Gate, GateResult, ParseGateError};
pub use protocol::model_ref::{BEST, LATEST, ModelRef, Pick};
pub(crate) use rules::{compare, evaluate, gates, pick, previous, refuse_reserved, summary, unknown};

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

/// Kind of an alias's move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Action {
    /// A move by `promote`.
    Promote,
    /// A move by `rollback`.
    Rollback,
}

/// One move of an alias.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Promotion {
    /// Number of the log entry.
    pub id: i64,
    /// Time of the move, in milliseconds since 1970.
    pub at_ms: i64,
    pub model: ModelName,
    pub alias: Alias,
    /// Kind of the move.
    pub action: Action,
    /// Version before the move, if the alias existed.
    pub from: Option<u64>,
    /// Version after the move.
    pub to: u64,
    /// Name of the caller.
    pub actor: String,
    /// Reason given by the caller.
    pub reason: String,
    /// Results of the gates.
    pub gates: Vec<GateResult>,
}

/// Expected target of an alias.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(into = "String", try_from = "String")]
#[schemars(with = "String")]
pub enum Expect {
    /// The alias does not exist yet.
    None,
    /// The alias points at this version.
    Version(u64),
}

impl FromStr for Expect {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "none" {
            return Ok(Self::None);
        }
        text.parse().map(Self::Version).map_err(|_| format!("`{text}` is not a version: expected a number or `none`"))
    }
}

impl TryFrom<String> for Expect {
    type Error = String;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Expect> for String {
    fn from(expect: Expect) -> Self {
        expect.to_string()
    }
}

impl fmt::Display for Expect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Version(version) => write!(f, "{version}"),
        }
    }
}
