//! The one writer: a thread with the one connection that writes.
//!
//! What waits when it is free goes into one transaction, so that many callers share the cost of one sync (group commit).
//! Each order stands in a savepoint of its own: one that is refused leaves no trace and does not fail its neighbours.
//! Nobody is answered before the transaction is on disk.

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;

use fail::fail_point;
use protocol::stage::Keep;
use protocol::{Alias, Digest, ModelName, TaskId};
use sqlx::{Connection, SqliteConnection};
use tokio::sync::{mpsc, oneshot};

use super::{apply, open_writer, write_error};
use crate::blob::BlobStore;
use crate::catalog::{Expect, Promotion};
use crate::lock::StoreLock;
use crate::retention::{self, Plan};
use crate::store::OpenError;
use crate::{Write, WriteError, catalog};

/// Orders of one transaction at most. Beyond it the latency of the first grows and the share of the sync is small.
const GROUP: usize = 256;
/// Orders that may wait; more callers than this wait themselves.
const QUEUE: usize = 4096;

/// One thing to do in a transaction.
#[derive(Debug)]
pub(crate) enum Order {
    Write(Vec<Write>),
    Promote(catalog::PromoteOrder),
    Rollback {
        model: ModelName,
        alias: Alias,
        to: Option<u64>,
        expect: Option<Expect>,
        reason: String,
        actor: String,
    },
    PruneCheckpoints {
        task: TaskId,
        keep: Keep,
    },
    Pin {
        digest: Digest,
        reason: Option<String>,
    },
    /// Never part of a group: a blob must not go before the row that named it is gone for good.
    Collect {
        grace_ms: i64,
    },
}

/// What an order gives.
#[derive(Debug)]
pub(crate) enum Done {
    Nothing,
    Promoted(Box<Promotion>),
    Pruned(Vec<Digest>),
    Collected(Plan),
}

type Answer = oneshot::Sender<Result<Done, WriteError>>;

/// The queue to the writer's thread.
#[derive(Debug)]
pub(crate) struct Writer {
    queue: Option<mpsc::Sender<(Order, Answer)>>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the thread and returns once the schema is up to date. The thread keeps the lock until its last commit.
    pub(crate) async fn start(dir: PathBuf, blobs: BlobStore, lock: Arc<StoreLock>) -> Result<Self, OpenError> {
        let (queue, orders) = mpsc::channel(QUEUE);
        let (ready, opened) = oneshot::channel();
        let path = dir.clone();
        let thread = std::thread::Builder::new()
            .name("registry-writer".into())
            .spawn(move || {
                let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
                    Ok(runtime) => runtime,
                    Err(e) => {
                        let _ = ready.send(Err(OpenError::Other { path: dir, message: e.to_string() }));
                        return;
                    }
                };
                runtime.block_on(async {
                    let conn = match open_writer(&dir).await {
                        Ok(conn) => conn,
                        Err(e) => {
                            // Gone only if the caller gave up opening.
                            let _ = ready.send(Err(e));
                            return;
                        }
                    };
                    if ready.send(Ok(())).is_ok() {
                        serve(conn, orders, &blobs).await;
                    }
                });
                drop(lock);
            })
            .map_err(|e| OpenError::Other { path: path.clone(), message: format!("no thread for the writer: {e}") })?;
        let ended = || OpenError::Other { path, message: "the writer ended while opening".into() };
        opened.await.map_err(|_| ended())??;
        Ok(Self { queue: Some(queue), thread: Some(thread) })
    }

    /// Returns once the order is on disk, or refused.
    pub(crate) async fn order(&self, order: Order) -> Result<Done, WriteError> {
        let gone = || WriteError::Internal("the store's writer has ended".into());
        let (answer, done) = oneshot::channel();
        let queue = self.queue.as_ref().ok_or_else(gone)?;
        queue.send((order, answer)).await.map_err(|_| gone())?;
        done.await.map_err(|_| gone())?
    }
}

impl Drop for Writer {
    /// Waits for the last commit, so that whoever opens the store next finds it free and whole.
    fn drop(&mut self) {
        self.queue = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

async fn serve(mut conn: SqliteConnection, mut orders: mpsc::Receiver<(Order, Answer)>, blobs: &BlobStore) {
    let mut group = Vec::with_capacity(GROUP);
    while orders.recv_many(&mut group, GROUP).await > 0 {
        let collections: Vec<_> = group.extract_if(.., |(order, _)| matches!(order, Order::Collect { .. })).collect();
        if !group.is_empty() {
            commit(&mut conn, blobs, &mut group).await;
        }
        for (order, answer) in collections {
            let Order::Collect { grace_ms } = order else { continue };
            let _ = answer.send(retention::collect(&mut conn, blobs, grace_ms).await.map(Done::Collected));
        }
    }
    if let Err(e) = conn.close().await {
        tracing::warn!("closing the database: {e}");
    }
}

async fn commit(conn: &mut SqliteConnection, blobs: &BlobStore, group: &mut Vec<(Order, Answer)>) {
    let mut results = Vec::with_capacity(group.len());
    let mut outcome = run_all(conn, blobs, group, &mut results).await;
    if outcome.is_ok() {
        fail_point!("db::before_commit");
        outcome = exec(conn, "COMMIT").await;
        fail_point!("db::after_commit");
    }
    if let Err(e) = outcome {
        // Some errors (a full disk) have ended the transaction by themselves; then there is nothing to roll back.
        let _ = exec(conn, "ROLLBACK").await;
        for (_, answer) in group.drain(..) {
            let _ = answer.send(Err(copy_of(&e)));
        }
        return;
    }
    for ((_, answer), result) in group.drain(..).zip(results) {
        // A caller that has gone away finds its write stored; writes are idempotent.
        let _ = answer.send(result);
    }
}

/// Runs every order in its savepoint. An error here is one of the whole transaction.
async fn run_all(
    conn: &mut SqliteConnection,
    blobs: &BlobStore,
    group: &[(Order, Answer)],
    results: &mut Vec<Result<Done, WriteError>>,
) -> Result<(), WriteError> {
    exec(conn, "BEGIN IMMEDIATE").await?;
    for (order, _) in group {
        exec(conn, "SAVEPOINT o").await?;
        let result = run(conn, blobs, order).await;
        if let Err(e) = &result
            && exec(conn, "ROLLBACK TO o").await.is_err()
        {
            // The database ended the whole transaction, as it does on a full disk; that is every order's error.
            return Err(copy_of(e));
        }
        exec(conn, "RELEASE o").await?;
        results.push(result);
    }
    Ok(())
}

async fn run(conn: &mut SqliteConnection, blobs: &BlobStore, order: &Order) -> Result<Done, WriteError> {
    match order {
        Order::Write(writes) => apply::apply(conn, blobs, writes).await.map(|()| Done::Nothing),
        Order::Promote(order) => catalog::promote(conn, order).await.map(|p| Done::Promoted(Box::new(p))),
        Order::Rollback { model, alias, to, expect, reason, actor } => {
            catalog::rollback(conn, model, alias, *to, *expect, reason, actor)
                .await
                .map(|p| Done::Promoted(Box::new(p)))
        }
        Order::PruneCheckpoints { task, keep } => retention::prune(conn, task, keep).await.map(Done::Pruned),
        Order::Pin { digest, reason } => {
            retention::pin(conn, blobs, *digest, reason.as_deref()).await.map(|()| Done::Nothing)
        }
        Order::Collect { .. } => Err(WriteError::Internal("a collection cannot be part of a transaction".into())),
    }
}

async fn exec(conn: &mut SqliteConnection, sql: &'static str) -> Result<(), WriteError> {
    sqlx::query(sql).execute(conn).await.map(|_| ()).map_err(write_error)
}

fn copy_of(e: &WriteError) -> WriteError {
    match e {
        WriteError::Storage(message) => WriteError::Storage(message.clone()),
        e => WriteError::Internal(e.to_string()),
    }
}
