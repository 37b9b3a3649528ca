//! What is refused.

use protocol::{Fence, TaskId};

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
    /// A worker's name belongs to another token.
    #[error("{0}")]
    Forbidden(String),
    /// No such thing.
    #[error("{0}")]
    NotFound(String),
    /// It contradicts what is.
    #[error("{0}")]
    Conflict(String),
    /// It cannot be.
    #[error("{0}")]
    Invalid(String),
}
