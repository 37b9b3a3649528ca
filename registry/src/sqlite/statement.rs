//! Helpers to run one statement and to bind its values.

use protocol::TaskId;
use sqlx::query_builder::Separated;
use sqlx::sqlite::SqliteRow;
use sqlx::{QueryBuilder, Sqlite, SqliteConnection};

use super::error::write_error;
use crate::WriteError;

type Result<T> = std::result::Result<T, WriteError>;

pub(super) type Query<'q> = sqlx::query::Query<'q, sqlx::Sqlite, sqlx::sqlite::SqliteArguments>;

/// Rows of one statement: ten values each stay below SQLite's limit for a statement's values.
pub(super) const ROWS: usize = 250;

/// Runs a statement and returns how many rows it changed.
pub(super) async fn run(conn: &mut SqliteConnection, query: Query<'_>) -> Result<u64> {
    query.execute(conn).await.map(|done| done.rows_affected()).map_err(write_error)
}

pub(super) async fn one(conn: &mut SqliteConnection, query: Query<'_>) -> Result<Option<SqliteRow>> {
    query.fetch_optional(conn).await.map_err(write_error)
}

/// Runs `begin` with a tuple of values for each row, and `end`, as few statements as there may be.
pub(super) async fn insert<T>(
    conn: &mut SqliteConnection,
    begin: &'static str,
    rows: &[T],
    values: impl Fn(&mut Separated<'_, Sqlite, &'static str>, &T),
    end: &'static str,
) -> Result<()> {
    for rows in rows.chunks(ROWS) {
        let mut query = QueryBuilder::<Sqlite>::new(begin);
        query.push_values(rows, |mut row, value| values(&mut row, value)).push(end);
        // Another number of rows is another statement: not worth keeping.
        run(conn, query.build().persistent(false)).await?;
    }
    Ok(())
}

/// SQLite's integers are signed; none of our counters comes near the sign.
pub(super) fn int(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

pub(super) fn json<T: serde::Serialize>(value: &T) -> String {
    // Maps of names to numbers or digests always serialise.
    serde_json::to_string(value).unwrap_or_else(|e| panic!("cannot serialise a row: {e}"))
}

/// Splits a task's name into run and stage.
pub(super) fn run_and_stage(task: &TaskId) -> (&str, &str) {
    let mut parts = task.as_str().split('/');
    (parts.next().unwrap_or_default(), parts.next().unwrap_or_default())
}
