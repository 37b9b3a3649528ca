//! Translation of database errors for opening, queries and writes.

use std::path::Path;

use crate::open_error::OpenError;
use crate::{QueryError, WriteError};

/// Returns SQLite's primary result code of an error, if it has one.
fn code(e: &sqlx::Error) -> Option<i32> {
    let code = e.as_database_error()?.code()?.parse::<i32>().ok()?;
    Some(code & 0xff)
}

const SQLITE_READONLY: i32 = 8;
const SQLITE_IOERR: i32 = 10;
const SQLITE_CORRUPT: i32 = 11;
const SQLITE_FULL: i32 = 13;
const SQLITE_CANTOPEN: i32 = 14;
const SQLITE_NOTADB: i32 = 26;

pub(super) fn open_error(path: &Path, e: &sqlx::Error) -> OpenError {
    let (path, message) = (path.to_owned(), e.to_string());
    match code(e) {
        Some(SQLITE_READONLY | SQLITE_CANTOPEN) => OpenError::ReadOnly { path, message },
        Some(SQLITE_FULL) => OpenError::Full { path, message },
        Some(SQLITE_CORRUPT | SQLITE_NOTADB) => OpenError::Damaged { path, message },
        _ => OpenError::Other { path, message },
    }
}

impl From<sqlx::Error> for QueryError {
    fn from(e: sqlx::Error) -> Self {
        match code(&e) {
            Some(SQLITE_IOERR | SQLITE_FULL) => {
                Self::Storage(format!("the disk failed while reading the database ({e})"))
            }
            _ => Self::Database(e.to_string()),
        }
    }
}

/// Translates a database error of a write: a problem of the disk, or an internal one.
pub(super) fn write_error(e: sqlx::Error) -> WriteError {
    match code(&e) {
        Some(SQLITE_FULL) => WriteError::Storage(
            "the disk is full: the database could not grow; `registry gc` removes unneeded blobs, even on a full disk; then \
             run the same command again"
                .into(),
        ),
        Some(SQLITE_READONLY | SQLITE_CANTOPEN) => {
            WriteError::Storage(format!("the database is not writable ({e}); make the store writable and run the same command again"))
        }
        Some(SQLITE_IOERR) => WriteError::Storage(format!("the disk failed while writing the database ({e}); check the disk and run the same command again")),
        _ => WriteError::Internal(format!("database: {e}")),
    }
}
