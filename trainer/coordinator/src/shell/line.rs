//! A poll that waits for its answer, and its connection ([`lines`](super::lines)).

use std::sync::Arc;

use protocol::proof::Process;

use super::actor_handle::ActorHandle;
use super::lines::KEPT_MS;

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
