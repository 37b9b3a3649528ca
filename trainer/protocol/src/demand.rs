//! The demand for workers, which launchers follow: `GET /v1/demand`.
//!
//! It has numbers and names of workers only, so that a launcher's token reveals no run.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::Backend;
use crate::{Labels, WorkerId};

/// Work that waits for workers, and the workers that there are.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Demand {
    /// Changes with the groups and the workers, but not with times.
    pub version: u64,
    /// Time for which the caller is the launcher for its labels, in milliseconds; 0 if another one is, or if the call
    /// names no launcher.
    pub lead_ms: u64,
    pub groups: Vec<DemandGroup>,
    pub workers: Vec<DemandWorker>,
}

/// Open work that needs the same kind of worker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct DemandGroup {
    /// Backend that computes it.
    pub backend: Backend,
    /// Labels that each worker must have.
    pub requires: Labels,
    /// Instruction set that each worker must have, because of earlier work.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instruction_set: Option<String>,
    /// Slots that further workers could fill now.
    pub ready: u64,
    /// Workers that the work can occupy in all: those at work and the ready slots.
    pub wanted: u64,
    /// Idle workers that fit.
    pub idle: u64,
    /// The longest time that a stage without any worker has waited, in milliseconds.
    pub oldest_wait_ms: u64,
}

/// A worker that polls.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct DemandWorker {
    pub worker: WorkerId,
    pub backend: Backend,
    /// Instruction set that its kernels use.
    pub instruction_set: String,
    pub labels: Labels,
    /// True if it holds no task.
    pub idle: bool,
}

impl DemandGroup {
    /// Returns true if a worker that is yet to be started could take this work.
    pub fn takes(&self, backend: Backend, labels: &Labels) -> bool {
        self.backend == backend && labels.have(&self.requires)
    }

    /// Returns true if a worker could take this work.
    pub fn takes_worker(&self, worker: &DemandWorker) -> bool {
        let set = self.instruction_set.as_ref();
        self.takes(worker.backend, &worker.labels) && set.is_none_or(|set| worker.instruction_set == *set)
    }
}
