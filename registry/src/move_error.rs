//! Errors of moving a catalog between databases.

use crate::error::QueryError;
use crate::open_error::OpenError;

/// Error of a move. The former database is unchanged.
#[derive(Debug, thiserror::Error)]
pub enum MoveError {
    /// A database could not be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The copy failed or differs.
    #[error("nothing was moved: {0}")]
    Query(#[from] QueryError),
    /// The store has its catalog there already, or the place has another one.
    #[error("{0}")]
    Refused(String),
}
