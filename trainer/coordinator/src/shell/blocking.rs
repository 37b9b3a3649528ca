//! Blocking calls outside the threads that serve requests.

/// Runs a blocking call outside the threads that serve requests.
pub(crate) async fn blocking<T: Send + 'static>(call: impl FnOnce() -> T + Send + 'static) -> T {
    match tokio::task::spawn_blocking(call).await {
        Ok(value) => value,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // This happens only at the end of the runtime, when this task is about to be dropped too.
            Err(_) => std::future::pending().await,
        },
    }
}
