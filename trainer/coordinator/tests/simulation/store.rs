//! A store in memory: a transaction is taken whole or not at all, fences are checked inside.

use std::collections::BTreeMap;

use coordinator::event::Known;
use protocol::message::Grant;
use protocol::{Digest, Fence, RunId, TaskId};
use registry::Write;
use serde_json::Value;

#[derive(Debug, Clone, Default)]
pub(crate) struct FakeStore {
    pub(crate) journal: Vec<Value>,
    pub(crate) fences: BTreeMap<TaskId, Fence>,
    pub(crate) results: BTreeMap<Digest, Known>,
    pub(crate) runs: BTreeMap<RunId, String>,
    pub(crate) shards: BTreeMap<TaskId, Digest>,
    pub(crate) versions: u64,
    pub(crate) promotions: u64,
    /// How often each task's end was accepted.
    pub(crate) accepted: BTreeMap<TaskId, u64>,
    /// Gates hold unless they say `never`.
    pub(crate) checkpoints: u64,
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    Gate,
    Full,
}

impl FakeStore {
    pub(crate) fn write(&mut self, writes: &[Write]) -> Result<(), Refusal> {
        // The journal only grows: its new entries wait until nothing can be refused any more, so that it is not copied.
        let journal = std::mem::take(&mut self.journal);
        let mut next = self.clone();
        let applied = writes.iter().try_for_each(|write| next.apply(write));
        self.journal = journal;
        applied?;
        self.journal.append(&mut next.journal);
        *self = Self { journal: std::mem::take(&mut self.journal), ..next };
        Ok(())
    }

    fn check(&self, grant: &Grant) {
        // The coordinator's own check came first; had it let a stale grant pass, this is where it would show.
        assert_eq!(self.fences.get(&grant.task), Some(&grant.fence), "a stale write got this far: {grant:?}");
    }

    fn apply(&mut self, write: &Write) -> Result<(), Refusal> {
        match write {
            Write::Journal(entry) => self.journal.push(entry.clone()),
            Write::Fence { task, fence } => {
                let before = self.fences.insert(task.clone(), *fence);
                assert!(before.is_none_or(|before| before < *fence), "the fence of {task} fell to {fence}");
            }
            Write::Run { run, state, .. } => drop(self.runs.insert(run.clone(), state.clone())),
            Write::Metrics { grant, .. } | Write::Logs { grant, .. } => self.check(grant),
            Write::Checkpoint { grant, .. } => {
                self.check(grant);
                self.checkpoints += 1;
            }
            Write::Shard { grant, output } => {
                self.check(grant);
                self.shards.insert(grant.task.clone(), *output);
                *self.accepted.entry(grant.task.clone()).or_default() += 1;
            }
            Write::StageResult { grant, key, outputs, metrics, .. } => {
                if let Some(grant) = grant {
                    self.check(grant);
                    *self.accepted.entry(grant.task.clone()).or_default() += 1;
                }
                let known = Known { outputs: outputs.clone(), metrics: metrics.clone() };
                let before = self.results.insert(*key, known);
                assert!(before.is_none(), "stage {key} was done twice");
            }
            Write::Version { .. } => self.versions += 1,
            Write::Promote { require, .. } => {
                if require.iter().any(|gate| gate.contains("never")) {
                    return Err(Refusal::Gate);
                }
                self.promotions += 1;
            }
        }
        Ok(())
    }
}
