//! Limits concurrent calls to the backend of the blobs. They block for an unbounded time, so a limit leaves threads for
//! other work.

use std::sync::Arc;

use tokio::sync::Semaphore;

/// Number of concurrent calls.
const CALLS: usize = 256;

/// Permits for calls. Clones share them.
#[derive(Debug, Clone)]
pub(crate) struct Calls(Arc<Semaphore>);

impl Default for Calls {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(CALLS)))
    }
}

impl Calls {
    /// Runs a call in a blocking thread as soon as a permit is free.
    pub(crate) async fn run<T: Send + 'static>(&self, call: impl FnOnce() -> T + Send + 'static) -> T {
        let Ok(place) = Arc::clone(&self.0).acquire_owned().await else { return std::future::pending().await };
        let running = tokio::task::spawn_blocking(move || {
            let done = call();
            // The permit ends with the thread, even if the caller has stopped waiting.
            drop(place);
            done
        });
        match running.await {
            Ok(done) => done,
            Err(error) => match error.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                // Happens only when the runtime shuts down; this task ends as well.
                Err(_) => std::future::pending().await,
            },
        }
    }
}
