//! Counters of the limited amounts that each run has stored.

use protocol::RunId;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::statement::{int, run};
use crate::catalog::{KindSize, Usage};
use crate::{QueryError, WriteError};

/// Adds amounts to the counters of a run.
pub(super) async fn add(
    conn: &mut SqliteConnection,
    of_run: &str,
    log_bytes: u64,
    values: u64,
) -> Result<(), WriteError> {
    let add = "INSERT INTO usage (run, log_bytes, \"values\") VALUES (?, ?, ?) ON CONFLICT (run) DO UPDATE SET \
               log_bytes = log_bytes + excluded.log_bytes, \"values\" = \"values\" + excluded.\"values\"";
    run(conn, sqlx::query(add).bind(of_run).bind(int(log_bytes)).bind(int(values))).await.map(|_| ())
}

/// Reads the counters of a run.
pub(super) async fn read(conn: &mut SqliteConnection, of_run: &RunId) -> Result<Usage, QueryError> {
    let find = sqlx::query("SELECT log_bytes, \"values\" FROM usage WHERE run = ?").bind(of_run.as_str());
    let Some(row) = find.fetch_optional(&mut *conn).await? else { return Ok(Usage::default()) };
    let (log_bytes, values): (i64, i64) = (row.try_get(0)?, row.try_get(1)?);
    Ok(Usage { log_bytes: log_bytes.unsigned_abs(), values: values.unsigned_abs() })
}

/// Sizes of all artifacts by kind.
pub(super) async fn kind_sizes(conn: &mut SqliteConnection) -> Result<Vec<KindSize>, QueryError> {
    let find = "SELECT kind, count(*), coalesce(sum(bytes), 0) FROM artifacts GROUP BY kind ORDER BY 3 DESC, kind";
    let rows = sqlx::query(find).fetch_all(conn).await?;
    let size = |row: &SqliteRow| -> Result<KindSize, sqlx::Error> {
        let (count, bytes): (i64, i64) = (row.try_get(1)?, row.try_get(2)?);
        Ok(KindSize { kind: row.try_get(0)?, count: count.unsigned_abs(), bytes: bytes.unsigned_abs() })
    };
    Ok(rows.iter().map(size).collect::<Result<_, _>>()?)
}
