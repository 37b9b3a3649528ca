//! Refusals of events.

use protocol::{Fence, RunId, TaskId};

/// The reason for refusing an event. The state is unchanged.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Rejected {
    /// The grant has been superseded.
    #[error("stale fence: the grant of task `{task}` with fence {carried} has been superseded")]
    StaleFence {
        task: TaskId,
        /// The fence of the call. The task's current fence is not disclosed.
        carried: Fence,
    },
    /// Another process with an unexpired lease uses the worker's name.
    #[error("{0}")]
    NameHeld(String),
    /// The caller has no permission: the worker, run or alias belongs to another token.
    #[error("{0}")]
    Forbidden(String),
    /// The named object does not exist.
    #[error("{0}")]
    NotFound(String),
    /// The request conflicts with the current state.
    #[error("{0}")]
    Conflict(String),
    /// A limit is reached; the same request may be accepted later.
    #[error("{0}")]
    Full(String),
    /// The group has stored as much as it may.
    #[error("{0}")]
    UsedUp(String),
    /// The request is invalid.
    #[error("{0}")]
    Invalid(String),
}

impl Rejected {
    /// The run does not exist or is invisible to the caller.
    pub fn unknown_run(run: &RunId) -> Self {
        Self::NotFound(format!("run `{run}` is not known; `trainer status --all` lists runs"))
    }
}
