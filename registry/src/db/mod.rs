//! The database: its connections, its migrations, and the one writer.
//!
//! One connection writes, from a thread of its own ([`writer`]); queries use read-only connections and see what was
//! committed. `database is locked` cannot happen: nobody else writes, and readers of a WAL database wait for nobody.

pub(crate) mod apply;
pub(crate) mod writer;

use std::path::Path;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Connection, Row, SqliteConnection, SqlitePool};

use crate::WriteError;
use crate::store::OpenError;

pub(crate) static MIGRATOR: Migrator = sqlx::migrate!("../migrations");

const FILE: &str = "stride.db";

/// Whether a folder holds a database.
pub(crate) fn is_there(dir: &Path) -> bool {
    dir.join(FILE).exists()
}

fn options(dir: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(dir.join(FILE))
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .foreign_keys(true)
        .busy_timeout(Duration::from_secs(10))
        .statement_cache_capacity(200)
}

/// Opens the writing connection and brings the schema up to date. Only for the holder of the store's lock.
pub(crate) async fn open_writer(dir: &Path) -> Result<SqliteConnection, OpenError> {
    let path = dir.join(FILE);
    let existed = path.exists();
    let mut conn = SqliteConnection::connect_with(&options(dir).create_if_missing(true))
        .await
        .map_err(|e| open_error(&path, &e))?;
    if existed {
        back_up_before_migrating(dir, &mut conn).await?;
    }
    MIGRATOR.run(&mut conn).await.map_err(|e| match e {
        MigrateError::VersionMissing(found) => OpenError::NewerSchema { path: path.clone(), found, known: newest() },
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => open_error(&path, &e),
        e => OpenError::Damaged { path: path.clone(), message: e.to_string() },
    })?;
    Ok(conn)
}

/// Read-only connections for queries. They connect when first used.
pub(crate) fn open_readers(dir: &Path) -> SqlitePool {
    SqlitePoolOptions::new().max_connections(4).connect_lazy_with(options(dir).read_only(true))
}

fn newest() -> i64 {
    MIGRATOR.iter().map(|m| m.version).max().unwrap_or(0)
}

/// Keeps a copy beside the database when this build is about to change its schema.
async fn back_up_before_migrating(dir: &Path, conn: &mut SqliteConnection) -> Result<(), OpenError> {
    let path = dir.join(FILE);
    let has_table = sqlx::query("SELECT count(*) FROM sqlite_master WHERE name = '_sqlx_migrations'");
    let has_table: i64 = has_table.fetch_one(&mut *conn).await.map_err(|e| open_error(&path, &e))?.get(0);
    if has_table == 0 {
        return Ok(());
    }
    let applied = sqlx::query("SELECT coalesce(max(version), 0) FROM _sqlx_migrations");
    let applied: i64 = applied.fetch_one(&mut *conn).await.map_err(|e| open_error(&path, &e))?.get(0);
    if applied == 0 || applied >= newest() {
        return Ok(());
    }
    let copy = dir.join(format!("{FILE}.before-{:04}", newest()));
    if copy.exists() {
        // A migration that was cut short has been here; its copy is the older and so the better one.
        return Ok(());
    }
    let backup = sqlx::query("VACUUM INTO ?").bind(copy.to_string_lossy().into_owned());
    backup.execute(&mut *conn).await.map_err(|e| open_error(&copy, &e))?;
    tracing::info!(copy = %copy.display(), "copied the database before changing its schema");
    Ok(())
}

/// SQLite's primary result code of an error, if SQLite had one.
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

fn open_error(path: &Path, e: &sqlx::Error) -> OpenError {
    let (path, message) = (path.to_owned(), e.to_string());
    match code(e) {
        Some(SQLITE_READONLY | SQLITE_CANTOPEN) => OpenError::ReadOnly { path, message },
        Some(SQLITE_FULL) => OpenError::Full { path, message },
        Some(SQLITE_CORRUPT | SQLITE_NOTADB) => OpenError::Damaged { path, message },
        _ => OpenError::Other { path, message },
    }
}

/// What a database error means for a write: the disk, or us.
pub(crate) fn write_error(e: sqlx::Error) -> WriteError {
    match code(&e) {
        Some(SQLITE_FULL) => WriteError::Storage(
            "the disk is full: the database could not grow; free some space (`registry gc` removes what nothing needs) and \
             run the same command again"
                .into(),
        ),
        Some(SQLITE_READONLY | SQLITE_CANTOPEN) => {
            WriteError::Storage(format!("the database is not writable ({e}); make the store writable and run the same command again"))
        }
        Some(SQLITE_IOERR) => WriteError::Storage(format!("the disk refused a write of the database ({e}); check it and run the same command again")),
        _ => WriteError::Internal(format!("database: {e}")),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    async fn schema(conn: &mut SqliteConnection) -> Vec<(String, Option<String>)> {
        let all = "SELECT name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_%' ORDER BY name";
        let rows = sqlx::query(all).fetch_all(conn).await.unwrap();
        rows.iter().map(|row| (row.get(0), row.get(1))).collect()
    }

    #[tokio::test]
    async fn every_old_schema_becomes_the_newest_with_a_copy_kept_before() {
        let fresh = tempfile::tempdir().unwrap();
        let newest_schema = schema(&mut open_writer(fresh.path()).await.unwrap()).await;
        let all: Vec<_> = MIGRATOR.iter().cloned().collect();
        for count in 1..all.len() {
            let dir = tempfile::tempdir().unwrap();
            let mut conn = SqliteConnection::connect_with(&options(dir.path()).create_if_missing(true)).await.unwrap();
            Migrator::with_migrations(all[..count].to_vec()).run(&mut conn).await.unwrap();
            conn.close().await.unwrap();
            let mut conn = open_writer(dir.path()).await.unwrap();
            assert_eq!(schema(&mut conn).await, newest_schema, "from {count} migrations");
            assert!(dir.path().join(format!("{FILE}.before-{:04}", newest())).exists());
        }
    }

    #[tokio::test]
    async fn each_migration_may_run_again() {
        let dir = tempfile::tempdir().unwrap();
        let mut conn = open_writer(dir.path()).await.unwrap();
        let before = schema(&mut conn).await;
        for migration in MIGRATOR.iter() {
            sqlx::raw_sql(migration.sql.clone()).execute(&mut conn).await.unwrap();
        }
        assert_eq!(schema(&mut conn).await, before);
    }
}
