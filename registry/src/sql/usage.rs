//! Counters of the limited amounts that each run has stored.

use protocol::{Group, RunId};

use super::statement::{Conn, int, query, run};
use crate::catalog::{KindSize, Usage};
use crate::{QueryError, WriteError};

/// Adds amounts to the counters of a run.
pub(super) async fn add(conn: &mut Conn<'_>, of_run: &str, log_bytes: u64, values: u64) -> Result<(), WriteError> {
    let add = "INSERT INTO usage (run, log_bytes, \"values\") VALUES (?, ?, ?) ON CONFLICT (run) DO UPDATE SET \
               log_bytes = usage.log_bytes + excluded.log_bytes, \"values\" = usage.\"values\" + excluded.\"values\"";
    run(conn, query(add).bind(of_run).bind(int(log_bytes)).bind(int(values))).await.map(|_| ())
}

/// Reads the counters of a run.
pub(super) async fn read(conn: &mut Conn<'_>, of_run: &RunId) -> Result<Usage, QueryError> {
    let find = query("SELECT log_bytes, \"values\" FROM usage WHERE run = ?").bind(of_run.as_str());
    let Some(row) = find.fetch_optional(&mut *conn).await? else { return Ok(Usage::default()) };
    let (log_bytes, values): (i64, i64) = (row.try_get(0)?, row.try_get(1)?);
    Ok(Usage { log_bytes: log_bytes.unsigned_abs(), values: values.unsigned_abs() })
}

/// Bytes of all artifacts and log lines of a group's runs.
pub(super) async fn group_bytes(conn: &mut Conn<'_>, group: &Group) -> Result<u64, QueryError> {
    let find = query(
        "SELECT CAST(coalesce((SELECT sum(a.bytes) FROM run_owners o JOIN artifacts a ON a.run = o.run WHERE o.owner = ?1), 0) \
         + coalesce((SELECT sum(u.log_bytes) FROM run_owners o JOIN usage u ON u.run = o.run WHERE o.owner = ?1), 0) AS BIGINT)",
    );
    let row = find.bind(group.as_str()).fetch_one(conn).await?;
    Ok(row.try_get::<i64, _>(0)?.unsigned_abs())
}

/// Sizes of all artifacts by kind.
pub(super) async fn kind_sizes(conn: &mut Conn<'_>) -> Result<Vec<KindSize>, QueryError> {
    let find = query(
        "SELECT kind, count(*), CAST(coalesce(sum(bytes), 0) AS BIGINT) FROM artifacts GROUP BY kind ORDER BY 3 DESC, kind",
    );
    let mut sizes = Vec::new();
    for row in find.fetch_all(conn).await? {
        let (count, bytes): (i64, i64) = (row.try_get(1)?, row.try_get(2)?);
        sizes.push(KindSize { kind: row.try_get(0)?, count: count.unsigned_abs(), bytes: bytes.unsigned_abs() });
    }
    Ok(sizes)
}
