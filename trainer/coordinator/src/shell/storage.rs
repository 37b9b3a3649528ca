//! Calls to the blob storage, which may be slow or unreachable. Other calls do not wait for it, and its problems are
//! reported.

use std::time::Duration;

use checkpoint::BlobError;
use protocol::message::StorageProblem;
use registry::{BlobStore, Store};

/// Time before a pending call checks for a known problem. A storage that has recovered answers within this time.
const PATIENCE: Duration = Duration::from_secs(1);
/// Interval between these checks.
const AGAIN: Duration = Duration::from_millis(200);

/// The storage's current problem, as known from earlier calls.
pub(super) fn problem(store: &Store) -> Option<StorageProblem> {
    store.blobs().problem().map(|problem| StorageProblem { since_ms: problem.since_ms, what: problem.what })
}

/// Waits for a call to the storage, unless the storage does not answer. The call itself continues in the background.
pub(super) async fn unless_away<T>(store: &Store, asked: impl Future<Output = T>) -> Result<T, BlobError> {
    let away = async {
        tokio::time::sleep(PATIENCE).await;
        loop {
            if let Some(problem) = problem(store) {
                return BlobError::Unreachable(problem.what);
            }
            tokio::time::sleep(AGAIN).await;
        }
    };
    tokio::select! {
        biased;
        done = asked => Ok(done),
        away = away => Err(away),
    }
}

/// Makes a call to the storage outside the threads that serve requests.
pub(super) async fn ask<T: Send + 'static, E: From<BlobError> + Send + 'static>(
    store: &Store,
    call: impl FnOnce(&BlobStore) -> Result<T, E> + Send + 'static,
) -> Result<T, E> {
    unless_away(store, store.ask_blobs(call)).await?
}
