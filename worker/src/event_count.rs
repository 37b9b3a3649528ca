//! Waking threads that wait for any of several things: a frame, a newer generation, the end of a grant.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Locks, whatever happened to the thread that held the lock before: our critical sections leave whole values.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A counter that is waited on. Take a [`ticket`](EventCount::ticket), look at what you wait for, then [`wait`](EventCount::wait): a
/// ring in between is not missed.
#[derive(Debug, Default)]
pub(crate) struct EventCount {
    rung: Mutex<u64>,
    changed: Condvar,
}

impl EventCount {
    /// Wakes all who wait.
    pub(crate) fn notify(&self) {
        *lock(&self.rung) += 1;
        self.changed.notify_all();
    }

    /// How often it was rung.
    pub(crate) fn ticket(&self) -> u64 {
        *lock(&self.rung)
    }

    /// Returns once it was rung after `ticket` was taken, or after `at_most`.
    pub(crate) fn wait(&self, ticket: u64, at_most: Duration) {
        let guard = lock(&self.rung);
        drop(
            self.changed
                .wait_timeout_while(guard, at_most, |rung| *rung == ticket)
                .unwrap_or_else(PoisonError::into_inner),
        );
    }
}
