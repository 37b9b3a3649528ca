//! Calls that ask the place where blobs lie. They block, for as long as the place takes; so there are so many at once and no more, and
//! threads are left for all else.

use std::sync::Arc;

use tokio::sync::Semaphore;

/// Calls at once.
const CALLS: usize = 256;

/// The places for calls. Clones share them.
#[derive(Debug, Clone)]
pub(crate) struct Calls(Arc<Semaphore>);

impl Default for Calls {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(CALLS)))
    }
}

impl Calls {
    /// Runs a call beside the threads that answer others, once there is a place for it.
    pub(crate) async fn run<T: Send + 'static>(&self, call: impl FnOnce() -> T + Send + 'static) -> T {
        let Ok(place) = Arc::clone(&self.0).acquire_owned().await else { return std::future::pending().await };
        let running = tokio::task::spawn_blocking(move || {
            let done = call();
            // With the thread, and not with whoever has ceased to wait for it.
            drop(place);
            done
        });
        match running.await {
            Ok(done) => done,
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                // Only at the end of the runtime: this task is about to go as well.
                Err(_) => std::future::pending().await,
            },
        }
    }
}
