//! The work of one stage, identified by the stage's key and done once for all runs that wait for it.
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
//! The producer of a damaged input is wanted again and so becomes `Looking`: the store checks which of its blobs are
//! intact.
//!
//! A run owns its statuses, not the work. Cancelling one of two runs with the same stage does not disturb the other. A
//! run that is submitted again after a failure finds the tasks, checkpoints and working time of the earlier one.

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

/// The state of an execution.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExecutionState {
    /// A lookup of the value in the store is pending.
    Looking,
    /// Some tasks are not done.
    Open,
    /// The execution waits for the recomputation of damaged or missing inputs.
    Mending {
        /// The executions that produce these inputs.
        inputs: BTreeSet<Digest>,
    },
    /// The coordinator itself makes the model bundles.
    Bundling,
    /// The value is known.
    Done {
        #[serde(with = "super::shared")]
        known: Arc<Known>,
        /// Set if the store already had the value.
        cached: bool,
    },
    /// Failed until a run wants it again.
    Failed {
        /// The reason, as text for the user.
        message: String,
        /// Set if the failure is due to the stage's settings and inputs and would recur on any machine.
        own: bool,
    },
}

/// The work of one stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageExecution {
    pub key: Digest,
    /// The run that wanted it first; the ids of its tasks contain this run's id.
    pub run: RunId,
    pub stage: StageName,
    /// The name that keys its randomness: the stage's own, except for a trial of a sweep.
    pub keyed_as: StageName,
    /// The stage's settings as written.
    pub settings: StageSettings,
    /// Digests of the inputs, by the field that names them.
    pub inputs: BTreeMap<String, Digest>,
    pub seed: Seed,
    /// The backend that computes it.
    pub backend: Backend,
    /// Set if it only digests files that the settings name outside the store, so that the stage gets a key. This
    /// execution's own key belongs to one stage of one run, and no value is stored under it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub resolves: bool,
    /// Number of workers and of checkpoints, from the run that wanted it last.
    pub placement: Placement,
    /// The models to register, for a register stage.
    pub registration: Option<Registration>,
    pub state: ExecutionState,
    /// No task, one task, or the shards and their merge.
    pub tasks: Tasks,
    /// Milliseconds of work before `busy_since`.
    pub wall_ms: u64,
    /// Start of the current period in which workers hold a task; `None` while none does.
    pub busy_since: Option<Millis>,
    /// Start of the current period in which no worker holds a task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub idle_since: Option<Millis>,
    /// Set if it continued from data of an earlier try.
    pub resumed: bool,
    /// The instruction set of the last workers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// Stages of runs in memory that have this key, by run and index. A stage is added if it gets the key while this
    /// execution is in memory.
    #[serde(default, skip_serializing_if = "Set::is_empty")]
    pub users: Set<(u64, usize)>,
}

impl StageExecution {
    /// Creates the tasks. Their fences start above `fence`, because a forgotten task with the same id may have had a
    /// lower fence that a worker still holds.
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

    /// Inputs that are in the store.
    pub fn artifacts(&self) -> BTreeMap<String, Digest> {
        let folders = self.settings.folders();
        let is_stored = |field: &String| folders.iter().all(|folder| folder.field != *field);
        let stored = self.inputs.iter().filter(|(field, _)| is_stored(field));
        stored.map(|(field, digest)| (field.clone(), *digest)).collect()
    }

    /// Number of workers that may train it together, limited by the number of slices or replicas: further members would
    /// have no work.
    pub fn range(&self) -> WorkerRange {
        let WorkerRange { min, max } = self.placement.workers;
        let Some(training) = self.settings.training() else { return self.placement.workers };
        let parts = training.parts().max(1);
        let max = if max == 0 { parts } else { max.max(min).min(parts) };
        WorkerRange { min: min.min(parts), max }
    }

    /// Returns true if it has no gang, or a gang with enough members. A smaller gang saves and ends its attempt.
    pub fn is_enough(&self) -> bool {
        let min = self.range().min.max(1);
        self.tasks.held().all(|i| self.tasks[i].part != Part::Gang || self.tasks[i].holders().len() >= min)
    }

    /// The instruction set that its workers must have: that of its current workers or of data that an earlier try left.
    pub fn bound_to(&self) -> Option<&str> {
        self.instruction_set.as_deref().filter(|_| self.is_busy() || self.has_something())
    }

    /// Returns true if a worker may work on it.
    pub fn takes(&self, worker: &Worker) -> bool {
        worker.backend == self.backend
            && worker.labels.have(&self.placement.requires)
            && self.bound_to().is_none_or(|set| worker.instruction_set == set)
    }

    /// The shards' artifacts in order, once all are done.
    pub fn shards(&self) -> Option<Vec<Digest>> {
        self.tasks.iter().filter(|task| matches!(task.part, Part::Shard { .. })).map(Task::output).collect()
    }

    /// Returns true if a free task can be done now: a merge needs its shards.
    pub fn is_ready(&self, task: &Task) -> bool {
        match task.part {
            // Only the merge is left.
            Part::Merge => self.tasks.open() == 1,
            Part::Alone | Part::Resolve | Part::Gang | Part::Shard { .. } => true,
        }
    }

    /// Returns true if a gang computes it.
    pub fn is_gang(&self) -> bool {
        self.tasks.first().is_some_and(|task| task.part == Part::Gang)
    }

    /// Returns true if a worker or the coordinator is working on it.
    pub fn is_busy(&self) -> bool {
        self.state == ExecutionState::Bundling || self.tasks.is_any_held()
    }

    /// Returns true if it is done or failed.
    pub fn is_over(&self) -> bool {
        match self.state {
            ExecutionState::Done { .. } | ExecutionState::Failed { .. } => true,
            ExecutionState::Looking
            | ExecutionState::Open
            | ExecutionState::Mending { .. }
            | ExecutionState::Bundling => false,
        }
    }

    /// Seconds of work until `now`.
    pub fn wall_s(&self, now: Millis) -> f64 {
        let running = self.busy_since.map_or(0, |since| now.since(since));
        (self.wall_ms + running) as f64 / 1000.0
    }

    /// The highest attempt number of all tasks.
    pub fn attempt(&self) -> Attempt {
        self.tasks.iter().map(|task| task.attempt).max().unwrap_or_default()
    }

    /// Returns true if an earlier attempt left an output or a checkpoint.
    pub fn has_something(&self) -> bool {
        self.tasks.iter().any(|task| task.output().is_some() || task.newest().is_some())
    }
}
