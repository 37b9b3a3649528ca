//! Polls whose connection broke before they were answered: the worker's process was killed, or its machine is off the network.
//!
//! Only views read this, so that people see a loss at once. Decisions wait for the lease, because a connection may also break between
//! two living processes.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use protocol::{Incarnation, WorkerId};

use crate::time::Millis;
use crate::view::WorkerView;

/// Time in which a living worker polls again.
const AGAIN_MS: u64 = 300;
/// Time after which the lease has long decided.
pub(super) const KEPT_MS: u64 = 60_000;

/// The newest broken poll of each worker.
#[derive(Debug, Default)]
pub(crate) struct Lines(Mutex<HashMap<WorkerId, (Incarnation, Millis)>>);

impl Lines {
    pub(super) fn broken(&self) -> MutexGuard<'_, HashMap<WorkerId, (Incarnation, Millis)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows workers as unreachable that are here by their lease, and whose poll broke.
    pub(crate) fn mark(&self, workers: &mut [WorkerView], now: Millis) {
        let broken = self.broken();
        for worker in workers.iter_mut().filter(|worker| matches!(worker.state.as_str(), "idle" | "working")) {
            let found = broken.get(&worker.worker).filter(|(incarnation, _)| *incarnation == worker.incarnation);
            if found.is_some_and(|(_, at)| now.since(*at) >= AGAIN_MS) {
                worker.state = "unreachable".to_owned();
            }
        }
    }
}
