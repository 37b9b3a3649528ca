//! The work of one stage, by the stage's key: done once however many runs wait for it.
//!
//! | progress \ event | looked up: known | looked up: unknown | all tasks done | bundled | failed for good | wanted again | an input is damaged | inputs are whole |
//! |---|---|---|---|---|---|---|---|---|
//! | Looking | Done | Open or Bundling | - | - | - | Looking | - | - |
//! | Open | - | - | Done | - | Failed | Open | Mending | - |
//! | Mending | - | - | - | - | Failed | Mending | - | Open |
//! | Bundling | - | - | - | Done | Failed | Bundling | - | - |
//! | Done | - | - | - | - | - | Looking | - | - |
//! | Failed | - | - | - | - | - | Looking | - | - |
//!
//! What gave a damaged input is wanted again, and so `Looking`: the store finds what of it is not whole.
//!
//! A run owns its statuses, not the work: cancelling one of two runs that want the same stage does not disturb the other,
//! and a run that is submitted again after a failure finds tasks, checkpoints and the seconds already spent.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use protocol::stage::{Backend, Placement, Shape, StageSettings, WorkerRange};
use protocol::{Attempt, Digest, Fence, RunId, Seed, StageName, TaskId};
use serde::{Deserialize, Serialize};

use super::shared::Set;
use super::task::{Part, Task};
use super::tasks::Tasks;
use super::worker::Worker;
use crate::register::Registration;
use crate::time::Millis;
use crate::value::Known;

/// How far the work is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExecutionState {
    /// The store is asked whether it has the value.
    Looking,
    /// Tasks are to be done.
    Open,
    /// It waits for inputs that a worker found damaged or missing to be made again.
    Mending {
        /// The executions that give them.
        inputs: BTreeSet<Digest>,
    },
    /// The coordinator itself makes the model bundles.
    Bundling,
    /// Done.
    Done {
        /// The value.
        #[serde(with = "super::shared")]
        known: Arc<Known>,
        /// The store had it already.
        cached: bool,
    },
    /// Failed for good, or until somebody wants it again.
    Failed {
        /// Why.
        message: String,
        /// It would fail again wherever it ran: because of its settings and inputs, not of the machines or the store.
        own: bool,
    },
}

/// The work of one stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageExecution {
    /// The stage's key.
    pub key: Digest,
    /// The run that wanted it first; tasks bear its name.
    pub run: RunId,
    pub stage: StageName,
    /// What keys its randomness: its name, but for a trial of a sweep.
    pub keyed_as: StageName,
    /// Its settings, as written.
    pub settings: StageSettings,
    /// Artifacts by the field that names them.
    pub inputs: BTreeMap<String, Digest>,
    pub seed: Seed,
    /// Where it must be computed.
    pub backend: Backend,
    /// It only digests what the settings name outside the store, so that the stage gets a key. No value is stored under its own, which is
    /// that of one stage of one run.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub resolves: bool,
    /// Workers and checkpoints, as the run that wanted it last asks.
    pub placement: Placement,
    /// What a register stage registers.
    pub registration: Option<Registration>,
    /// How far it is.
    pub state: ExecutionState,
    /// Its tasks: none, one, or the shards and their merge.
    pub tasks: Tasks,
    /// Milliseconds of work, up to `busy_since`.
    pub wall_ms: u64,
    /// Set while some task is held.
    pub busy_since: Option<Millis>,
    /// It went on from something that an earlier try had saved.
    pub resumed: bool,
    /// The instruction set of who worked on it last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// Stages of runs in memory that have this key, by run and place: those that came to it while it was in memory itself.
    #[serde(default, skip_serializing_if = "Set::is_empty")]
    pub users: Set<(u64, usize)>,
}

impl StageExecution {
    /// The tasks that it consists of. Their fences begin above `fence`, so that a name that was used before and forgotten never bears a
    /// fence again that somebody may still hold.
    pub fn new_tasks(&self, fence: Fence) -> Vec<Task> {
        if self.resolves {
            let id = TaskId::of_resolving(&self.run, &self.stage);
            return vec![Task { fence, ..Task::new(id, Part::Resolve) }];
        }
        let task = |shard, part| Task { fence, ..Task::new(TaskId::of(&self.run, &self.stage, shard), part) };
        match self.settings.shape() {
            Shape::Plain => vec![task(None, Part::Alone)],
            Shape::Gang => vec![task(None, Part::Gang)],
            Shape::Map => {
                let of = self.settings.shards();
                let mut tasks: Vec<Task> = (0..of).map(|index| task(Some(index), Part::Shard { index, of })).collect();
                tasks.push(task(None, Part::Merge));
                tasks
            }
            Shape::Registry => panic!("a register stage has no tasks: {self:?}"),
        }
    }

    /// Its inputs that are in the store.
    pub fn artifacts(&self) -> BTreeMap<String, Digest> {
        let folders = self.settings.folders();
        let is_stored = |field: &String| folders.iter().all(|folder| folder.field != *field);
        let stored = self.inputs.iter().filter(|(field, _)| is_stored(field));
        stored.map(|(field, digest)| (field.clone(), *digest)).collect()
    }

    /// How many workers may train it together: a member without a slice of the batch would have nothing to do.
    pub fn range(&self) -> WorkerRange {
        let WorkerRange { min, max } = self.placement.workers;
        let Some(training) = self.settings.training() else { return self.placement.workers };
        let slices = training.batch.slices.max(1);
        let max = if max == 0 { slices } else { max.max(min).min(slices) };
        WorkerRange { min: min.min(slices), max }
    }

    /// Whether its gang, if it has one, has as many members as it needs. One that has fewer saves and ends its try.
    pub fn is_enough(&self) -> bool {
        let min = self.range().min.max(1);
        self.tasks.held().all(|i| self.tasks[i].part != Part::Gang || self.tasks[i].holders().len() >= min)
    }

    /// The instruction set that all who work on it must have: that of those who work on it now, or of what an earlier try left.
    pub fn bound_to(&self) -> Option<&str> {
        self.instruction_set.as_deref().filter(|_| self.is_busy() || self.has_something())
    }

    /// Whether a worker may work on it.
    pub fn takes(&self, worker: &Worker) -> bool {
        worker.backend == self.backend && self.bound_to().is_none_or(|set| worker.instruction_set == set)
    }

    /// The shards' artifacts in order, once all are there.
    pub fn shards(&self) -> Option<Vec<Digest>> {
        self.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. })).map(Task::output).collect()
    }

    /// Whether a task can be done now, given that it is free: a merge needs its shards.
    pub fn is_ready(&self, task: &Task) -> bool {
        match task.part {
            // All but the merge itself.
            Part::Merge => self.tasks.open() == 1,
            Part::Alone | Part::Resolve | Part::Gang | Part::Shard { .. } => true,
        }
    }

    /// Returns true if a gang does it.
    pub fn is_gang(&self) -> bool {
        self.tasks.first().is_some_and(|task| task.part == Part::Gang)
    }

    /// Whether somebody works on it.
    pub fn is_busy(&self) -> bool {
        self.state == ExecutionState::Bundling || self.tasks.is_any_held()
    }

    /// Whether it is over, one way or the other.
    pub fn is_over(&self) -> bool {
        match self.state {
            ExecutionState::Done { .. } | ExecutionState::Failed { .. } => true,
            ExecutionState::Looking
            | ExecutionState::Open
            | ExecutionState::Mending { .. }
            | ExecutionState::Bundling => false,
        }
    }

    /// Seconds of work up to `now`.
    pub fn wall_s(&self, now: Millis) -> f64 {
        let running = self.busy_since.map_or(0, |since| now.since(since));
        (self.wall_ms + running) as f64 / 1000.0
    }

    /// The newest try of any task.
    pub fn attempt(&self) -> Attempt {
        self.tasks.iter().map(|task| task.attempt).max().unwrap_or_default()
    }

    /// Whether an earlier try left something to go on from.
    pub fn has_something(&self) -> bool {
        self.tasks.iter().any(|task| task.output().is_some() || task.newest().is_some())
    }
}
