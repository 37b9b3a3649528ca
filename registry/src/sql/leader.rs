//! Leadership: one process at a time writes to a catalog in PostgreSQL.
//!
//! The row `leader` has an epoch and a time until which the leader of that epoch leads, by the server's clock. Every
//! transaction of the writer begins by extending that time under its epoch, and so holds the row until it ends. A stand-by
//! takes the row once its time is over and raises the epoch; the former leader's next transaction then finds no row.
//!
//! | the leader | the stand-by leads, because |
//! |---|---|
//! | was killed, or is stopped between transactions | the time runs out |
//! | is stopped inside a transaction, which holds the row | the server ends its session after [`LeaderTerms::stalled`], or the stand-by does |
//! | is cut off | the same; its transaction is rolled back |
//!
//! A leader relies on its row for less time than a stand-by waits, measured from before its newest extension. An advisory
//! lock would not do: a stopped process keeps it.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use checkpoint::BlobError;
use sqlx::PgConnection;
use tokio::sync::watch;

use super::statement::{Conn, int, query};

type Result<T> = std::result::Result<T, sqlx::Error>;

/// Durations and remedies of leadership.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LeaderTerms {
    /// Time for which an extension lasts.
    pub lease: Duration,
    /// Interval of extensions without a transaction.
    pub renewed: Duration,
    /// Time after the start of an extension for which the leader relies on it.
    pub relied_on: Duration,
    /// Time after which the server ends the session of a leader that stalls inside a transaction; `None` never ends it.
    pub stalled: Option<Duration>,
    /// The stand-by ends the session of a leader whose time is over.
    pub terminates: bool,
}

impl Default for LeaderTerms {
    fn default() -> Self {
        let [lease, renewed, relied_on, stalled] = [2500, 600, 2000, 1500].map(Duration::from_millis);
        Self { lease, renewed, relied_on, stalled: Some(stalled), terminates: true }
    }
}

/// Time for which a process that has just taken the row leads, until its writer extends it.
const OPENING: Duration = Duration::from_secs(15);
/// Interval at which a process tries to take the row.
const AGAIN: Duration = Duration::from_millis(100);

/// The leader as its row describes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Leader {
    pub(crate) epoch: u64,
    /// False once its time is over.
    pub(crate) leads: bool,
    /// Text of the time until which it leads. It changes with each extension.
    pub(crate) until: String,
    pub(crate) name: String,
    pub(crate) address: Option<String>,
}

/// Reads the row.
pub(crate) async fn read(conn: &mut PgConnection) -> Result<Leader> {
    let find =
        "SELECT epoch, until >= clock_timestamp() AS leads, CAST(until AS TEXT) AS until, name, address FROM leader";
    let row = query(find).fetch_one(&mut Conn::Postgres(conn)).await?;
    Ok(Leader {
        epoch: row.try_get::<i64, _>("epoch")?.unsigned_abs(),
        leads: row.try_get("leads")?,
        until: row.try_get("until")?,
        name: row.try_get("name")?,
        address: row.try_get("address")?,
    })
}

/// Takes the row if the leader's time is over. Returns the new epoch; `None` while another process leads or stalls.
async fn take(conn: &mut PgConnection, name: &str, terms: &LeaderTerms) -> Result<Option<u64>> {
    if read(conn).await?.leads {
        return Ok(None);
    }
    let conn = &mut Conn::Postgres(conn);
    if terms.terminates {
        let end = "SELECT count(pg_terminate_backend(a.pid)) FROM leader JOIN pg_stat_activity a ON a.pid = leader.pid \
                   AND a.backend_start = leader.backend_started WHERE leader.until < clock_timestamp() AND a.pid <> pg_backend_pid()";
        query(end).fetch_one(conn).await?;
    }
    query("SET lock_timeout = '500ms'").execute(conn).await?;
    let take = "UPDATE leader SET epoch = greatest(epoch, coalesce((SELECT max(epoch) FROM store), 0)) + 1, \
                until = clock_timestamp() + make_interval(secs => ?), name = ?, address = NULL, pid = pg_backend_pid(), \
                backend_started = (SELECT backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid()) \
                WHERE until < clock_timestamp() RETURNING epoch";
    let taken = query(take).bind(OPENING.as_secs_f64()).bind(name).fetch_optional(conn).await;
    query("SET lock_timeout = 0").execute(conn).await?;
    match taken {
        Ok(row) => row.map(|row| Ok(row.try_get::<i64, _>(0)?.unsigned_abs())).transpose(),
        // The leader stalls inside a transaction.
        Err(e) if e.as_database_error().and_then(|e| e.code()).as_deref() == Some("55P03") => Ok(None),
        Err(e) => Err(e),
    }
}

/// Takes the row, after waiting for the end of a leader that no longer extends its time. Returns the new epoch, or the leader.
pub(crate) async fn take_or_find(
    conn: &mut PgConnection,
    name: &str,
    terms: &LeaderTerms,
) -> Result<std::result::Result<u64, Leader>> {
    let begun = Instant::now();
    let first = read(conn).await?;
    loop {
        if let Some(epoch) = take(conn, name, terms).await? {
            return Ok(Ok(epoch));
        }
        let leader = read(conn).await?;
        if leader.until != first.until || begun.elapsed() > OPENING + terms.lease {
            return Ok(Err(leader));
        }
        tokio::time::sleep(AGAIN).await;
    }
}

/// Extends the leader's time. Returns false if another process has taken the row.
pub(super) async fn renew(conn: &mut Conn<'_>, leadership: &Leadership) -> Result<bool> {
    let renew = "UPDATE leader SET until = clock_timestamp() + make_interval(secs => ?), address = ? WHERE epoch = ?";
    let renew = query(renew).bind(leadership.terms().lease.as_secs_f64()).bind(leadership.address());
    Ok(renew.bind(int(leadership.epoch())).execute(conn).await? > 0)
}

/// Continues to lead over another connection. Waits for the end of the former connection's transaction.
pub(super) async fn continue_over(conn: &mut Conn<'_>, epoch: u64, terms: &LeaderTerms) -> Result<bool> {
    let end = "SELECT count(pg_terminate_backend(a.pid)) FROM leader JOIN pg_stat_activity a ON a.pid = leader.pid \
               AND a.backend_start = leader.backend_started WHERE leader.epoch = ? AND a.pid <> pg_backend_pid()";
    query(end).bind(int(epoch)).fetch_one(conn).await?;
    let take = "UPDATE leader SET until = clock_timestamp() + make_interval(secs => ?), pid = pg_backend_pid(), \
                backend_started = (SELECT backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid()) WHERE epoch = ?";
    Ok(query(take).bind(terms.lease.as_secs_f64()).bind(int(epoch)).execute(conn).await? > 0)
}

/// Leaves the row to the next process at once.
pub(super) async fn release(conn: &mut Conn<'_>, epoch: u64) -> Result<()> {
    let free = query("UPDATE leader SET until = '-infinity', address = NULL WHERE epoch = ?").bind(int(epoch));
    free.execute(conn).await.map(drop)
}

/// The leadership of this process. Clones share it.
#[derive(Debug, Clone)]
pub struct Leadership(Arc<State>);

#[derive(Debug)]
struct State {
    epoch: u64,
    terms: LeaderTerms,
    /// Start of the newest successful extension.
    renewed: Mutex<Instant>,
    superseded: watch::Sender<bool>,
    /// Address at which this process answers.
    address: Mutex<Option<String>>,
}

impl Leadership {
    /// Leads under `epoch` since `since`.
    pub(crate) fn begin(epoch: u64, terms: LeaderTerms, since: Instant) -> Self {
        Self(Arc::new(State {
            epoch,
            terms,
            renewed: Mutex::new(since),
            superseded: watch::Sender::new(false),
            address: Mutex::default(),
        }))
    }

    /// Sets the address that the next extension publishes.
    pub(crate) fn set_address(&self, address: &str) {
        *self.0.address.lock().unwrap_or_else(PoisonError::into_inner) = Some(address.to_owned());
    }

    pub(super) fn address(&self) -> Option<String> {
        self.0.address.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Checks the leadership before a removal of blobs.
    pub(crate) fn may_remove(&self) -> std::result::Result<(), BlobError> {
        if self.leads() {
            return Ok(());
        }
        Err(BlobError::Unreachable("nothing was removed: another process may lead the catalog".into()))
    }

    pub(super) fn terms(&self) -> LeaderTerms {
        self.0.terms
    }

    pub(super) fn since_renewal(&self) -> Duration {
        self.0.renewed.lock().unwrap_or_else(PoisonError::into_inner).elapsed()
    }

    pub(super) fn renewed(&self, begun: Instant) {
        *self.0.renewed.lock().unwrap_or_else(PoisonError::into_inner) = begun;
    }

    pub(super) fn end(&self) {
        self.0.superseded.send_replace(true);
    }

    pub(super) fn is_over(&self) -> bool {
        *self.0.superseded.borrow()
    }

    /// Returns the epoch under which this process leads.
    pub fn epoch(&self) -> u64 {
        self.0.epoch
    }

    /// Returns true while this process may rely on being the leader. A process that was stopped learns here that its time is over.
    pub fn leads(&self) -> bool {
        !self.is_over() && self.since_renewal() <= self.0.terms.relied_on
    }

    /// Returns once another process has taken over.
    pub async fn superseded(&self) {
        let mut superseded = self.0.superseded.subscribe();
        // The sender lives as long as `self`.
        let _ = superseded.wait_for(|ended| *ended).await;
    }
}
