//! Entries of the history of runs, stages and workers.

use protocol::{ModelName, RunId, StageName, TaskId, WorkerId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Kind of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum HistoryKind {
    /// A run was submitted.
    Submitted,
    /// A run was paused.
    Paused,
    /// A run was taken up again.
    Resumed,
    /// A run finished, failed or was cancelled.
    Ended,
    /// A worker process joined.
    Joined,
    /// A worker that was lost was heard again.
    Returned,
    /// A worker was not heard or not reached any more.
    Lost,
    /// A worker's process ended.
    Left,
    /// A worker was given a task.
    Granted,
    /// A gang continues with other members.
    Regrouped,
    /// A gang took a worker in.
    Adopted,
    /// A task was given back, to be continued later.
    Released,
    /// An attempt ended without a result; another one follows.
    Retried,
    /// A stage made no progress for long.
    Stalled,
    /// A checkpoint was committed.
    Checkpoint,
    /// A stage has its value.
    Finished,
    /// A stage failed.
    Failed,
    /// An alias was moved forward.
    Promoted,
    /// An alias was moved back.
    RolledBack,
}

impl HistoryKind {
    pub(crate) const ALL: [Self; 19] = [
        Self::Submitted,
        Self::Paused,
        Self::Resumed,
        Self::Ended,
        Self::Joined,
        Self::Returned,
        Self::Lost,
        Self::Left,
        Self::Granted,
        Self::Regrouped,
        Self::Adopted,
        Self::Released,
        Self::Retried,
        Self::Stalled,
        Self::Checkpoint,
        Self::Finished,
        Self::Failed,
        Self::Promoted,
        Self::RolledBack,
    ];

    /// Its name in JSON and in the table.
    pub fn name(self) -> &'static str {
        match self {
            Self::Submitted => "submitted",
            Self::Paused => "paused",
            Self::Resumed => "resumed",
            Self::Ended => "ended",
            Self::Joined => "joined",
            Self::Returned => "returned",
            Self::Lost => "lost",
            Self::Left => "left",
            Self::Granted => "granted",
            Self::Regrouped => "regrouped",
            Self::Adopted => "adopted",
            Self::Released => "released",
            Self::Retried => "retried",
            Self::Stalled => "stalled",
            Self::Checkpoint => "checkpoint",
            Self::Finished => "finished",
            Self::Failed => "failed",
            Self::Promoted => "promoted",
            Self::RolledBack => "rolled-back",
        }
    }
}

/// One event, with everything that it is about.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct HistoryEntry {
    pub kind: HistoryKind,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<RunId>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stage: Option<StageName>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<TaskId>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attempt: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worker: Option<WorkerId>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<ModelName>,
    /// The token that asked for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actor: Option<String>,
    /// Reason that the actor gave.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
}

impl HistoryEntry {
    /// An event about nothing yet.
    pub fn new(kind: HistoryKind) -> Self {
        Self {
            kind,
            run: None,
            stage: None,
            task: None,
            attempt: None,
            step: None,
            worker: None,
            model: None,
            actor: None,
            why: None,
        }
    }
}
