//! PostgreSQL: connections, opening for writing under a leadership, and opening for reading.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::postgres::PgPoolOptions;
use sqlx::{Connection as _, PgConnection};

use super::error::open_error;
use super::leader::{self, LeaderTerms};
use super::migrations::{self, OF_POSTGRES};
use super::open::{self, Link, Opened};
use super::pool::Pool;
use super::statement::{Conn, int, query};
use super::transfer;
use crate::QueryError;
use crate::catalog::PostgresAddress;
use crate::identity::{StoreParts, Verdict};
use crate::lock::Holder;
use crate::move_error::MoveError;
use crate::open_error::OpenError;
use crate::server_key::{self, ServerKey};
use crate::store_id::{StoreId, Stored};

/// The oldest version of the server that the schema and the statements work with.
const OLDEST: i64 = 15;
/// Time limit of a connection.
const CONNECT: Duration = Duration::from_secs(5);
/// Connections of a process for queries.
const READERS: u32 = 8;

/// A catalog's name in messages, where a file has its path.
pub(crate) fn name(address: &PostgresAddress) -> PathBuf {
    PathBuf::from(address.to_string())
}

pub(crate) async fn connect(address: &PostgresAddress) -> Result<PgConnection, sqlx::Error> {
    let configuration = |message: String| sqlx::Error::Configuration(message.into());
    let options = address.options().map_err(configuration)?;
    let late = || sqlx::Error::Io(std::io::Error::new(std::io::ErrorKind::TimedOut, "the server does not answer"));
    tokio::time::timeout(CONNECT, PgConnection::connect_with(&options)).await.map_err(|_| late())?
}

/// Connects to write. A commit is durable on the server's disk, and a stalled transaction ends with its session.
async fn connect_to_write(address: &PostgresAddress, terms: &LeaderTerms) -> Result<PgConnection, sqlx::Error> {
    let mut conn = connect(address).await?;
    let stalled = terms.stalled.map_or(0, |time| int(u64::try_from(time.as_millis()).unwrap_or(0)));
    let set = "SELECT set_config('idle_in_transaction_session_timeout', CAST(? AS TEXT), false), \
               set_config('client_connection_check_interval', '1000', false), \
               set_config('synchronous_commit', CASE WHEN current_setting('synchronous_commit') IN ('off', 'local') \
               THEN 'on' ELSE current_setting('synchronous_commit') END, false)";
    query(set).bind(stalled).fetch_one(&mut Conn::Postgres(&mut conn)).await?;
    Ok(conn)
}

/// Connects anew for a leader. Returns the connection and the number of committed transactions; `None` if another process
/// leads.
pub(super) async fn continue_writing(
    address: &PostgresAddress,
    epoch: u64,
    terms: &LeaderTerms,
) -> Result<Option<(PgConnection, u64)>, sqlx::Error> {
    let mut conn = connect_to_write(address, terms).await?;
    if !leader::continue_over(&mut Conn::Postgres(&mut conn), epoch, terms).await? {
        return Ok(None);
    }
    let stored = open::stored(&mut Conn::Postgres(&mut conn)).await?;
    Ok(stored.filter(|stored| stored.epoch == epoch).map(|stored| (conn, stored.commits)))
}

/// Opens connections for queries on first use. The server refuses their writes.
pub(crate) fn open_readers(address: &PostgresAddress) -> Result<Pool, OpenError> {
    let failed = |message: String| OpenError::Other { path: name(address), message };
    let options = address.options().map_err(failed)?.options([("default_transaction_read_only", "on")]);
    let pool = PgPoolOptions::new().max_connections(READERS).acquire_timeout(2 * CONNECT);
    Ok(Pool::Postgres(pool.connect_lazy_with(options)))
}

/// A request to open a catalog for writing.
#[derive(Debug)]
pub(crate) struct Opening<'a> {
    pub(crate) address: &'a PostgresAddress,
    /// The store's folder, for messages.
    pub(crate) dir: &'a Path,
    pub(crate) found: &'a StoreParts,
    pub(crate) adopt: bool,
    pub(crate) terms: LeaderTerms,
    pub(crate) holder: &'a Holder,
}

/// A catalog that this process leads.
#[derive(Debug)]
pub(crate) struct Led {
    pub(crate) opened: Opened,
    /// The epoch of the leader's row.
    pub(crate) epoch: u64,
    pub(crate) server_key: ServerKey,
}

/// Takes the leadership and migrates the schema, after checking that the database belongs to the parts `found` beside it.
pub(crate) async fn open_writer(opening: &Opening<'_>) -> Result<Led, OpenError> {
    let path = name(opening.address);
    let failed = |e: &sqlx::Error| open_error(&path, e);
    let mut conn = connect_to_write(opening.address, &opening.terms).await.map_err(|e| failed(&e))?;
    check_server(&path, &mut conn).await?;
    let applied = applied(&mut conn).await.map_err(|e| failed(&e))?;
    if applied == 0 {
        opening.found.classify(None).map_err(|mismatch| mismatched(opening.dir, mismatch))?;
        migrate(&path, &mut conn).await?;
    } else if applied > newest() {
        return Err(OpenError::NewerSchema { path, found: applied, known: newest() });
    }
    let described = described(opening.holder);
    let epoch = match leader::take_or_find(&mut conn, &described, &opening.terms).await.map_err(|e| failed(&e))? {
        Ok(epoch) => epoch,
        Err(leader) => {
            let holder = Holder { pid: 0, what: leader.name, address: leader.address };
            return Err(OpenError::Busy { dir: opening.dir.to_owned(), holder });
        }
    };
    let led = take_over(opening, &path, &mut conn).await;
    match led {
        Ok((store, verdict, server_key)) => {
            let opened = Opened { link: Link::Postgres(conn), store, verdict };
            Ok(Led { opened, epoch, server_key })
        }
        Err(refused) => {
            // The refusal matters more than an error of releasing: the leadership runs out by itself.
            let _ = leader::release(&mut Conn::Postgres(&mut conn), epoch).await;
            Err(refused)
        }
    }
}

/// Names a process for the leader's row.
fn described(holder: &Holder) -> String {
    let host = nix::unistd::gethostname().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    format!("{holder} on `{host}`")
}

fn mismatched(dir: &Path, mismatch: crate::identity::Mismatch) -> OpenError {
    OpenError::Mismatch { dir: dir.to_owned(), mismatch }
}

/// Prepares the store for the new leader, before its writer starts.
async fn take_over(
    opening: &Opening<'_>,
    path: &Path,
    conn: &mut PgConnection,
) -> Result<(StoreId, Verdict, ServerKey), OpenError> {
    let failed = |e: &sqlx::Error| open_error(path, e);
    let is_named = open::stored(&mut Conn::Postgres(conn)).await.map_err(|e| failed(&e))?.is_some();
    if !is_named {
        opening.found.classify(None).map_err(|mismatch| mismatched(opening.dir, mismatch))?;
    }
    let verdict = open::belongs(path, opening.found, opening.adopt, is_named, &mut Conn::Postgres(conn)).await?;
    migrate(path, conn).await?;
    let store = match &verdict {
        Verdict::Whole(store) => store.clone(),
        Verdict::Unfinished(store) => {
            // Earlier records of blobs do not apply to the present ones.
            query("DELETE FROM blobs").execute(&mut Conn::Postgres(conn)).await.map_err(|e| failed(&e))?;
            store.clone()
        }
        Verdict::New => open::name(path, &mut Conn::Postgres(conn)).await?,
    };
    let server_key = server_key_of(conn).await.map_err(|e| failed(&e))?;
    Ok((store, verdict, server_key))
}

/// Reads the key of the store's server, or creates one. A stand-by continues with the key of the leader before it.
async fn server_key_of(conn: &mut PgConnection) -> Result<ServerKey, sqlx::Error> {
    let conn = &mut Conn::Postgres(conn);
    let fresh = server_key::random().map_err(sqlx::Error::Io)?;
    let insert = query("INSERT INTO server_keys (one, key) VALUES (1, ?) ON CONFLICT DO NOTHING");
    insert.bind(hex::encode(fresh)).execute(conn).await?;
    let row = query("SELECT key FROM server_keys").fetch_one(conn).await?;
    let key = hex::decode(row.try_get::<String, _>(0)?).unwrap_or_default();
    key.try_into()
        .map_err(|_| sqlx::Error::ColumnDecode { index: "key".into(), source: "not a key of 32 bytes".into() })
}

async fn check_server(path: &Path, conn: &mut PgConnection) -> Result<(), OpenError> {
    let ask = "SELECT CAST(current_setting('server_version_num') AS BIGINT) / 10000 AS version, \
               current_setting('server_encoding') AS encoding";
    let row = query(ask).fetch_one(&mut Conn::Postgres(conn)).await.map_err(|e| open_error(path, &e))?;
    let (version, encoding): (i64, String) = (row.get("version"), row.get("encoding"));
    let message = if version < OLDEST {
        format!("the server is PostgreSQL {version}; the oldest supported version is {OLDEST}")
    } else if encoding != "UTF8" {
        format!("the database's encoding is {encoding}; create one with `ENCODING 'UTF8'`")
    } else {
        return Ok(());
    };
    Err(OpenError::Other { path: path.to_owned(), message })
}

/// Number of the newest migration of a database; 0 without one.
async fn applied(conn: &mut PgConnection) -> Result<i64, sqlx::Error> {
    let conn = &mut Conn::Postgres(conn);
    let has_table: i64 = query("SELECT count(to_regclass('_sqlx_migrations'))").fetch_one(conn).await?.try_get(0)?;
    if has_table == 0 {
        return Ok(0);
    }
    query("SELECT coalesce(max(version), 0) FROM _sqlx_migrations").fetch_one(conn).await?.try_get(0)
}

fn newest() -> i64 {
    migrations::newest(&OF_POSTGRES)
}

async fn migrate(path: &Path, conn: &mut PgConnection) -> Result<(), OpenError> {
    OF_POSTGRES.run_direct(None, conn, false).await.map_err(|e| match e {
        MigrateError::VersionMissing(found) => OpenError::NewerSchema { path: path.to_owned(), found, known: newest() },
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => open_error(path, &e),
        e => OpenError::Damaged { path: path.to_owned(), message: e.to_string() },
    })
}

/// Raises the epoch of the catalog and of its leader, which the marker beside the blobs then records.
pub(crate) async fn raise_epoch(address: &PostgresAddress, link: &mut Link, epoch: u64) -> Result<Stored, OpenError> {
    let path = name(address);
    let failed = |e: &sqlx::Error| open_error(&path, e);
    let conn = &mut link.conn();
    let raise = "WITH leads AS (UPDATE leader SET epoch = greatest(epoch, (SELECT epoch FROM store)) + 1 WHERE epoch = ? \
                 RETURNING epoch) UPDATE store SET epoch = (SELECT epoch FROM leads), commits = commits + 1 \
                 WHERE EXISTS (SELECT 1 FROM leads)";
    let raised = query(raise).bind(int(epoch)).execute(conn).await.map_err(|e| failed(&e))?;
    let stored = open::stored(conn).await.map_err(|e| failed(&e))?;
    match stored {
        Some(stored) if raised == 1 => Ok(stored),
        Some(_) => Err(OpenError::Other { path, message: "another process has taken the leadership".into() }),
        None => Err(OpenError::Damaged { path, message: "the store's row is missing".into() }),
    }
}

/// Interval at which a stand-by reads the leader's row.
const LOOK: Duration = Duration::from_millis(100);

/// Returns once no process leads the catalog, or none has created it yet.
pub(crate) async fn wait_to_lead(address: &PostgresAddress) {
    loop {
        match watch_leader(address).await {
            Ok(()) => return,
            Err(error) => {
                tracing::warn!(%error, "cannot read which process leads `{address}`; trying again");
                tokio::time::sleep(10 * LOOK).await;
            }
        }
    }
}

async fn watch_leader(address: &PostgresAddress) -> Result<(), sqlx::Error> {
    let mut conn = connect(address).await?;
    if applied(&mut conn).await? == 0 {
        return Ok(());
    }
    while leader::read(&mut conn).await?.leads {
        tokio::time::sleep(LOOK).await;
    }
    conn.close().await
}

/// Checks that a database opened for reading belongs to the parts `found` beside it and has this build's schema. Returns
/// the store's identity.
pub(crate) async fn check_to_read(
    address: &PostgresAddress,
    dir: &Path,
    found: &StoreParts,
) -> Result<StoreId, OpenError> {
    let path = name(address);
    let failed = |e: &sqlx::Error| open_error(&path, e);
    let mut conn = connect(address).await.map_err(|e| failed(&e))?;
    let Some(stored) = open::stored(&mut Conn::Postgres(&mut conn)).await.map_err(|e| failed(&e))? else {
        found.classify(None).map_err(|mismatch| mismatched(dir, mismatch))?;
        return Err(OpenError::NotAStore(path));
    };
    found.classify(Some(&stored)).map_err(|mismatch| mismatched(dir, mismatch))?;
    let applied = applied(&mut conn).await.map_err(|e| failed(&e))?;
    conn.close().await.map_err(|e| failed(&e))?;
    match applied.cmp(&newest()) {
        Ordering::Equal => Ok(stored.id),
        Ordering::Greater => Err(OpenError::NewerSchema { path, found: applied, known: newest() }),
        Ordering::Less => Err(OpenError::OlderSchema { path, found: applied, known: newest() }),
    }
}

/// Fills an empty database with the catalog of another one. Returns the number of rows.
pub(crate) async fn fill(address: &PostgresAddress, from: &Pool) -> Result<u64, MoveError> {
    let path = name(address);
    let failed = |e: sqlx::Error| MoveError::Open(open_error(&path, &e));
    let mut conn = connect(address).await.map_err(failed)?;
    check_server(&path, &mut conn).await?;
    if open::stored(&mut Conn::Postgres(&mut conn)).await.map_err(failed)?.is_some() {
        return Err(MoveError::Refused(format!("{address} has a store already; choose an empty database")));
    }
    migrate(&path, &mut conn).await?;
    let mut moment = from.moment().await.map_err(QueryError::from)?;
    let mut writing = conn.begin().await.map_err(failed)?;
    let rows = transfer::copy_all(&mut moment.conn(), &mut Conn::Postgres(&mut writing)).await?;
    writing.commit().await.map_err(failed)?;
    moment.end().await.map_err(QueryError::from)?;
    conn.close().await.map_err(failed)?;
    Ok(rows)
}

/// Describes damage that the server finds in the tables. Reads all of them; a page with a wrong checksum fails to be read.
pub(super) async fn problems(conn: &mut PgConnection) -> Result<Vec<String>, QueryError> {
    let conn = &mut Conn::Postgres(conn);
    let mut problems = Vec::new();
    let invalid = "SELECT CAST(indexrelid::regclass AS TEXT) FROM pg_index JOIN pg_class ON pg_class.oid = indrelid \
                   WHERE relnamespace = CAST(current_schema() AS regnamespace) AND NOT indisvalid";
    for row in query(invalid).fetch_all(conn).await? {
        problems.push(format!("database: the index `{}` is not valid", row.try_get::<String, _>(0)?));
    }
    for table in transfer::TABLES {
        if let Err(error) = transfer::count(conn, table).await {
            problems.push(format!("database: cannot read `{table}`: {error}"));
        }
    }
    Ok(problems)
}
