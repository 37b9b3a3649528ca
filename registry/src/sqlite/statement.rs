//! Running one statement, and the values that are bound to it.

use protocol::TaskId;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::error::write_error;
use crate::WriteError;

type Result<T> = std::result::Result<T, WriteError>;

pub(super) type Query<'q> = sqlx::query::Query<'q, sqlx::Sqlite, sqlx::sqlite::SqliteArguments>;

/// Runs a statement and returns how many rows it changed.
pub(super) async fn run(conn: &mut SqliteConnection, query: Query<'_>) -> Result<u64> {
    query.execute(conn).await.map(|done| done.rows_affected()).map_err(write_error)
}

pub(super) async fn one(conn: &mut SqliteConnection, query: Query<'_>) -> Result<Option<SqliteRow>> {
    query.fetch_optional(conn).await.map_err(write_error)
}

/// SQLite's integers are signed; none of our counters comes near the sign.
pub(super) fn int(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

pub(super) fn json<T: serde::Serialize>(value: &T) -> String {
    // Maps of names to numbers or digests always serialise.
    serde_json::to_string(value).unwrap_or_else(|e| panic!("a row that is no JSON: {e}"))
}

/// A task's run and stage, out of its name.
pub(super) fn run_and_stage(task: &TaskId) -> (&str, &str) {
    let mut parts = task.as_str().split('/');
    (parts.next().unwrap_or_default(), parts.next().unwrap_or_default())
}
