//! Translation of database errors for opening, queries and writes.

use std::path::Path;

use sqlx::postgres::PgDatabaseError;
use sqlx::sqlite::SqliteError;

use crate::open_error::OpenError;
use crate::{QueryError, WriteError};

/// Kind of an error that a caller can act on.
enum Kind {
    ReadOnly,
    Io,
    Corrupt,
    Full,
    CannotOpen,
    NotADatabase,
    /// The server, or the connection to it, went away.
    Gone,
    /// A text that the server cannot store.
    Text,
    Other,
}

fn kind(e: &sqlx::Error) -> Kind {
    let Some(error) = e.as_database_error() else {
        return match e {
            sqlx::Error::Io(_) | sqlx::Error::Tls(_) | sqlx::Error::Protocol(_) | sqlx::Error::PoolTimedOut => {
                Kind::Gone
            }
            _ => Kind::Other,
        };
    };
    if let Some(error) = error.try_downcast_ref::<PgDatabaseError>() {
        return match error.code() {
            "53100" => Kind::Full,
            "58030" => Kind::Io,
            "XX001" | "XX002" => Kind::Corrupt,
            "25006" | "42501" => Kind::ReadOnly,
            // A session that was ended, a server that starts or stops, too many connections, a broken connection.
            "25P03" | "57P01" | "57P02" | "57P03" | "57P05" | "53300" => Kind::Gone,
            code if code.starts_with("08") => Kind::Gone,
            "22021" | "22P05" => Kind::Text,
            _ => Kind::Other,
        };
    }
    let is_sqlite = error.try_downcast_ref::<SqliteError>().is_some();
    let code = error.code().filter(|_| is_sqlite).and_then(|code| code.parse::<i32>().ok());
    // The primary result codes of SQLite.
    match code.map(|code| code & 0xff) {
        Some(8) => Kind::ReadOnly,
        Some(10) => Kind::Io,
        Some(11) => Kind::Corrupt,
        Some(13) => Kind::Full,
        Some(14) => Kind::CannotOpen,
        Some(26) => Kind::NotADatabase,
        _ => Kind::Other,
    }
}

pub(super) fn open_error(path: &Path, e: &sqlx::Error) -> OpenError {
    let path = path.to_owned();
    // The text of PostgreSQL's errors has a line of its own sources.
    let message = match e {
        sqlx::Error::Database(e) if path.starts_with("postgres:") => e.message().to_owned(),
        _ => e.to_string(),
    };
    match kind(e) {
        Kind::ReadOnly | Kind::CannotOpen => OpenError::ReadOnly { path, message },
        Kind::Full => OpenError::Full { path, message },
        Kind::Corrupt | Kind::NotADatabase => OpenError::Damaged { path, message },
        Kind::Gone | Kind::Io | Kind::Text | Kind::Other => OpenError::Other { path, message },
    }
}

impl From<sqlx::Error> for QueryError {
    fn from(e: sqlx::Error) -> Self {
        match kind(&e) {
            Kind::Io | Kind::Full => Self::Storage(format!("the disk failed while reading the database ({e})")),
            Kind::Gone => Self::Storage(format!("the database does not answer ({e}); run the same command again")),
            _ => Self::Database(e.to_string()),
        }
    }
}

/// Translates a database error of a write: a problem of the disk or of the connection, or an internal one.
pub(super) fn write_error(e: sqlx::Error) -> WriteError {
    match kind(&e) {
        Kind::Full => WriteError::Storage(
            "the disk is full: the database could not grow; `registry gc` removes unneeded blobs, even on a full disk; then \
             run the same command again"
                .into(),
        ),
        Kind::ReadOnly | Kind::CannotOpen => {
            WriteError::Storage(format!("the database is not writable ({e}); make the store writable and run the same command again"))
        }
        Kind::Io => WriteError::Storage(format!("the disk failed while writing the database ({e}); check the disk and run the same command again")),
        Kind::Gone => WriteError::Unreachable(format!("the database does not answer ({e})")),
        Kind::Text => WriteError::Conflict("a text has a character that PostgreSQL cannot store (NUL)".into()),
        Kind::Corrupt | Kind::NotADatabase | Kind::Other => WriteError::Internal(format!("database: {e}")),
    }
}
