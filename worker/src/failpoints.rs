//! Points at which tests kill a worker: `checkpoint::{before,after}_{upload,commit}` and `outcome::{before,after}_report`.
//!
//! Built only with the feature `failpoints`. `STRIDE_WORKER_FAILPOINT=name`, or `name@3` for the third time it gets there,
//! has the process end as by `kill -9` at one of them. The registry has points and a variable of its own.
//!
//! `STRIDE_WORKER_SECRET=text` is the secret of the process, so that a test can speak in its name.
//!
//! `STRIDE_WORKER_PACE=25` has every training step take 25 ms at the least, so that a test which stops something in the middle
//! of a stage finds a middle on a fast machine too.

/// Every point, in the order in which an attempt reaches them. An upload is one blob of a gang's stage.
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

/// Arms what the two variables name; called once when a worker starts. Does nothing without the feature.
///
/// # Panics
/// If a variable names no known point or no number: a test would otherwise pass without having killed anything.
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
                // The signal is on its way; nothing may happen after it.
                loop {
                    std::thread::park();
                }
            }
        };
        fail::cfg_callback(name, kill).expect("a fail point takes a callback");
    }
}

/// The secret that a test gave this process.
///
/// # Panics
/// If it is no secret.
#[cfg(feature = "failpoints")]
pub(crate) fn secret() -> Option<access::Token> {
    let text = std::env::var("STRIDE_WORKER_SECRET").ok()?;
    Some(text.parse().expect("STRIDE_WORKER_SECRET: a secret of plain ASCII"))
}

/// `None`: a process draws its own.
#[cfg(not(feature = "failpoints"))]
pub(crate) fn secret() -> Option<access::Token> {
    None
}

/// Gets to a point.
pub(crate) fn hit(name: &'static str) {
    debug_assert!(ALL.contains(&name));
    fail::fail_point!(name);
}

/// Gets to the exchange of a training step.
pub(crate) fn pace() {
    fail::fail_point!(PACE);
}
