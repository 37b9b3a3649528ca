//! Polls whose connection broke before they were answered: the worker's process was killed, or its machine is off the network.
//!
//! Only views read this, so that people see a loss at once. Decisions wait for the lease, because a connection may also break between
//! two living processes.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use protocol::proof::Process;
use protocol::{Incarnation, WorkerId};

use super::actor_handle::ActorHandle;
use crate::time::Millis;
use crate::view::WorkerView;

/// Time in which a living worker polls again.
const AGAIN_MS: u64 = 300;
/// Time after which the lease has long decided.
const KEPT_MS: u64 = 60_000;

/// The newest broken poll of each worker.
#[derive(Debug, Default)]
pub(crate) struct Lines(Mutex<HashMap<WorkerId, (Incarnation, Millis)>>);

impl Lines {
    fn broken(&self) -> MutexGuard<'_, HashMap<WorkerId, (Incarnation, Millis)>> {
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

/// A poll that waits for its answer.
pub(crate) struct Line {
    actor_handle: Arc<ActorHandle>,
    process: Process,
    answered: bool,
}

impl Line {
    pub(crate) fn new(actor_handle: Arc<ActorHandle>, process: Process) -> Self {
        actor_handle.lines.broken().remove(&process.worker);
        Self { actor_handle, process, answered: false }
    }

    /// The poll has an answer, even if the answer may still be lost.
    pub(crate) fn answered(mut self) {
        self.answered = true;
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        if self.answered {
            return;
        }
        let now = self.actor_handle.now();
        let mut broken = self.actor_handle.lines.broken();
        broken.retain(|_, (_, at)| now.since(*at) < KEPT_MS);
        broken.insert(self.process.worker.clone(), (self.process.incarnation, now));
    }
}
