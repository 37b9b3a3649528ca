//! Identifiers. Each has its own type, so that a fence cannot be passed as an attempt.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

macro_rules! text_id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
        #[serde(transparent)]
        pub struct $name(String);

        impl $name {
            /// Wraps a text that is known to be valid.
            pub fn new(text: impl Into<String>) -> Self {
                Self(text.into())
            }

            /// The identifier as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl From<&str> for $name {
            fn from(text: &str) -> Self {
                Self(text.to_owned())
            }
        }
    };
}

macro_rules! number_id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
        #[serde(transparent)]
        pub struct $name(pub u64);

        impl $name {
            /// The next value, one larger.
            #[must_use]
            pub fn next(self) -> Self {
                Self(self.0 + 1)
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{}", self.0)
            }
        }
    };
}

text_id! {
    /// One execution of a pipeline: `<pipeline name>-<first digits of its digest>-<number>`.
    RunId
}
text_id! {
    /// A node of a pipeline, as its author named it: `[a-z][a-z0-9_-]*`.
    StageName
}
text_id! {
    /// One stage of one run on one shard, to be done once: `<run>/<stage>` or `<run>/<stage>/<shard>`; `<run>/<stage>/files` comes before a stage
    /// whose files were not digested.
    TaskId
}
text_id! {
    /// A worker by name. Not a process: that is a `WorkerId` with an [`Incarnation`].
    WorkerId
}
text_id! {
    /// Name of a registered model: `[a-z0-9][a-z0-9._-]*`.
    ModelName
}
text_id! {
    /// A movable name for a model version, such as `staging`.
    Alias
}

number_id! {
    /// One try at a task, numbered from 1.
    Attempt
}
number_id! {
    /// Grows with every grant of a task; the store refuses a write that carries an older one.
    Fence
}
number_id! {
    /// Grows each time a gang's membership changes. For a gang task it is also the [`Fence`].
    Generation
}
number_id! {
    /// Grows each time a worker process starts.
    Incarnation
}
number_id! {
    /// Seed that keys all of a run's randomness, together with stage, purpose, step and index.
    Seed
}

impl TaskId {
    /// The task of a stage without shards, or of one shard of it.
    pub fn of(run: &RunId, stage: &StageName, shard: Option<u32>) -> Self {
        match shard {
            None => Self(format!("{run}/{stage}")),
            Some(shard) => Self(format!("{run}/{stage}/{shard}")),
        }
    }
}

impl TaskId {
    /// The task of digesting what a stage's settings name outside the store.
    pub fn of_resolving(run: &RunId, stage: &StageName) -> Self {
        Self(format!("{run}/{stage}/files"))
    }
}

/// A name with characters that have a meaning elsewhere.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` is not a valid {what}; expected a letter or digit, then letters, digits, `.`, `_` or `-`, at most 64 \
     characters"
)]
pub struct ParseNameError {
    /// Kind of the expected identifier.
    pub what: &'static str,
    pub text: String,
}

/// Returns true if `text` can be used in a path, a URL and a reference such as `model@alias` without quoting.
pub fn is_name(text: &str) -> bool {
    let mut bytes = text.bytes();
    text.len() <= 64
        && bytes.next().is_some_and(|b| b.is_ascii_alphanumeric())
        && bytes.all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
}

/// Returns true if `text` is a stage name for users: `[a-z][a-z0-9_-]*`, at most 64. Names made by the program have
/// dots.
pub fn is_stage_name(text: &str) -> bool {
    is_name(text)
        && text.starts_with(|c: char| c.is_ascii_lowercase())
        && text.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || matches!(b, b'_' | b'-'))
}

impl FromStr for ModelName {
    type Err = ParseNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if is_name(text) {
            Ok(Self(text.to_owned()))
        } else {
            Err(ParseNameError { what: "model name", text: text.to_owned() })
        }
    }
}

impl FromStr for Alias {
    type Err = ParseNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if is_name(text) {
            Ok(Self(text.to_owned()))
        } else {
            Err(ParseNameError { what: "alias", text: text.to_owned() })
        }
    }
}
