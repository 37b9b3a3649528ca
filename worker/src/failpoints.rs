//! Points at which tests kill a worker: `checkpoint::{before,after}_{upload,commit}` and
//! `outcome::{before,after}_report`.
//!
//! They exist only with the feature `failpoints`. `STRIDE_WORKER_FAILPOINT=name` kills the process there as `kill -9`
//! would; `name@3` kills it at the third hit. The registry has its own points and its own variable.
//!
//! `STRIDE_WORKER_SECRET=text` sets the secret of the process, so that a test can send calls as this worker.
//!
//! `STRIDE_WORKER_PACE=25` makes every training step take at least 25 ms, so that a test can stop a stage in its middle
//! on a fast machine too.

/// All points, in the order in which an attempt reaches them. An upload is one blob of a gang's stage.
pub const ALL: [&str; 6] = [
    "checkpoint::before_upload",
    "checkpoint::after_upload",
    "checkpoint::before_commit",
    "checkpoint::after_commit",
    "outcome::before_report",
    "outcome::after_report",
];

/// The point before each exchange of a training step, at which `STRIDE_WORKER_PACE` sleeps.
#[cfg_attr(not(feature = "failpoints"), allow(dead_code, reason = "its reader is then empty"))]
const PACE: &str = "exchange::pace";

/// Activates the points that the variables name; called once when a worker starts. Does nothing without the feature.
///
/// # Panics
/// If a variable names no known point or no number. Otherwise a test would pass without killing anything.
pub fn arm_from_env() {
    #[cfg(feature = "failpoints")]
    {
        use std::sync::atomic::{AtomicU64, Ordering};

        if let Ok(text) = std::env::var("STRIDE_WORKER_PACE") {
            let pace = text.parse::<u64>().expect("STRIDE_WORKER_PACE: a number of milliseconds");
            fail::cfg(PACE, &format!("sleep({pace})")).expect("a fail point can sleep");
        }
        let Ok(text) = std::env::var("STRIDE_WORKER_FAILPOINT") else { return };
        let (name, nth) = match text.split_once('@') {
            Some((name, nth)) => (name, nth.parse::<u64>().expect("STRIDE_WORKER_FAILPOINT: a number after `@`")),
            None => (text.as_str(), 1),
        };
        assert!(ALL.contains(&name), "STRIDE_WORKER_FAILPOINT: `{name}` is none of {ALL:?}");
        let seen = AtomicU64::new(0);
        let kill = move || {
            if seen.fetch_add(1, Ordering::SeqCst) + 1 == nth {
                let _ = nix::sys::signal::kill(nix::unistd::Pid::this(), nix::sys::signal::Signal::SIGKILL);
                // Nothing may run until the signal arrives.
                loop {
                    std::thread::park();
                }
            }
        };
        fail::cfg_callback(name, kill).expect("a fail point takes a callback");
    }
}

/// The secret that a test sets for this process.
///
/// # Panics
/// If it is no valid secret.
#[cfg(feature = "failpoints")]
pub(crate) fn secret() -> Option<access::Token> {
    let text = std::env::var("STRIDE_WORKER_SECRET").ok()?;
    Some(text.parse().expect("STRIDE_WORKER_SECRET: a secret of plain ASCII"))
}

/// Returns `None`, so that the process draws its own secret.
#[cfg(not(feature = "failpoints"))]
pub(crate) fn secret() -> Option<access::Token> {
    None
}

/// Passes a point.
pub(crate) fn hit(name: &'static str) {
    debug_assert!(ALL.contains(&name));
    #[cfg(feature = "failpoints")]
    fail::fail_point!(name);
}

/// Passes the point of the exchange of a training step.
pub(crate) fn pace() {
    #[cfg(feature = "failpoints")]
    fail::fail_point!(PACE);
}
