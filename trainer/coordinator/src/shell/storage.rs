//! Calls that need the place where the blobs lie, which may be slow or away: nothing else waits for them, and what is wrong is said.

use std::time::Duration;

use checkpoint::BlobError;
use protocol::message::StorageProblem;
use registry::Store;

/// How long a call may take before it is asked whether the place answers at all. Where it does again, the call shows it by then.
const PATIENCE: Duration = Duration::from_secs(1);
/// How often it is asked.
const AGAIN: Duration = Duration::from_millis(200);

/// What is wrong with the place, as far as calls have shown.
pub(super) fn problem(store: &Store) -> Option<StorageProblem> {
    store.blobs().problem().map(|problem| StorageProblem { since_ms: problem.since_ms, what: problem.what })
}

/// Waits for what is asked of the place, but not for a place that gives no answers. What was begun goes on without the asker.
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

/// Makes a call of the place, beside the threads that serve requests.
pub(super) async fn ask<T: Send + 'static, E: From<BlobError> + Send + 'static>(
    store: &Store,
    call: impl FnOnce() -> Result<T, E> + Send + 'static,
) -> Result<T, E> {
    unless_away(store, store.ask_blobs(call)).await?
}
