//! SQLite: opening the file in a store's folder, for writing after migrating and checking it, or for reading.

use std::cmp::Ordering;
use std::path::Path;
use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Connection, Row, SqliteConnection};

use super::error::open_error;
use super::migrations::{self, OF_SQLITE};
use super::open::{self, Link, Opened};
use super::pool::Pool;
use super::statement::{Conn, int};
use crate::QueryError;
use crate::folder::{self, DATABASE};
use crate::identity::{StoreParts, Verdict};
use crate::open_error::OpenError;
use crate::store_id::{StoreId, Stored};

fn options(dir: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(folder::database(dir))
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .foreign_keys(true)
        .busy_timeout(Duration::from_secs(10))
        .statement_cache_capacity(200)
        .row_buffer_size(ROWS_AHEAD)
}

/// Number of rows that a connection reads ahead of their use. With the default of 50, each row of a longer list wakes a thread.
const ROWS_AHEAD: usize = 1_024;

/// Opens the writing connection and migrates the schema, after checking that the database belongs to the parts `found`
/// beside it. Only for the holder of the store's lock.
pub(crate) async fn open_writer(dir: &Path, found: &StoreParts, adopt: bool) -> Result<Opened, OpenError> {
    let path = folder::database(dir);
    let existed = folder::has_database(dir);
    let mismatch = |mismatch| OpenError::Mismatch { dir: dir.to_owned(), mismatch };
    if !existed {
        found.classify(None).map_err(mismatch)?;
    }
    let mut conn = SqliteConnection::connect_with(&options(dir).create_if_missing(!existed))
        .await
        .map_err(|e| open_error(&path, &e))?;
    let verdict = match open::belongs(&path, found, adopt, existed, &mut Conn::Sqlite(&mut conn)).await {
        Ok(verdict) => verdict,
        Err(refused) => {
            // Removes the empty log that opening has created. The refusal matters more than an error of closing.
            let _ = conn.close().await;
            return Err(refused);
        }
    };
    if existed {
        back_up_before_migrating(dir, &mut conn).await?;
    }
    // Not `run`: its future is not `Send`.
    OF_SQLITE.run_direct(None, &mut conn, false).await.map_err(|e| match e {
        MigrateError::VersionMissing(found) => OpenError::NewerSchema { path: path.clone(), found, known: newest() },
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => open_error(&path, &e),
        e => OpenError::Damaged { path: path.clone(), message: e.to_string() },
    })?;
    let store = match &verdict {
        Verdict::Whole(store) => store.clone(),
        Verdict::Unfinished(store) => {
            // Earlier records of blobs do not apply to the present ones.
            let forget = sqlx::query("DELETE FROM blobs").execute(&mut conn).await;
            forget.map_err(|e| open_error(&path, &e))?;
            store.clone()
        }
        Verdict::New => open::name(&path, &mut Conn::Sqlite(&mut conn)).await?,
    };
    Ok(Opened { link: Link::Sqlite(conn), store, verdict })
}

/// Raises the database's epoch. From then on a process that opened it earlier cannot write to it.
pub(crate) async fn raise_epoch(dir: &Path, conn: &mut SqliteConnection) -> Result<Stored, OpenError> {
    let failed = |e: &sqlx::Error| open_error(&folder::database(dir), e);
    let raise = "UPDATE store SET epoch = epoch + 1, commits = commits + 1";
    sqlx::query(raise).execute(&mut *conn).await.map_err(|e| failed(&e))?;
    let stored = open::stored(&mut Conn::Sqlite(conn)).await.map_err(|e| failed(&e))?;
    stored
        .ok_or_else(|| OpenError::Damaged { path: folder::database(dir), message: "the store's row is missing".into() })
}

/// Raises the epoch of a closed database to at least `epoch`.
pub(crate) async fn reach_epoch(dir: &Path, epoch: u64) -> Result<(), sqlx::Error> {
    let options = SqliteConnectOptions::new().filename(folder::database(dir)).synchronous(SqliteSynchronous::Full);
    let mut conn = SqliteConnection::connect_with(&options).await?;
    let reach = sqlx::query("UPDATE store SET epoch = max(epoch, ?)").bind(int(epoch));
    reach.execute(&mut conn).await?;
    // Only needed blobs came with the copy.
    sqlx::query("DELETE FROM blobs").execute(&mut conn).await?;
    conn.close().await
}

/// Makes a pool of read-only connections that connect on first use. `closed` says that the database has no writer and
/// no log while they are open.
pub(crate) fn open_readers(dir: &Path, closed: bool) -> Pool {
    Pool::Sqlite(SqlitePoolOptions::new().max_connections(4).connect_lazy_with(reading(dir, closed)))
}

/// Opens a copy of a database that has no writer.
pub(crate) async fn open_copy(path: &Path) -> Result<SqliteConnection, sqlx::Error> {
    SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(path).read_only(true).immutable(true)).await
}

fn reading(dir: &Path, closed: bool) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(folder::database(dir))
        .read_only(true)
        .immutable(closed)
        .busy_timeout(Duration::from_secs(10))
        .statement_cache_capacity(200)
        .row_buffer_size(ROWS_AHEAD)
}

/// Checks that a database opened for reading belongs to the parts `found` beside it and has this build's schema.
/// Returns the store's identity.
pub(crate) async fn check_to_read(dir: &Path, found: &StoreParts, closed: bool) -> Result<StoreId, OpenError> {
    let path = folder::database(dir);
    let mismatch = |mismatch| OpenError::Mismatch { dir: dir.to_owned(), mismatch };
    let failed = |e: &sqlx::Error| open_error(&path, e);
    if !folder::has_database(dir) {
        found.classify(None).map_err(mismatch)?;
        return Err(OpenError::NotAStore(dir.to_owned()));
    }
    let mut conn = SqliteConnection::connect_with(&reading(dir, closed)).await.map_err(|e| failed(&e))?;
    let Some(stored) = open::stored(&mut Conn::Sqlite(&mut conn)).await.map_err(|e| failed(&e))? else {
        found.classify(None).map_err(mismatch)?;
        return Err(OpenError::NotAStore(dir.to_owned()));
    };
    found.classify(Some(&stored)).map_err(mismatch)?;
    let applied = sqlx::query("SELECT coalesce(max(version), 0) FROM _sqlx_migrations");
    let applied: i64 = applied.fetch_one(&mut conn).await.map_err(|e| failed(&e))?.get(0);
    conn.close().await.map_err(|e| failed(&e))?;
    match applied.cmp(&newest()) {
        Ordering::Equal => Ok(stored.id),
        Ordering::Greater => Err(OpenError::NewerSchema { path, found: applied, known: newest() }),
        Ordering::Less => Err(OpenError::OlderSchema { path, found: applied, known: newest() }),
    }
}

/// Describes the inconsistencies that SQLite finds in the file. Reads all of it.
pub(super) async fn problems(conn: &mut SqliteConnection) -> Result<Vec<String>, QueryError> {
    let mut problems = Vec::new();
    for row in sqlx::query("PRAGMA integrity_check").fetch_all(&mut *conn).await? {
        let line: String = row.try_get(0)?;
        if line != "ok" {
            problems.push(format!("database: {line}"));
        }
    }
    for row in sqlx::query("PRAGMA foreign_key_check").fetch_all(&mut *conn).await? {
        problems.push(format!("database: a row of `{}` has a dangling reference", row.try_get::<String, _>(0)?));
    }
    Ok(problems)
}

/// Copies the database to a new file as of one moment.
pub(super) async fn copy(conn: &mut SqliteConnection, path: &Path) -> Result<(), QueryError> {
    sqlx::query("VACUUM INTO ?").bind(path.to_string_lossy().into_owned()).execute(conn).await?;
    Ok(())
}

/// Checks a copy as a whole and closes it.
pub(super) async fn check_copy(mut copy: SqliteConnection) -> Result<(), QueryError> {
    let checked: String = sqlx::query("PRAGMA integrity_check").fetch_one(&mut copy).await?.try_get(0)?;
    copy.close().await?;
    match checked.as_str() {
        "ok" => Ok(()),
        problem => Err(QueryError::Blob(format!("the database is damaged: {problem}"))),
    }
}

/// Makes an empty database of the newest schema in a new file, for a copy.
pub(super) async fn make_copy(path: &Path) -> Result<SqliteConnection, QueryError> {
    if path.exists() {
        return Err(QueryError::Storage(format!("`{}` exists already", path.display())));
    }
    let options = SqliteConnectOptions::new().filename(path).create_if_missing(true).foreign_keys(false);
    let options = options.journal_mode(SqliteJournalMode::Delete).synchronous(SqliteSynchronous::Full);
    let mut conn = SqliteConnection::connect_with(&options).await?;
    let migrated = OF_SQLITE.run_direct(None, &mut conn, false).await;
    migrated.map_err(|e| QueryError::Database(e.to_string()))?;
    Ok(conn)
}

fn newest() -> i64 {
    migrations::newest(&OF_SQLITE)
}

/// Copies the database to a file beside it before a migration.
async fn back_up_before_migrating(dir: &Path, conn: &mut SqliteConnection) -> Result<(), OpenError> {
    let path = folder::database(dir);
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
    let copy = dir.join(format!("{DATABASE}.before-{:04}", newest()));
    if copy.exists() {
        // An interrupted migration has made the copy; the older copy is the right one.
        return Ok(());
    }
    let backup = sqlx::query("VACUUM INTO ?").bind(copy.to_string_lossy().into_owned());
    backup.execute(&mut *conn).await.map_err(|e| open_error(&copy, &e))?;
    tracing::info!(copy = %copy.display(), "copied the database before changing its schema");
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use sqlx::migrate::Migrator;

    use super::*;

    fn sqlite_of(link: Link) -> SqliteConnection {
        match link {
            Link::Sqlite(conn) => conn,
            Link::Postgres(_) => panic!("a file"),
        }
    }

    async fn opened(dir: &Path) -> SqliteConnection {
        let found = StoreParts::read(dir, &crate::blob::fs::Folder::to_read(dir)).unwrap();
        sqlite_of(open_writer(dir, &found, false).await.unwrap().link)
    }

    /// A commit that SQLite does not sync is lost in a power loss although it was acknowledged.
    #[tokio::test]
    async fn p2_the_writer_syncs_every_commit_and_appends_to_a_log() {
        let dir = tempfile::tempdir().unwrap();
        let mut conn = opened(dir.path()).await;
        let synchronous: i64 = sqlx::query("PRAGMA synchronous").fetch_one(&mut conn).await.unwrap().get(0);
        let journal: String = sqlx::query("PRAGMA journal_mode").fetch_one(&mut conn).await.unwrap().get(0);
        assert_eq!((synchronous, journal.as_str()), (2, "wal"), "2 is FULL");
    }

    async fn schema(conn: &mut SqliteConnection) -> Vec<(String, Option<String>)> {
        let all = "SELECT name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_%' ORDER BY name";
        let rows = sqlx::query(all).fetch_all(conn).await.unwrap();
        rows.iter().map(|row| (row.get(0), row.get(1))).collect()
    }

    #[tokio::test]
    async fn every_old_schema_becomes_the_newest_with_a_copy_kept_before() {
        let fresh = tempfile::tempdir().unwrap();
        let newest_schema = schema(&mut opened(fresh.path()).await).await;
        let all: Vec<_> = OF_SQLITE.iter().cloned().collect();
        for count in 1..all.len() {
            let dir = tempfile::tempdir().unwrap();
            let mut conn = SqliteConnection::connect_with(&options(dir.path()).create_if_missing(true)).await.unwrap();
            Migrator::with_migrations(all[..count].to_vec()).run(&mut conn).await.unwrap();
            conn.close().await.unwrap();
            let mut conn = opened(dir.path()).await;
            assert_eq!(schema(&mut conn).await, newest_schema, "from {count} migrations");
            assert!(dir.path().join(format!("{DATABASE}.before-{:04}", newest())).exists());
        }
    }

    #[tokio::test]
    async fn each_migration_may_run_again() {
        let dir = tempfile::tempdir().unwrap();
        let mut conn = opened(dir.path()).await;
        let before = schema(&mut conn).await;
        for migration in OF_SQLITE.iter() {
            sqlx::raw_sql(migration.sql.clone()).execute(&mut conn).await.unwrap();
        }
        assert_eq!(schema(&mut conn).await, before);
    }
}
