//! Blobs that held tasks have stored and no row names yet. The catalog has the same as rows ([`crate::Store::hold`]),
//! so that a restarted coordinator knows the uploads of workers that continued meanwhile.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{Digest, TaskId};

/// Blobs by the task that stored them.
#[derive(Debug, Default)]
pub(super) struct Holds(BTreeMap<TaskId, BTreeSet<Digest>>);

impl Holds {
    pub(super) fn hold(&mut self, task: &TaskId, digest: Digest) {
        self.0.entry(task.clone()).or_default().insert(digest);
    }

    /// Returns true if the task has stored the blob and is still held.
    pub(super) fn has(&self, task: &TaskId, digest: Digest) -> bool {
        self.0.get(task).is_some_and(|digests| digests.contains(&digest))
    }

    pub(super) fn all(&self) -> BTreeSet<Digest> {
        self.0.values().flatten().copied().collect()
    }

    /// Forgets the tasks that are no longer held, and returns them.
    pub(super) fn let_go(&mut self, is_held: impl Fn(&TaskId) -> bool) -> Vec<TaskId> {
        let over: Vec<TaskId> = self.0.keys().filter(|task| !is_held(task)).cloned().collect();
        for task in &over {
            self.0.remove(task);
        }
        over
    }
}
