//! A store in memory. Transactions are atomic and check fences; blobs are only names.

use std::collections::{BTreeMap, BTreeSet};

use coordinator::event::Event;
use coordinator::journal::ChangedPart;
use coordinator::state::run::Run;
use coordinator::value::Known;
use coordinator::{State, journal};
use protocol::message::{Grant, RunView};
use protocol::{Digest, Fence, RunId, StageName, TaskId};
use registry::{HistoryEntry, Recovery, Write};

#[derive(Debug, Clone, Default)]
pub(crate) struct FakeStore {
    /// Data for the recovery of a coordinator.
    pub(crate) recovery: Recovery,
    pub(crate) fences: BTreeMap<TaskId, Fence>,
    pub(crate) history: Vec<HistoryEntry>,
    pub(crate) results: BTreeMap<Digest, (Known, RunId, StageName)>,
    pub(crate) runs: BTreeMap<RunId, String>,
    pub(crate) keys: BTreeMap<String, RunId>,
    /// Views and archives of ended runs.
    pub(crate) ended: BTreeMap<RunId, (String, String)>,
    pub(crate) executions: BTreeMap<Digest, String>,
    pub(crate) shards: BTreeMap<TaskId, Digest>,
    pub(crate) versions: u64,
    pub(crate) promotions: u64,
    /// Number of accepted ends of each task.
    pub(crate) accepted: BTreeMap<TaskId, u64>,
    /// Number of times that a task's output was found damaged; the task may be accepted again as often.
    pub(crate) remade: BTreeMap<TaskId, u64>,
    pub(crate) checkpoints: BTreeMap<(TaskId, u64), Digest>,
    /// Blobs collected between their upload and the report that names them; such a report is refused.
    pub(crate) collected: BTreeSet<Digest>,
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// A gate does not hold; in this store, gates with `never` in their text.
    Gate,
    /// A named blob does not exist.
    Missing(Digest),
}

impl FakeStore {
    pub(crate) fn write(&mut self, writes: &[Write]) -> Result<(), Refusal> {
        // A refused transaction changes nothing.
        writes.iter().try_for_each(|write| self.takes(write))?;
        writes.iter().for_each(|write| self.apply(write));
        Ok(())
    }

    /// Checks that a write can be stored.
    fn takes(&self, write: &Write) -> Result<(), Refusal> {
        match write {
            Write::Checkpoint { manifest, .. } => self.is_there(*manifest),
            Write::Shard { output, .. } => self.is_there(*output),
            Write::StageResult { grant: Some(_), outputs, .. } => {
                outputs.values().try_for_each(|output| self.is_there(*output))
            }
            Write::Promote { require, .. } if require.iter().any(|gate| gate.contains("never")) => Err(Refusal::Gate),
            _ => Ok(()),
        }
    }

    fn check(&self, grant: &Grant) {
        // The coordinator has already checked the grant; this assertion detects a stale grant that passed.
        assert_eq!(self.fences.get(&grant.task), Some(&grant.fence), "a stale write got this far: {grant:?}");
    }

    /// Uploaded blobs exist unless they were collected before they were named; the next upload restores them.
    fn is_there(&self, digest: Digest) -> Result<(), Refusal> {
        if self.collected.contains(&digest) { Err(Refusal::Missing(digest)) } else { Ok(()) }
    }

    fn apply(&mut self, write: &Write) {
        match write {
            Write::Facts { seq, facts } => self.recovery.facts.push((*seq, facts.clone())),
            Write::SnapshotParts { .. } | Write::Snapshot { .. } => {
                unreachable!("the world takes snapshots by `snapshot`")
            }
            Write::Fence { task, fence } => {
                let before = self.fences.insert(task.clone(), *fence);
                assert!(before.is_none_or(|before| before < *fence), "the fence of {task} fell to {fence}");
            }
            Write::Run { run, state, idempotency_key, .. } => {
                let before = self.runs.insert(run.clone(), state.clone());
                assert!(before.is_none(), "there are two runs {run}");
                if let Some(key) = idempotency_key {
                    let before = self.keys.insert(key.clone(), run.clone());
                    assert!(before.is_none(), "two runs have the key {key}");
                }
            }
            Write::Submission { .. } | Write::RunOwner { .. } | Write::ModelOwner { .. } => {}
            Write::RunState { run, state } => drop(self.runs.insert(run.clone(), state.clone())),
            Write::RunEnded { run, state, view, archive } => {
                self.runs.insert(run.clone(), state.clone());
                self.ended.insert(run.clone(), (view.clone(), archive.clone()));
            }
            Write::Archive { key, execution, .. } => match execution {
                Some(execution) => drop(self.executions.insert(*key, execution.clone())),
                None => drop(self.executions.remove(key)),
            },
            Write::History(entries) => self.history.extend(entries.iter().cloned()),
            Write::Metrics { grant, .. } | Write::Logs { grant, .. } => self.check(grant),
            Write::Checkpoint { grant, step, manifest, .. } => {
                self.check(grant);
                let before = self.checkpoints.insert((grant.task.clone(), *step), *manifest);
                assert!(before.is_none_or(|before| before == *manifest), "two states of step {step} of {}", grant.task);
            }
            Write::Shard { grant, output } => {
                self.check(grant);
                self.shards.insert(grant.task.clone(), *output);
                *self.accepted.entry(grant.task.clone()).or_default() += 1;
            }
            Write::StageResult { grant, key, run, stage, outputs, metrics, .. } => {
                if let Some(grant) = grant {
                    self.check(grant);
                    *self.accepted.entry(grant.task.clone()).or_default() += 1;
                }
                let known = Known { outputs: outputs.clone(), metrics: metrics.clone() };
                let before = self.results.insert(*key, (known, run.clone(), stage.clone()));
                assert!(before.is_none(), "stage {key} was done twice");
            }
            Write::Version { .. } => self.versions += 1,
            Write::Promote { .. } => self.promotions += 1,
        }
    }

    /// Marks an artifact as damaged: its value is no longer known, and its tasks may be accepted again.
    #[allow(dead_code, reason = "not every test that shares this file damages anything")]
    pub(crate) fn damage(&mut self, digest: Digest) {
        let gave = |(known, ..): &(Known, RunId, StageName)| known.outputs.values().any(|output| *output == digest);
        let keys: Vec<Digest> = self.results.iter().filter(|(_, result)| gave(result)).map(|(key, _)| *key).collect();
        for key in keys {
            let Some((_, run, stage)) = self.results.remove(&key) else { continue };
            let whole = TaskId::of(&run, &stage, None);
            let is_of_it = |task: &TaskId| {
                task.as_str().strip_prefix(whole.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
            };
            for task in self.accepted.keys().filter(|task| is_of_it(task)) {
                *self.remade.entry(task.clone()).or_default() += 1;
            }
        }
    }

    /// Returns true if a stored row names the blob.
    #[allow(dead_code, reason = "not every test that shares this file collects")]
    pub(crate) fn is_rooted(&self, digest: Digest) -> bool {
        let mut outputs = self.results.values().flat_map(|(known, ..)| known.outputs.values());
        let mut others = self.shards.values().chain(self.checkpoints.values());
        outputs.any(|known| *known == digest) || others.any(|known| *known == digest)
    }

    /// The number of the newest decision.
    #[allow(dead_code, reason = "not every test that shares this file asks")]
    pub(crate) fn seq(&self) -> u64 {
        let snapshot = self.recovery.snapshot.as_ref().map_or(0, |(seq, _)| *seq);
        self.recovery.facts.last().map_or(snapshot, |(seq, _)| snapshot.max(*seq))
    }

    /// Stores the state as a snapshot and deletes the facts before it.
    pub(crate) fn snapshot(&mut self, state: &State) {
        let stored = Recovery { facts: Vec::new(), ..self.recovery.clone() };
        let before = journal::recover(state.policy.clone(), &stored).expect("the snapshot before");
        for (part, text) in journal::changed_parts(&before, state).iter().map(ChangedPart::stored) {
            match text {
                Some(text) => drop(self.recovery.parts.insert(part, text)),
                None => assert!(self.recovery.parts.remove(&part).is_some(), "{part} was there"),
            }
        }
        self.recovery.snapshot = Some((state.seq, journal::snapshot(state)));
        self.recovery.facts.retain(|(seq, _)| *seq > state.seq);
    }

    /// The answer to a lookup.
    pub(crate) fn look_up(&self, key: Digest) -> Event {
        let found = self.results.get(&key).cloned();
        let archived = match &found {
            Some(_) => None,
            None => self.executions.get(&key).map(|text| serde_json::from_str(text).expect("an execution")),
        };
        let (known, source) = found.map(|(known, run, stage)| (known, (run, stage))).unzip();
        Event::LookedUp { key, known, source, archived }
    }

    /// Serialises the data that a coordinator recovers from.
    pub(crate) fn to_json(&self) -> String {
        let results: Vec<_> = self.results.iter().map(|(key, (known, run, stage))| (key, known, run, stage)).collect();
        let checkpoints: Vec<_> = self.checkpoints.iter().map(|((task, step), digest)| (task, step, digest)).collect();
        let stored = serde_json::json!({
            "snapshot": self.recovery.snapshot, "parts": self.recovery.parts, "facts": self.recovery.facts, "fences": self.fences, "results": results,
            "runs": self.runs, "keys": self.keys, "ended": self.ended, "executions": self.executions, "shards": self.shards,
            "accepted": self.accepted, "checkpoints": checkpoints,
        });
        serde_json::to_string_pretty(&stored).expect("JSON") + "\n"
    }

    /// Reads the output of [`to_json`](Self::to_json).
    pub(crate) fn from_json(text: &str) -> Self {
        type Result = (Digest, Known, RunId, StageName);
        fn part<T: serde::de::DeserializeOwned>(stored: &mut serde_json::Value, name: &str) -> T {
            serde_json::from_value(stored[name].take()).unwrap_or_else(|error| panic!("`{name}`: {error}"))
        }
        let mut stored: serde_json::Value = serde_json::from_str(text).expect("JSON");
        let results = part::<Vec<Result>>(&mut stored, "results").into_iter();
        let checkpoints = part::<Vec<(TaskId, u64, Digest)>>(&mut stored, "checkpoints").into_iter();
        Self {
            recovery: Recovery {
                snapshot: part(&mut stored, "snapshot"),
                parts: part(&mut stored, "parts"),
                facts: part(&mut stored, "facts"),
            },
            fences: part(&mut stored, "fences"),
            results: results.map(|(key, known, run, stage)| (key, (known, run, stage))).collect(),
            runs: part(&mut stored, "runs"),
            keys: part(&mut stored, "keys"),
            ended: part(&mut stored, "ended"),
            executions: part(&mut stored, "executions"),
            shards: part(&mut stored, "shards"),
            accepted: part(&mut stored, "accepted"),
            checkpoints: checkpoints.map(|(task, step, digest)| ((task, step), digest)).collect(),
            ..Self::default()
        }
    }

    /// The archived state of an ended run.
    pub(crate) fn archived(&self, run: &RunId) -> Option<Box<Run>> {
        let (_, archive) = self.ended.get(run)?;
        Some(Box::new(serde_json::from_str(archive).expect("a run")))
    }

    pub(crate) fn view(&self, run: &RunId) -> Option<RunView> {
        let (view, _) = self.ended.get(run)?;
        Some(serde_json::from_str(view).expect("a view"))
    }
}
