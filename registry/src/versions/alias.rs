//! Moves of aliases, as logged, and the target that a mover expects.

use std::str::FromStr;

use protocol::{Alias, ModelName};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::gate::GateResult;

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
