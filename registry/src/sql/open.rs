//! Steps of opening that both databases share: the identity row, and its check against the other parts of a store.

use std::path::Path;

use sqlx::{Connection as _, PgConnection, SqliteConnection};

use super::error::open_error;
use super::statement::{Conn, int, query};
use crate::clock;
use crate::identity::{StoreParts, Verdict};
use crate::open_error::OpenError;
use crate::store_id::{StoreId, Stored};

/// The writing connection.
#[derive(Debug)]
pub(crate) enum Link {
    Sqlite(SqliteConnection),
    Postgres(PgConnection),
}

impl Link {
    pub(super) fn conn(&mut self) -> Conn<'_> {
        match self {
            Self::Sqlite(conn) => Conn::Sqlite(conn),
            Self::Postgres(conn) => Conn::Postgres(conn),
        }
    }

    pub(super) async fn close(self) -> Result<(), sqlx::Error> {
        match self {
            Self::Sqlite(conn) => conn.close().await,
            Self::Postgres(conn) => conn.close().await,
        }
    }
}

/// A database opened for writing.
#[derive(Debug)]
pub(crate) struct Opened {
    pub(crate) link: Link,
    pub(crate) store: StoreId,
    /// Result of the identity check.
    pub(crate) verdict: Verdict,
}

/// Checks that an open database belongs to the parts `found` beside it.
pub(super) async fn belongs(
    name: &Path,
    found: &StoreParts,
    adopt: bool,
    existed: bool,
    conn: &mut Conn<'_>,
) -> Result<Verdict, OpenError> {
    if !existed {
        return Ok(Verdict::New);
    }
    let failed = |e: &sqlx::Error| open_error(name, e);
    let stored = stored(conn).await.map_err(|e| failed(&e))?;
    match (found.classify(stored.as_ref()), stored) {
        (Ok(verdict), _) => Ok(verdict),
        (Err(why), Some(stored)) if adopt && why.may_be_adopted() => {
            let reach = query("UPDATE store SET commits = {greatest}(commits, ?), epoch = {greatest}(epoch, ?)");
            let reach = reach.bind(int(found.witnessed())).bind(int(found.marked_epoch()));
            reach.execute(conn).await.map_err(|e| failed(&e))?;
            Ok(Verdict::Unfinished(stored.id))
        }
        (Err(mismatch), _) => Err(OpenError::Mismatch { dir: found.dir().to_owned(), mismatch }),
    }
}

/// Reads the identity row of a database; `None` if it belongs to no store.
pub(super) async fn stored(conn: &mut Conn<'_>) -> Result<Option<Stored>, sqlx::Error> {
    let has_table = match conn {
        Conn::Sqlite(_) => "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name = 'store'",
        Conn::Postgres(_) => "SELECT count(to_regclass('store'))",
    };
    let has_table: i64 = query(has_table).fetch_one(conn).await?.try_get(0)?;
    if has_table == 0 {
        return Ok(None);
    }
    let row = query("SELECT id, epoch, commits FROM store").fetch_optional(conn).await?;
    row.map(|row| {
        let id: String = row.try_get(0)?;
        let id = id.parse().map_err(|e: String| sqlx::Error::ColumnDecode { index: "id".into(), source: e.into() })?;
        let (epoch, commits): (i64, i64) = (row.try_get(1)?, row.try_get(2)?);
        Ok(Stored { id, epoch: epoch.unsigned_abs(), commits: commits.unsigned_abs() })
    })
    .transpose()
}

/// Names a new database as a new store.
pub(super) async fn name(path: &Path, conn: &mut Conn<'_>) -> Result<StoreId, OpenError> {
    let io = |e: std::io::Error| OpenError::Other { path: path.to_owned(), message: e.to_string() };
    let id = StoreId::random().map_err(io)?;
    let row = query("INSERT INTO store (one, id, epoch, commits, at_ms) VALUES (1, ?, 0, 0, ?)");
    let row = row.bind(id.as_str()).bind(clock::now_ms());
    row.execute(conn).await.map_err(|e| open_error(path, &e))?;
    Ok(id)
}
