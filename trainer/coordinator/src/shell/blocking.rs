//! Calls that block, beside the threads that serve requests.

/// Runs what blocks on a disk outside the threads that serve requests.
pub(crate) async fn blocking<T: Send + 'static>(call: impl FnOnce() -> T + Send + 'static) -> T {
    match tokio::task::spawn_blocking(call).await {
        Ok(value) => value,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // Only at the end of the runtime: this task is about to go as well.
            Err(_) => std::future::pending().await,
        },
    }
}
