//! The single writer: a thread with the only writing connection.
//!
//! Orders that wait when it is free share one transaction, and thus the cost of one sync (group commit). Each order has
//! its own savepoint: a refused one leaves no trace and does not fail the others. Answers are sent only after the
//! transaction is on disk.

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::{mpsc, oneshot};

use super::error::write_error;
use super::leader::{self, Leadership};
use super::open::Link;
use super::recording::Recording;
use super::statement::{Conn, int, query};
use super::{apply, forget, history, moves, postgres, retention};
use crate::WriteError;
use crate::catalog::{Done, Order, PostgresAddress};
use crate::failpoints::fail_point;
use crate::identity::Witness;
use crate::lock::StoreLock;
use crate::proofs::Proofs;

/// Most orders in one transaction. Beyond it the first one waits longer while the cost of the sync hardly falls.
const GROUP: usize = 256;
/// Length of the queue; further callers wait to enqueue.
const QUEUE: usize = 4096;

type Answer = oneshot::Sender<Result<Done, WriteError>>;

/// Time for which a writer tries to reach a server that went away, before it refuses the orders that wait.
const OUTAGE: Duration = Duration::from_secs(60);
/// Pause between two tries.
const AGAIN: Duration = Duration::from_millis(100);

/// The writing connection, and the epoch under which it may write.
#[derive(Debug)]
pub(crate) struct Session {
    pub(crate) link: Link,
    pub(crate) epoch: u64,
    /// Number of committed transactions.
    pub(crate) commits: u64,
    pub(crate) witness: Witness,
    /// Leadership of a catalog that several machines reach, and its address.
    pub(crate) leading: Option<(Leadership, PostgresAddress)>,
}

impl Session {
    /// Returns how long the writer may wait for orders.
    fn wait(&self) -> Option<Duration> {
        let witness = self.witness.is_behind().then_some(Witness::EVERY);
        let Some((leadership, _)) = &self.leading else { return witness };
        Some(leadership.terms().renewed.saturating_sub(leadership.since_renewal()))
    }

    /// Does what is due when no order has come.
    async fn keep_up(&mut self) {
        self.witness.catch_up();
        let Some((leadership, _)) = &self.leading else { return };
        let leadership = leadership.clone();
        let begun = Instant::now();
        match leader::renew(&mut self.link.conn(), &leadership).await {
            Ok(true) => leadership.renewed(begun),
            Ok(false) => leadership.end(),
            Err(error) => {
                tracing::warn!(%error, "cannot extend the leadership");
                tokio::time::sleep(AGAIN).await;
                self.reconnect().await;
            }
        }
    }

    /// Connects anew and returns true if this process still leads. Then `commits` is what was committed.
    async fn reconnect(&mut self) -> bool {
        let Some((leadership, address)) = self.leading.clone() else { return false };
        let begun = Instant::now();
        match postgres::continue_writing(&address, self.epoch, &leadership.terms()).await {
            Ok(Some((conn, commits))) => {
                self.link = Link::Postgres(conn);
                self.commits = commits;
                leadership.renewed(begun);
                true
            }
            Ok(None) => {
                leadership.end();
                false
            }
            Err(error) => {
                tracing::warn!(%error, "cannot reach the catalog's server; trying again");
                false
            }
        }
    }

    fn is_superseded(&self) -> bool {
        self.leading.as_ref().is_some_and(|(leadership, _)| leadership.is_over())
    }

    async fn close(self) {
        let Self { mut link, epoch, leading, .. } = self;
        if let Some((leadership, _)) = leading
            && !leadership.is_over()
            && let Err(error) = leader::release(&mut link.conn(), epoch).await
        {
            tracing::warn!(%error, "cannot release the leadership; the next process waits until it runs out");
        }
        if let Err(error) = link.close().await {
            tracing::warn!(%error, "closing the database");
        }
    }
}

/// The queue to the writer's thread.
#[derive(Debug)]
pub(crate) struct Writer {
    queue: Option<mpsc::Sender<(Order, Answer)>>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the thread on an open database. The thread keeps the lock until its last commit.
    pub(crate) fn start(session: Session, proofs: Arc<Proofs>, lock: Arc<StoreLock>) -> io::Result<Self> {
        let (queue, orders) = mpsc::channel(QUEUE);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let thread = std::thread::Builder::new().name("registry-writer".into()).spawn(move || {
            runtime.block_on(serve(session, orders, &proofs));
            drop(lock);
        })?;
        Ok(Self { queue: Some(queue), thread: Some(thread) })
    }

    /// Commits an order and returns when it is on disk or refused.
    pub(crate) async fn order(&self, order: Order) -> Result<Done, WriteError> {
        let gone = || WriteError::Internal("the store's writer has ended".into());
        let (answer, done) = oneshot::channel();
        let queue = self.queue.as_ref().ok_or_else(gone)?;
        queue.send((order, answer)).await.map_err(|_| gone())?;
        done.await.map_err(|_| gone())?
    }
}

impl Drop for Writer {
    /// Waits for the last commit, so that the next process finds the store free and complete.
    fn drop(&mut self) {
        self.queue = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

async fn serve(mut session: Session, mut orders: mpsc::Receiver<(Order, Answer)>, proofs: &Proofs) {
    let mut recording = Recording::default();
    let mut group = Vec::with_capacity(GROUP);
    // The connection that opened the catalog needs the caller's runtime, which may end or wait for this thread.
    while session.leading.is_some() && !session.reconnect().await && !session.is_superseded() {
        tokio::time::sleep(AGAIN).await;
    }
    loop {
        let received = match session.wait() {
            None => orders.recv_many(&mut group, GROUP).await,
            Some(wait) => match tokio::time::timeout(wait, orders.recv_many(&mut group, GROUP)).await {
                Ok(received) => received,
                Err(_) => {
                    session.keep_up().await;
                    continue;
                }
            },
        };
        if received == 0 {
            break;
        }
        commit(&mut session, proofs, &mut recording, &mut group).await;
    }
    session.witness.catch_up();
    session.close().await;
}

async fn commit(session: &mut Session, proofs: &Proofs, recording: &mut Recording, group: &mut Vec<(Order, Answer)>) {
    let mut results = Vec::with_capacity(group.len());
    match store(session, proofs, recording, group, &mut results).await {
        Ok(commits) => {
            for ((_, answer), result) in group.drain(..).zip(results) {
                // The write of a caller that has stopped waiting is stored; writes are idempotent.
                let _ = answer.send(result);
            }
            session.commits = commits;
            session.witness.committed(commits);
        }
        Err(e) => {
            if let (WriteError::Superseded { .. }, Some((leadership, _))) = (&e, &session.leading) {
                leadership.end();
            }
            for (_, answer) in group.drain(..) {
                let _ = answer.send(Err(copy_of(&e)));
            }
        }
    }
}

/// Stores a group of orders, over several connections if one breaks. The count of committed transactions shows if the
/// transaction of a broken connection was committed.
async fn store(
    session: &mut Session,
    proofs: &Proofs,
    recording: &mut Recording,
    group: &[(Order, Answer)],
    results: &mut Vec<Result<Done, WriteError>>,
) -> Result<u64, WriteError> {
    let begun = Instant::now();
    let before = session.commits;
    loop {
        if session.is_superseded() {
            return Err(WriteError::Superseded { epoch: session.epoch });
        }
        results.clear();
        let started = Instant::now();
        let why = match transact(session, proofs, recording, group, results).await {
            Err(WriteError::Unreachable(why)) if session.leading.is_some() => why,
            stored => {
                if let (Ok(_), Some((leadership, _))) = (&stored, &session.leading) {
                    leadership.renewed(started);
                }
                return stored;
            }
        };
        while !session.reconnect().await {
            if session.is_superseded() {
                return Err(WriteError::Superseded { epoch: session.epoch });
            }
            if begun.elapsed() > OUTAGE {
                return Err(WriteError::Unreachable(why));
            }
            tokio::time::sleep(AGAIN).await;
        }
        if session.commits > before {
            return Ok(session.commits);
        }
    }
}

/// Stores a group of orders in one transaction, or nothing.
async fn transact(
    session: &mut Session,
    proofs: &Proofs,
    recording: &mut Recording,
    group: &[(Order, Answer)],
    results: &mut Vec<Result<Done, WriteError>>,
) -> Result<u64, WriteError> {
    let leadership = session.leading.as_ref().map(|(leadership, _)| leadership);
    let conn = &mut session.link.conn();
    let mut outcome = run_all(conn, (session.epoch, leadership), proofs, recording, group, results).await;
    if outcome.is_ok() {
        fail_point!("db::before_commit");
        if let Err(e) = exec(conn, "COMMIT").await {
            outcome = Err(e);
        }
        fail_point!("db::after_commit");
    }
    if outcome.is_err() {
        recording.forget();
        // Some errors (a full disk) have ended the transaction by themselves; then there is nothing to roll back.
        let _ = exec(conn, "ROLLBACK").await;
    }
    outcome
}

/// Counts the transaction if no other process has opened the database since, and extends the leadership. Returns the count.
async fn count(conn: &mut Conn<'_>, epoch: u64, leadership: Option<&Leadership>) -> Result<u64, WriteError> {
    let count = match leadership {
        None => query("UPDATE store SET commits = commits + 1 WHERE epoch = ? RETURNING commits").bind(int(epoch)),
        Some(leadership) => {
            let count = "WITH leads AS (UPDATE leader SET until = clock_timestamp() + make_interval(secs => ?2), address = ?3 \
                         WHERE epoch = ?1 RETURNING epoch) UPDATE store SET commits = commits + 1 WHERE epoch = (SELECT epoch FROM leads) RETURNING commits";
            query(count).bind(int(epoch)).bind(leadership.terms().lease.as_secs_f64()).bind(leadership.address())
        }
    };
    let row = count.fetch_optional(conn).await.map_err(write_error)?;
    let row = row.ok_or(WriteError::Superseded { epoch })?;
    Ok(row.get::<i64, _>(0).unsigned_abs())
}

/// Runs every order in its savepoint and returns the transaction's number. An error concerns the whole transaction.
async fn run_all(
    conn: &mut Conn<'_>,
    (epoch, leadership): (u64, Option<&Leadership>),
    proofs: &Proofs,
    recording: &mut Recording,
    group: &[(Order, Answer)],
    results: &mut Vec<Result<Done, WriteError>>,
) -> Result<u64, WriteError> {
    let begin = if conn.is_sqlite() { "BEGIN IMMEDIATE" } else { "BEGIN" };
    exec(conn, begin).await?;
    let commits = count(conn, epoch, leadership).await?;
    for (order, _) in group {
        exec(conn, "SAVEPOINT o").await?;
        let result = run(conn, proofs, recording, order).await;
        if let Err(e) = &result {
            recording.forget();
            if exec(conn, "ROLLBACK TO o").await.is_err() {
                // The database ended the whole transaction, as it does on a full disk; that is every order's error.
                return Err(copy_of(e));
            }
        }
        exec(conn, "RELEASE o").await?;
        results.push(result);
    }
    Ok(commits)
}

async fn run(
    conn: &mut Conn<'_>,
    proofs: &Proofs,
    recording: &mut Recording,
    order: &Order,
) -> Result<Done, WriteError> {
    if let Order::Forget(_) | Order::ForgetLeftovers { .. } = order {
        recording.forget();
    }
    match order {
        Order::Write(writes) => apply::apply(conn, proofs, recording, writes).await.map(|()| Done::Nothing),
        Order::Promote(order) => moves::promote(conn, order).await.map(|p| Done::Promoted(Box::new(p))),
        Order::Rollback(order) => moves::rollback(conn, order).await.map(|p| Done::Promoted(Box::new(p))),
        Order::PruneCheckpoints { task, keep, at_end } => {
            retention::prune(conn, task, keep, *at_end).await.map(Done::Pruned)
        }
        Order::Pin { digest, reason } => {
            retention::pin(conn, proofs, *digest, reason.as_deref()).await.map(|()| Done::Nothing)
        }
        Order::Hold { task, digest } => retention::hold(conn, task, *digest).await.map(|()| Done::Nothing),
        Order::LetGo(tasks) => retention::let_go(conn, tasks).await.map(|()| Done::Nothing),
        Order::Forget(run) => forget::forget(conn, run).await.map(Done::Forgotten),
        Order::ForgetLeftovers { run, before_ms } => {
            forget::forget_leftovers(conn, run, *before_ms).await.map(Done::Forgotten)
        }
        Order::Delivered { hook, id } => history::record_delivery(conn, hook, *id).await.map(|()| Done::Nothing),
        Order::PruneHistory { before_ms } => history::prune(conn, *before_ms).await.map(Done::PrunedHistory),
        Order::BeginCollection => {
            // Earlier rows of this transaction are committed before the answer, and marking starts after the answer.
            proofs.begin_collection();
            retention::forget_shards(conn).await.map(Done::Begun)
        }
        Order::Condemn(blobs) => retention::condemn(conn, proofs, blobs).await.map(Done::Condemned),
    }
}

async fn exec(conn: &mut Conn<'_>, sql: &'static str) -> Result<(), WriteError> {
    query(sql).execute(conn).await.map(|_| ()).map_err(write_error)
}

fn copy_of(e: &WriteError) -> WriteError {
    match e {
        WriteError::Storage(message) => WriteError::Storage(message.clone()),
        WriteError::Superseded { epoch } => WriteError::Superseded { epoch: *epoch },
        WriteError::Unreachable(message) => WriteError::Unreachable(message.clone()),
        e => WriteError::Internal(e.to_string()),
    }
}
