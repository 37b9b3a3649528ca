//! Why a question has no answer, and why nothing was written.

use protocol::{Fence, TaskId};

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    /// No such thing.
    #[error("{0}")]
    NotFound(String),
    /// The question is malformed.
    #[error("{0}")]
    Invalid(String),
    /// The database.
    #[error("database: {0}")]
    Database(String),
    /// The blobs.
    #[error("{0}")]
    Blob(String),
    /// The disk did not take a change.
    #[error("{0}")]
    Storage(String),
}

/// Why nothing of a transaction was stored.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// Somebody else holds the task now.
    #[error("stale fence: the grant of task `{task}` with fence {carried} has been superseded")]
    StaleFence {
        task: TaskId,
        /// The fence in the store. Not part of the message, which the caller sees.
        current: Fence,
        /// The fence of the write.
        carried: Fence,
    },
    /// Another process has opened the store since this one did, so this one may not write to it any more.
    #[error(
        "the store was opened by another process: this one held it under epoch {epoch}, which is over; nothing was written"
    )]
    Superseded {
        /// This process's epoch.
        epoch: u64,
    },
    /// What is stored contradicts it.
    #[error("{0}")]
    Conflict(String),
    /// A promotion gate does not hold; the message says by how much.
    #[error("{0}")]
    Gate(String),
    /// No such thing.
    #[error("{0}")]
    NotFound(String),
    /// Full or not writable.
    #[error("{0}")]
    Storage(String),
    /// Nobody has shown that what it names is whole, or a collection has come between. Nothing is wrong with it yet: see
    /// [`Store::prove`](crate::Store::prove).
    #[error("artifact {artifact} is not proven whole; upload what is missing of it and name it again")]
    Unproven { artifact: protocol::Digest },
    /// The place where the blobs lie does not answer; the same write may succeed later.
    #[error("{0}")]
    Unreachable(String),
    /// A fault of ours or of the database.
    #[error("{0}")]
    Internal(String),
}

impl From<QueryError> for WriteError {
    fn from(e: QueryError) -> Self {
        match e {
            QueryError::NotFound(message) => Self::NotFound(message),
            QueryError::Invalid(message) => Self::Conflict(message),
            QueryError::Database(message) => Self::Internal(format!("database: {message}")),
            QueryError::Blob(message) => Self::Internal(message),
            QueryError::Storage(message) => Self::Storage(message),
        }
    }
}
