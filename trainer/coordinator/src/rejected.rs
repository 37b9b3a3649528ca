//! What is refused.

use protocol::{Fence, RunId, TaskId};

/// Why an event did not happen. Nothing has changed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Rejected {
    /// The grant has been superseded.
    #[error("stale fence: the grant of task `{task}` with fence {carried} has been superseded")]
    StaleFence {
        task: TaskId,
        /// The fence of the call. The task's own is not told.
        carried: Fence,
    },
    /// A worker's name is another process's, whose lease has not ended.
    #[error("{0}")]
    NameHeld(String),
    /// The caller may not ask for it: another token's worker, run or alias.
    #[error("{0}")]
    Forbidden(String),
    /// No such thing.
    #[error("{0}")]
    NotFound(String),
    /// It contradicts what is.
    #[error("{0}")]
    Conflict(String),
    /// There is as much of it as there may be; the same may be accepted later.
    #[error("{0}")]
    Full(String),
    /// It cannot be.
    #[error("{0}")]
    Invalid(String),
}

impl Rejected {
    /// There is no such run, or none that the caller sees.
    pub fn unknown_run(run: &RunId) -> Self {
        Self::NotFound(format!("run `{run}` is not known; `trainer status --all` lists runs"))
    }
}
