//! Points at which tests kill the process: `blob::{before,after}_{write,fsync,rename}` and `db::{before,after}_commit`.
//!
//! Built only with the feature `failpoints`. `STRIDE_FAILPOINT=name`, or `name@3` for the third pass, kills the process
//! at that point like `kill -9`.

/// All points, in the order in which a blob and then its row reach them.
pub const ALL: [&str; 8] = [
    "blob::before_write",
    "blob::after_write",
    "blob::before_fsync",
    "blob::after_fsync",
    "blob::before_rename",
    "blob::after_rename",
    "db::before_commit",
    "db::after_commit",
];

/// Passes a point.
macro_rules! fail_point {
    ($name:expr) => {
        #[cfg(feature = "failpoints")]
        fail::fail_point!($name);
    };
}

pub(crate) use fail_point;

/// Arms the point in `STRIDE_FAILPOINT`; called once by a binary's `main`. Does nothing without the feature.
///
/// # Panics
/// Panics if the variable names an unknown point, so that a test cannot pass without killing anything.
#[cfg(feature = "failpoints")]
pub fn arm_from_env() {
    let Ok(text) = std::env::var("STRIDE_FAILPOINT") else { return };
    let (name, nth) = match text.split_once('@') {
        Some((name, nth)) => (name, nth.parse::<u64>().expect("STRIDE_FAILPOINT: a number after `@`")),
        None => (text.as_str(), 1),
    };
    assert!(ALL.contains(&name), "STRIDE_FAILPOINT: `{name}` is none of {ALL:?}");
    let seen = std::sync::atomic::AtomicU64::new(0);
    fail::cfg_callback(name, move || {
        if seen.fetch_add(1, std::sync::atomic::Ordering::SeqCst) + 1 == nth {
            let _ = nix::sys::signal::kill(nix::unistd::Pid::this(), nix::sys::signal::Signal::SIGKILL);
            // Nothing may run until the signal arrives.
            loop {
                std::thread::park();
            }
        }
    })
    .expect("a fail point takes a callback");
}

/// Arms the point in `STRIDE_FAILPOINT`; called once by a binary's `main`. Does nothing without the feature.
#[cfg(not(feature = "failpoints"))]
pub fn arm_from_env() {}
