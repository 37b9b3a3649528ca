//! Models, their versions, and the aliases that point at them.
//!
//! A version is numbered in the transaction that registers it: 1, 2, 3, without gaps. An alias moves by `promote` or
//! `rollback`, each one transaction that compares, judges the gates on stored metrics, moves and logs. `@best` is a
//! query over stored metrics, never state.

mod gate;
mod rules;

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use protocol::stage::Mode;
use protocol::{Alias, Digest, ModelName};
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use gate::{Gate, GateResult, ParseGateError};
pub use protocol::model_ref::{BEST, LATEST, ModelRef, Pick};
pub(crate) use rules::{compare, gates, judge, pick, previous, refuse_reserved, summary, unknown};

/// A model as a list shows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// Its name.
    pub model: ModelName,
    /// The metric that decides `@best`.
    pub metric: Option<String>,
    /// Its direction.
    pub mode: Option<Mode>,
    /// How many versions there are; the newest has this number.
    pub versions: u64,
    /// The best version, if one has a finite value of the metric.
    pub best: Option<u64>,
    /// Where the aliases point.
    pub aliases: BTreeMap<String, u64>,
}

/// A registered artifact. Never edited, except that metrics are added.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Version {
    pub model: ModelName,
    /// Its number, from 1.
    pub version: u64,
    /// A manifest of kind `model`.
    pub artifact: Digest,
    /// Metrics by name.
    pub metrics: BTreeMap<String, f64>,
    /// Run, stage, stage key.
    pub source: Value,
    /// When it was registered, in milliseconds since 1970.
    pub created_ms: i64,
    /// Aliases that point at it now.
    pub aliases: Vec<String>,
}

/// Whether an alias moved forward or back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Action {
    /// By `promote`.
    Promote,
    /// By `rollback`.
    Rollback,
}

/// One move of an alias.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Promotion {
    /// Its place in the log.
    pub id: i64,
    /// When, in milliseconds since 1970.
    pub at_ms: i64,
    pub model: ModelName,
    pub alias: Alias,
    /// Which way.
    pub action: Action,
    /// Where the alias pointed before.
    pub from: Option<u64>,
    /// Where it points since.
    pub to: u64,
    /// Who.
    pub actor: String,
    /// Why.
    pub reason: String,
    /// The gates, and the numbers that they were judged by.
    pub gates: Vec<GateResult>,
}

/// What a caller believes an alias to point at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Expect {
    /// The alias does not exist yet.
    None,
    /// It points at this version.
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
