//! An event count: wakes threads that wait for any of several events, such as a frame, a newer generation or the end of
//! a grant.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Locks a mutex and ignores poisoning, because our critical sections never leave a value half changed.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A counter of events to wait on. Take a [`ticket`](EventCount::ticket), check the condition, then call
/// [`wait`](EventCount::wait). A notification in between is not missed.
#[derive(Debug, Default)]
pub(crate) struct EventCount {
    rung: Mutex<u64>,
    changed: Condvar,
}

impl EventCount {
    /// Wakes all waiting threads.
    pub(crate) fn notify(&self) {
        *lock(&self.rung) += 1;
        self.changed.notify_all();
    }

    /// The number of notifications so far.
    pub(crate) fn ticket(&self) -> u64 {
        *lock(&self.rung)
    }

    /// Waits for a notification after `ticket`, for at most `at_most`.
    pub(crate) fn wait(&self, ticket: u64, at_most: Duration) {
        let guard = lock(&self.rung);
        drop(
            self.changed
                .wait_timeout_while(guard, at_most, |rung| *rung == ticket)
                .unwrap_or_else(PoisonError::into_inner),
        );
    }
}
