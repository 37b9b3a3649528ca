//! The single writer: a thread with the only writing connection.
//!
//! Orders that wait when it is free share one transaction, and thus the cost of one sync (group commit). Each order has
//! its own savepoint: a refused one leaves no trace and does not fail the others. Answers are sent only after the
//! transaction is on disk.

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;

use fail::fail_point;
use sqlx::{Connection, Row, SqliteConnection};
use tokio::sync::{mpsc, oneshot};

use super::error::write_error;
use super::recording::Recording;
use super::statement::int;
use super::{apply, forget, history, moves, retention};
use crate::WriteError;
use crate::catalog::{Done, Order};
use crate::identity::Witness;
use crate::lock::StoreLock;
use crate::proofs::Proofs;

/// Most orders in one transaction. Beyond it the first one waits longer while the cost of the sync hardly falls.
const GROUP: usize = 256;
/// Length of the queue; further callers wait to enqueue.
const QUEUE: usize = 4096;

type Answer = oneshot::Sender<Result<Done, WriteError>>;

/// The writing connection, and the epoch under which it may write.
#[derive(Debug)]
pub(crate) struct Session {
    pub(crate) conn: SqliteConnection,
    pub(crate) epoch: u64,
    pub(crate) witness: Witness,
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
    loop {
        let received = if session.witness.is_behind() {
            match tokio::time::timeout(Witness::EVERY, orders.recv_many(&mut group, GROUP)).await {
                Ok(received) => received,
                Err(_) => {
                    session.witness.catch_up();
                    continue;
                }
            }
        } else {
            orders.recv_many(&mut group, GROUP).await
        };
        if received == 0 {
            break;
        }
        commit(&mut session, proofs, &mut recording, &mut group).await;
    }
    session.witness.catch_up();
    if let Err(e) = session.conn.close().await {
        tracing::warn!("closing the database: {e}");
    }
}

async fn commit(session: &mut Session, proofs: &Proofs, recording: &mut Recording, group: &mut Vec<(Order, Answer)>) {
    let mut results = Vec::with_capacity(group.len());
    let conn = &mut session.conn;
    let mut outcome = run_all(conn, session.epoch, proofs, recording, group, &mut results).await;
    if outcome.is_ok() {
        fail_point!("db::before_commit");
        outcome = match (exec(conn, "COMMIT").await, outcome) {
            (Ok(()), outcome) => outcome,
            (Err(e), _) => Err(e),
        };
        fail_point!("db::after_commit");
    }
    let commits = match outcome {
        Ok(commits) => commits,
        Err(e) => {
            recording.forget();
            // Some errors (a full disk) have ended the transaction by themselves; then there is nothing to roll back.
            let _ = exec(conn, "ROLLBACK").await;
            for (_, answer) in group.drain(..) {
                let _ = answer.send(Err(copy_of(&e)));
            }
            return;
        }
    };
    for ((_, answer), result) in group.drain(..).zip(results) {
        // The write of a caller that has stopped waiting is stored; writes are idempotent.
        let _ = answer.send(result);
    }
    session.witness.committed(commits);
}

/// Counts the transaction if no other process has opened the database since. Returns the count.
async fn count(conn: &mut SqliteConnection, epoch: u64) -> Result<u64, WriteError> {
    let count = sqlx::query("UPDATE store SET commits = commits + 1 WHERE epoch = ? RETURNING commits");
    let row = count.bind(int(epoch)).fetch_optional(conn).await.map_err(write_error)?;
    let row = row.ok_or(WriteError::Superseded { epoch })?;
    Ok(row.get::<i64, _>(0).unsigned_abs())
}

/// Runs every order in its savepoint and returns the transaction's number. An error concerns the whole transaction.
async fn run_all(
    conn: &mut SqliteConnection,
    epoch: u64,
    proofs: &Proofs,
    recording: &mut Recording,
    group: &[(Order, Answer)],
    results: &mut Vec<Result<Done, WriteError>>,
) -> Result<u64, WriteError> {
    exec(conn, "BEGIN IMMEDIATE").await?;
    let commits = count(conn, epoch).await?;
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
    conn: &mut SqliteConnection,
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

async fn exec(conn: &mut SqliteConnection, sql: &'static str) -> Result<(), WriteError> {
    sqlx::query(sql).execute(conn).await.map(|_| ()).map_err(write_error)
}

fn copy_of(e: &WriteError) -> WriteError {
    match e {
        WriteError::Storage(message) => WriteError::Storage(message.clone()),
        WriteError::Superseded { epoch } => WriteError::Superseded { epoch: *epoch },
        e => WriteError::Internal(e.to_string()),
    }
}
