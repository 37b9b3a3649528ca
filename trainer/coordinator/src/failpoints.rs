//! The fail point `actor::decide` before each batch, at which tests make the actor panic.
//!
//! Compiled only with the feature `failpoints`. `STRIDE_COORDINATOR_PANIC=3` makes the third batch panic. The registry
//! and the worker have fail points and variables of their own, which kill the process.

/// Activates the fail point from `STRIDE_COORDINATOR_PANIC`. A binary's `main` calls it once. Without the feature it
/// does nothing.
///
/// # Panics
/// If the variable is not a number: the test would otherwise pass without a panic.
pub fn arm_from_env() {
    #[cfg(feature = "failpoints")]
    {
        use std::sync::atomic::{AtomicU64, Ordering};

        let Ok(text) = std::env::var("STRIDE_COORDINATOR_PANIC") else { return };
        let nth = text.parse::<u64>().expect("STRIDE_COORDINATOR_PANIC: a number");
        let seen = AtomicU64::new(0);
        let panic =
            move || assert_ne!(seen.fetch_add(1, Ordering::SeqCst) + 1, nth, "a test wants batch {nth} to panic");
        fail::cfg_callback("actor::decide", panic).expect("a fail point takes a callback");
    }
}
