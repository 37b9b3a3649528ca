//! Errors of queries and writes.

use protocol::{Fence, TaskId};

/// Error of a query.
#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    /// The object does not exist.
    #[error("{0}")]
    NotFound(String),
    /// The query is malformed.
    #[error("{0}")]
    Invalid(String),
    /// The database failed.
    #[error("database: {0}")]
    Database(String),
    /// A blob could not be read.
    #[error("{0}")]
    Blob(String),
    /// The disk refused a change.
    #[error("{0}")]
    Storage(String),
}

/// Reason why a transaction was not stored.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// Another grant holds the task now.
    #[error("stale fence: the grant of task `{task}` with fence {carried} has been superseded")]
    StaleFence {
        task: TaskId,
        /// The fence in the store. It is not part of the message, which the caller sees.
        current: Fence,
        /// The fence of the write.
        carried: Fence,
    },
    /// Another process has opened the store since, so this one may no longer write.
    #[error("another process has opened the store, which ended this one's epoch {epoch}; nothing was written")]
    Superseded {
        /// This process's epoch.
        epoch: u64,
    },
    /// The write contradicts stored data.
    #[error("{0}")]
    Conflict(String),
    /// A promotion gate fails; the message has the numbers.
    #[error("{0}")]
    Gate(String),
    /// The object does not exist.
    #[error("{0}")]
    NotFound(String),
    /// The disk is full or not writable.
    #[error("{0}")]
    Storage(String),
    /// The artifact is not proven whole, or a collection has started since its proof. The write may succeed after
    /// [`Store::prove`](crate::Store::prove).
    #[error("artifact {artifact} is not proven whole; upload its missing blobs and repeat the request")]
    Unproven { artifact: protocol::Digest },
    /// The blobs' backend does not answer; the same write may succeed later.
    #[error("{0}")]
    Unreachable(String),
    /// An internal error, or one of the database.
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
