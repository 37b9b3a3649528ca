//! Copies of a whole catalog between databases of either kind, table by table.
//!
//! Every table has the same columns in both. A copy is verified: each table has the same number of rows in both databases, and
//! the same digest of them. The digest does not depend on the order of rows.

use std::path::Path;

use futures::TryStreamExt as _;
use protocol::digest::Hasher;
use sqlx::Connection as _;

use super::pool::Pool;
use super::sqlite;
use super::statement::{Builder, Conn, ROWS, Row, Value, query};
use crate::QueryError;

type Result<T> = std::result::Result<T, QueryError>;

/// All tables. A table follows the tables that it refers to, and those whose triggers fill it.
pub(super) const TABLES: [&str; 37] = [
    "store",
    "facts",
    "snapshots",
    "snapshot_parts",
    "runs",
    "run_owners",
    "run_list",
    "submissions",
    "forgotten",
    "executions",
    "fences",
    "series",
    "metrics",
    "recorders",
    "recorded",
    "rollups",
    "log_streams",
    "log_batches",
    "log_numbers",
    "usage",
    "checkpoints",
    "shards",
    "stage_results",
    "artifacts",
    "edges",
    "pins",
    "blobs",
    "manifests",
    "held_blobs",
    "models",
    "model_owners",
    "versions",
    "aliases",
    "promotions",
    "history",
    "stage_times",
    "webhooks",
];

/// Number and digest of the rows of a table.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Sum {
    pub(crate) rows: u64,
    digest: u128,
}

impl Sum {
    fn add(&mut self, values: &[Value<'static>]) {
        let mut hasher = Hasher::default();
        for value in values {
            let (kind, bytes) = match value {
                Value::Integer(Some(value)) => (b'i', value.to_le_bytes().to_vec()),
                Value::Float(Some(value)) => (b'f', value.to_bits().to_le_bytes().to_vec()),
                Value::Text(Some(value)) => (b't', value.as_bytes().to_vec()),
                Value::Integer(None) | Value::Float(None) | Value::Text(None) => (b'n', Vec::new()),
            };
            hasher.update(&[kind]);
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(&bytes);
        }
        let mut first = [0; 16];
        first.copy_from_slice(&hasher.finish().as_bytes()[..16]);
        self.rows += 1;
        // A sum does not depend on the order of the rows.
        self.digest = self.digest.wrapping_add(u128::from_le_bytes(first));
    }
}

/// A column with its kind.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TableColumn {
    name: String,
    kind: Kind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Integer,
    Float,
    Text,
}

impl TableColumn {
    fn value(&self, row: &Row, place: usize) -> std::result::Result<Value<'static>, sqlx::Error> {
        Ok(match self.kind {
            Kind::Integer => Value::Integer(row.try_get(place)?),
            Kind::Float => Value::Float(row.try_get(place)?),
            Kind::Text => row.try_get::<Option<String>, _>(place)?.into(),
        })
    }
}

/// Returns the columns of a table, in the order of their names.
pub(super) async fn columns(conn: &mut Conn<'_>, table: &'static str) -> Result<Vec<TableColumn>> {
    let find = match conn {
        Conn::Sqlite(_) => "SELECT name, type FROM pragma_table_info(?)",
        Conn::Postgres(_) => {
            "SELECT CAST(column_name AS TEXT), CAST(data_type AS TEXT) FROM information_schema.columns \
             WHERE table_schema = current_schema() AND table_name = ?"
        }
    };
    let mut columns = Vec::new();
    for row in query(find).bind(table).fetch_all(conn).await? {
        let (name, kind): (String, String) = (row.try_get(0)?, row.try_get(1)?);
        let kind = match kind.as_str() {
            "INTEGER" | "bigint" => Kind::Integer,
            "REAL" | "double precision" => Kind::Float,
            "TEXT" | "text" => Kind::Text,
            other => return Err(QueryError::Database(format!("column `{name}` of `{table}` has the type {other}"))),
        };
        columns.push(TableColumn { name, kind });
    }
    columns.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(columns)
}

fn select(table: &'static str, columns: &[TableColumn]) -> Builder<'static> {
    let mut select = Builder::new("SELECT ");
    for (place, column) in columns.iter().enumerate() {
        select.push(if place == 0 { "" } else { ", " }).push_name(&column.name);
    }
    select.push(" FROM ").push_name(table);
    select
}

/// Returns the number of rows of a table after reading it.
pub(super) async fn count(conn: &mut Conn<'_>, table: &'static str) -> Result<u64> {
    Ok(sum(conn, table).await?.rows)
}

/// Sums up the rows of a table.
async fn sum(conn: &mut Conn<'_>, table: &'static str) -> Result<Sum> {
    let columns = columns(conn, table).await?;
    let mut sum = Sum::default();
    let mut rows = select(table, &columns).build().fetch(conn);
    while let Some(row) = rows.try_next().await? {
        sum.add(&values(&columns, &row)?);
    }
    Ok(sum)
}

fn values(columns: &[TableColumn], row: &Row) -> Result<Vec<Value<'static>>> {
    let values = columns.iter().enumerate().map(|(place, column)| column.value(row, place));
    Ok(values.collect::<std::result::Result<_, _>>()?)
}

/// Copies a table and returns the sum of what was read.
async fn copy(from: &mut Conn<'_>, to: &mut Conn<'_>, table: &'static str) -> Result<Sum> {
    let columns = columns(from, table).await?;
    // Rows that the migrations or the triggers of another table have made.
    let mut clear = Builder::new("DELETE FROM ");
    clear.push_name(table);
    clear.build().execute(to).await?;
    let mut sum = Sum::default();
    let mut rows = select(table, &columns).build().fetch(from);
    let mut batch = Vec::with_capacity(ROWS);
    while let Some(row) = rows.try_next().await? {
        let values = values(&columns, &row)?;
        sum.add(&values);
        batch.push(values);
        if batch.len() == ROWS {
            insert(to, table, &columns, &batch).await?;
            batch.clear();
        }
    }
    insert(to, table, &columns, &batch).await?;
    Ok(sum)
}

async fn insert(
    to: &mut Conn<'_>,
    table: &'static str,
    columns: &[TableColumn],
    rows: &[Vec<Value<'static>>],
) -> Result<()> {
    if rows.is_empty() {
        return Ok(());
    }
    let mut insert = Builder::new("INSERT INTO ");
    insert.push_name(table).push(" (");
    for (place, column) in columns.iter().enumerate() {
        insert.push(if place == 0 { "" } else { ", " }).push_name(&column.name);
    }
    insert.push(") ").push_rows(rows, |row, values| {
        for value in values {
            row.push_bind(value.clone());
        }
    });
    insert.build().execute(to).await?;
    Ok(())
}

/// Copies a whole catalog into an empty one of the newest schema, and verifies it. Returns the number of rows. The caller's
/// transaction of `from` sees one moment; that of `to` is committed by the caller.
pub(crate) async fn copy_all(from: &mut Conn<'_>, to: &mut Conn<'_>) -> Result<u64> {
    let mut all = 0;
    let mut sums = Vec::with_capacity(TABLES.len());
    for table in TABLES {
        sums.push((table, copy(from, to, table).await?));
    }
    continue_numbers(from, to).await?;
    for (table, read) in sums {
        let written = sum(to, table).await?;
        if written != read {
            return Err(QueryError::Database(format!(
                "the copy of `{table}` differs: {} rows were read, {} were written, and their digests are {:032x} and {:032x}",
                read.rows, written.rows, read.digest, written.digest
            )));
        }
        all += read.rows;
    }
    Ok(all)
}

/// Continues the numbers of rows where the other database was.
async fn continue_numbers(from: &mut Conn<'_>, to: &mut Conn<'_>) -> Result<()> {
    let newest: i64 = query("SELECT coalesce({added_history}, 0)").fetch_one(from).await?.try_get(0)?;
    if to.is_sqlite() {
        query("DELETE FROM sqlite_sequence WHERE name = 'history'").execute(to).await?;
        let add = query("INSERT INTO sqlite_sequence (name, seq) VALUES ('history', ?)");
        add.bind(newest).execute(to).await?;
        return Ok(());
    }
    query("UPDATE history_numbers SET newest = ?").bind(newest).execute(to).await?;
    let find = "SELECT CAST(table_name AS TEXT), CAST(column_name AS TEXT) FROM information_schema.columns \
                WHERE table_schema = current_schema() AND is_identity = 'YES'";
    for row in query(find).fetch_all(to).await? {
        let (table, column): (String, String) = (row.try_get(0)?, row.try_get(1)?);
        let least = if table == "history" { newest } else { 0 };
        let mut set = Builder::new("SELECT setval(pg_get_serial_sequence(");
        set.push_bind(table.clone()).push(", ").push_bind(column.clone()).push("), greatest(");
        set.push_bind(least).push(", (SELECT coalesce(max(").push_name(&column).push("), 0) FROM ").push_name(&table);
        set.push(")) + 1, false)");
        set.build().fetch_one(to).await?;
    }
    Ok(())
}

/// Copies a catalog, as of one moment, to a new file of SQLite. Returns the number of rows.
pub(crate) async fn to_file(from: &Pool, path: &Path) -> Result<u64> {
    let mut file = sqlite::make_copy(path).await?;
    let mut moment = from.moment().await?;
    let to = &mut Conn::Sqlite(&mut file);
    query("BEGIN").execute(to).await?;
    let rows = copy_all(&mut moment.conn(), to).await?;
    query("COMMIT").execute(to).await?;
    moment.end().await?;
    file.close().await?;
    Ok(rows)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use std::collections::BTreeSet;

    use cluster_tests::postgres::Postgres;

    use super::*;
    use crate::sql::{migrations, postgres};

    /// A table that one database lacks, or that is not listed here, would be lost in a copy.
    #[tokio::test]
    async fn both_databases_have_the_same_tables_and_columns() {
        let Some(server) = Postgres::shared() else { return };
        let address = server.address(&server.create()).parse().unwrap();
        let mut server = postgres::connect(&address).await.unwrap();
        migrations::OF_POSTGRES.run_direct(None, &mut server, false).await.unwrap();
        let dir = tempfile::tempdir().unwrap();
        let mut file = sqlite::make_copy(&dir.path().join("file")).await.unwrap();
        let server = &mut Conn::Postgres(&mut server);
        let file = &mut Conn::Sqlite(&mut file);
        for table in TABLES {
            let columns_ = columns(server, table).await.unwrap();
            assert!(!columns_.is_empty(), "{table}");
            assert_eq!(columns_, columns(file, table).await.unwrap(), "{table}");
        }
        let in_file = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%' AND name NOT LIKE 'run_words%'";
        let in_server = "SELECT CAST(table_name AS TEXT) FROM information_schema.tables WHERE table_schema = current_schema() \
                         AND table_type = 'BASE TABLE' AND table_name NOT IN ('leader', 'server_keys', 'history_numbers')";
        for (conn, find) in [(file, in_file), (server, in_server)] {
            let rows = query(find).fetch_all(conn).await.unwrap();
            let names: BTreeSet<String> = rows.iter().map(|row| row.get(0)).collect();
            let expected = TABLES.into_iter().chain(["_sqlx_migrations"]).map(str::to_owned).collect();
            assert_eq!(names, expected);
        }
    }
}
