//! What is refused.

use protocol::{Fence, TaskId};

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
    /// There is as much of it as there may be; the same may be accepted later.
    #[error("{0}")]
    Full(String),
    /// It cannot be.
    #[error("{0}")]
    Invalid(String),
}
