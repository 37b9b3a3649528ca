//! Answers to commands, and the exit codes of errors.

use std::collections::BTreeMap;

use checkpoint::model::Parts;
use protocol::artifact::Role;
use protocol::message::ApiError;
use protocol::{Manifest, ModelName, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::audit::AuditEntry;
use crate::backup::{BackupError, Summary};
use crate::forget::Forgotten;
use crate::leaderboard::{Comparison, Leaderboard, Style};
use crate::retention::Plan;
use crate::versions::{Model, Promotion, Version};
use crate::{LineageNode, OpenError, QueryError, StoreId, WriteError, fsck};

/// The table of exit codes for `--help`. They have the same meaning in `trainer`.
pub const EXIT_CODES: &str = "\
Exit codes:
    0  done
    1  the requested operation failed
    2  wrong usage, or a store that cannot be used; nothing was changed
    4  a conflict with what is stored
    5  the token is missing or lacks a scope
    6  the process that holds the store does not answer
    7  there is no such model, version, run or artifact
    9  stored data is damaged
   10  a gate does not hold; nothing was changed";

/// Result of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[expect(missing_docs, reason = "each field is the type it holds")]
pub enum Data {
    /// Result of `list`.
    Models { models: Vec<Model> },
    /// Result of `show MODEL`.
    Model { model: Model, versions: Vec<Version> },
    /// Result of `show MODEL@ALIAS`.
    Version {
        version: Version,
        manifest: Manifest,
        /// For each part of a model, the parts it was made for.
        #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
        fits: BTreeMap<Role, Parts>,
        /// Versions that a control part was made for, as `MODEL:VERSION`, among the newest thousand.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        bases: Vec<String>,
    },
    /// Result of `history`.
    History { model: ModelName, history: Vec<Promotion> },
    /// Result of `promote` and `rollback`.
    Promotion { promotion: Promotion },
    /// Result of `compare`.
    Comparison { comparison: Comparison, style: Style },
    /// Result of `leaderboard`.
    Leaderboard { leaderboard: Leaderboard, style: Style },
    /// Result of `lineage`.
    Lineage { nodes: Vec<LineageNode> },
    /// Result of `fsck`.
    Fsck { report: fsck::Report },
    /// Result of `gc`.
    Gc { dry_run: bool, plan: Plan },
    /// Result of `adopt`.
    Adopted { store: StoreId },
    /// Result of `audit`.
    Audit { entries: Vec<AuditEntry> },
    /// Result of `forget`.
    Forgotten { runs: Vec<(RunId, Forgotten)> },
    /// Result of `backup`.
    BackedUp { summary: Summary, dir: std::path::PathBuf },
    /// Result of `restore`.
    Restored { summary: Summary, dir: std::path::PathBuf },
    /// Result of `migrate`.
    Migrated {
        from: String,
        to: String,
        /// Number of copied rows.
        rows: u64,
    },
    /// Result of `export`.
    Exported {
        version: Version,
        dir: std::path::PathBuf,
        files: Vec<String>,
        /// Parts that the layout cannot hold.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        left_out: Vec<String>,
    },
    /// Result of `import`.
    Imported { version: Version, file: String },
}

/// Answer to a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Answer {
    /// The process's exit code.
    pub exit: u8,
    /// Result of the command, if there is one.
    pub data: Option<Data>,
    /// Reason of a refusal, or a problem that was found.
    pub error: Option<ApiError>,
}

impl Answer {
    pub(super) fn done(data: Data) -> Self {
        Self { exit: 0, data: Some(data), error: None }
    }

    /// Makes an answer of an error, with the exit code of the error's code.
    pub fn refused(error: ApiError) -> Self {
        let exit = match error.code.as_str() {
            "invalid" | "store" => 2,
            "not-found" => 7,
            "conflict" | "stale-fence" => 4,
            "unauthorized" | "forbidden" => 5,
            "unreachable" => 6,
            "damaged" => 9,
            "gate" => 10,
            _ => 1,
        };
        Self { exit, data: None, error: Some(error) }
    }
}

pub(super) fn error(code: &str, message: impl ToString, hint: Option<&str>) -> ApiError {
    ApiError { code: code.into(), message: message.to_string(), hint: hint.map(str::to_owned) }
}

impl From<QueryError> for Answer {
    fn from(e: QueryError) -> Self {
        Self::refused(match &e {
            QueryError::NotFound(_) => error("not-found", e, Some("`registry list` shows the models")),
            QueryError::Invalid(_) => {
                error("invalid", e, Some("`registry list` shows models, `registry show MODEL` their versions"))
            }
            QueryError::Storage(_) => error("storage", e, None),
            QueryError::Database(_) | QueryError::Blob(_) => {
                error("internal", e, Some("`registry fsck` checks the store"))
            }
        })
    }
}

impl From<WriteError> for Answer {
    fn from(e: WriteError) -> Self {
        Self::refused(match &e {
            WriteError::StaleFence { .. } => error("stale-fence", e, None),
            WriteError::Conflict(_) => {
                error("conflict", e, Some("`registry history MODEL` shows the moves of aliases"))
            }
            WriteError::Gate(_) => error(
                "gate",
                e,
                Some("nothing was changed; `registry show MODEL` lists every version with its metrics"),
            ),
            WriteError::NotFound(_) => error("not-found", e, Some("`registry list` shows the models")),
            WriteError::Storage(_) | WriteError::Superseded { .. } => error("storage", e, None),
            WriteError::Unreachable(_) => error("unreachable", e, None),
            WriteError::Unproven { .. } | WriteError::Internal(_) => {
                error("internal", e, Some("`registry fsck` checks the store"))
            }
        })
    }
}

impl From<&OpenError> for Answer {
    fn from(e: &OpenError) -> Self {
        Self::refused(error("store", e, Some(&e.hint())))
    }
}

impl From<BackupError> for Answer {
    fn from(e: BackupError) -> Self {
        match e {
            BackupError::Folder(_) => Self::refused(error("invalid", e, Some("name another folder"))),
            BackupError::Damaged(_) => Self::refused(error("damaged", e, Some("`registry fsck` checks a store"))),
            BackupError::Disk { .. } => {
                Self::refused(error("storage", e, Some("check the disk and run the same command again")))
            }
            BackupError::Query(e) => Self::from(e),
        }
    }
}

pub(super) fn invalid(message: impl ToString) -> Refused {
    Refused::from(error("invalid", message, Some("`registry help` shows the syntax")))
}

/// An answer with an error, for use with `?`.
pub(super) struct Refused(pub(super) Box<Answer>);

impl<E: Into<Answer>> From<E> for Refused {
    fn from(e: E) -> Self {
        Self(Box::new(e.into()))
    }
}

impl From<ApiError> for Answer {
    fn from(error: ApiError) -> Self {
        Self::refused(error)
    }
}
