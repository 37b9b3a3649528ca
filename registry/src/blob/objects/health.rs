//! Health of an object store, judged by its requests.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::blob::Problem;
use crate::clock;

/// Longest time without any answer before the store counts as unresponsive.
const SILENCE: Duration = Duration::from_secs(5);

/// Requests under way, and results of the last ones.
#[derive(Debug, Default)]
pub(super) struct Health(Mutex<Inner>);

#[derive(Debug, Default)]
struct Inner {
    next: u64,
    /// Start times of the pending short requests, by number.
    waiting: BTreeMap<u64, (Instant, i64)>,
    answered: Option<Instant>,
    failed: Option<Problem>,
}

impl Health {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Registers a request that normally takes milliseconds. Dropping the returned value ends it.
    pub(super) fn begin(&self) -> Waiting<'_> {
        let mut inner = self.lock();
        let number = inner.next;
        inner.next += 1;
        inner.waiting.insert(number, (Instant::now(), clock::now_ms()));
        Waiting { health: self, number }
    }

    /// Records an answer of the store.
    pub(super) fn answered(&self) {
        let mut inner = self.lock();
        (inner.answered, inner.failed) = (Some(Instant::now()), None);
    }

    /// Records a failure of the store or of the connection.
    pub(super) fn failed(&self, what: impl FnOnce() -> String) {
        let what = what();
        let mut inner = self.lock();
        let since_ms = inner.failed.as_ref().map_or_else(clock::now_ms, |failed| failed.since_ms);
        inner.failed = Some(Problem { since_ms, what });
    }

    /// Returns the current problem of the store, if there is one.
    pub(super) fn problem(&self) -> Option<Problem> {
        let inner = self.lock();
        if inner.failed.is_some() {
            return inner.failed.clone();
        }
        let (began, since_ms) = inner.waiting.values().next()?;
        let silent = inner.answered.map_or(*began, |answered| answered.max(*began)).elapsed();
        let what = || format!("no answer for {} s", silent.as_secs());
        (silent >= SILENCE).then(|| Problem { since_ms: *since_ms, what: what() })
    }
}

/// A pending request.
#[derive(Debug)]
pub(super) struct Waiting<'a> {
    health: &'a Health,
    number: u64,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.health.lock().waiting.remove(&self.number);
    }
}
