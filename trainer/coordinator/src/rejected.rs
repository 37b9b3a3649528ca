//! What is refused.

use protocol::{Fence, RunId, TaskId};

/// Why an event did not happen. Nothing has changed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Rejected {
    /// The grant has been superseded.
    #[error("stale fence: task `{task}` is at fence {current}, the call carries {carried}")]
    StaleFence {
        task: TaskId,
        /// Its fence now.
        current: Fence,
        /// The fence of the call.
        carried: Fence,
    },
    /// No such thing.
    #[error("{0}")]
    NotFound(String),
    /// It contradicts what is.
    #[error("{0}")]
    Conflict(String),
    /// It cannot be.
    #[error("{0}")]
    Invalid(String),
    /// The caller may not ask for it.
    #[error("{0}")]
    Forbidden(String),
}

impl Rejected {
    /// There is no such run, or none that the caller sees.
    pub fn unknown_run(run: &RunId) -> Self {
        Self::NotFound(format!("run `{run}` is not known; `trainer status --all` lists runs"))
    }
}
