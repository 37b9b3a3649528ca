//! The point at which tests have the actor panic: `actor::decide`, before each batch.
//!
//! Built only with the feature `failpoints`. `STRIDE_COORDINATOR_PANIC=3` has the third batch panic. The registry and the worker have
//! points and variables of their own, at which the process is killed.

/// Arms what `STRIDE_COORDINATOR_PANIC` says; called once by a binary's `main`. Does nothing without the feature.
///
/// # Panics
/// If the variable is no number: a test would otherwise pass without having seen a panic.
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
