//! The coordinator's complete state. Only facts change it ([`apply`](State::apply)), except for data that need not
//! survive a restart, which `observe` changes.
//!
//! Indexes are derived from the facts as well:
//! - waiting and held tasks of an execution (`tasks::Tasks`);
//! - the task that a worker holds, and the workers without a task;
//! - the runs that use an execution, and the active stages of a run;
//! - the executions that need workers (`queue::Queue`);
//! - the runs that are parked or have an idempotency key, and the running ones of each group.
//!
//! Invariant C14 checks them.
//!
//! Copies share unchanged data (`shared::Map`): a decision on a copy costs only its changes, regardless of the size of
//! the state.
//!
//! Memory has only data that may still matter: runs that have not ended, executions that one of them uses or a worker
//! is busy with, and workers that polled lately. The rest is in the store's tables. Numbers of runs, incarnations and
//! fences come from counters that only grow, so that a forgotten object cannot be mistaken for a new one.

mod apply;
pub mod evidence;
pub mod execution;
pub mod gang;
pub mod group_runs;
mod lookup;
pub mod queue;
mod queueing;
pub mod run;
pub mod shared;
pub mod task;
pub mod tasks;
pub mod worker;

use std::sync::Arc;

use protocol::message::Progress;
use protocol::{Digest, Fence, Group, Incarnation, TaskId, WorkerId};

use self::evidence::Words;
use self::execution::StageExecution;
use self::group_runs::GroupRuns;
use self::queue::{Claimant, Queue};
use self::run::Run;
use self::shared::{Map, Set};
use self::worker::Worker;
use crate::policy::Policy;
use crate::time::Millis;

pub use self::apply::UnknownObject;

/// A worker without a task, while workers are divided.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Idle {
    /// Time of its last task.
    pub since: Millis,
    /// The runs whose share it is, or was last.
    pub kept_for: Option<Claimant>,
}

/// Data from polls. It is lost with the process, which does no harm.
#[derive(Debug, Clone, Default)]
pub struct Heard {
    /// Time of each worker's last poll.
    pub workers: Map<WorkerId, Millis>,
    /// The last reported progress of each task that is its execution's only task.
    pub progress: Map<TaskId, Arc<Progress>>,
    /// The highest reported memory of a worker's process by task, in bytes.
    pub memory: Map<TaskId, u64>,
    /// Times since when workers hold no task, while they are divided.
    pub idle: Map<WorkerId, Idle>,
    /// Times at which runs last let a worker idle that was kept for them.
    pub declined: Map<Claimant, Millis>,
    /// Reports of gang members about their state and about each other. A worker that loses its task also loses its
    /// report.
    pub words: Arc<Words>,
}

/// The coordinator's complete state. A copy is cheap, because it shares the contents of the maps.
#[derive(Debug, Clone, Default)]
pub struct State {
    pub policy: Policy,
    /// The number of decisions so far, which is also the newest decision's number.
    pub seq: u64,
    /// The time of the newest decision.
    pub now: Millis,
    /// The number of runs ever submitted.
    pub submitted: u64,
    /// The newest incarnation of any worker.
    pub incarnation: Incarnation,
    /// The newest fence of any task.
    pub fence: Fence,
    /// Workers by name.
    pub workers: Map<WorkerId, Worker>,
    /// Workers that hold no task.
    pub unused: Set<WorkerId>,
    /// Runs that have not ended, by number, which is the order of submission.
    pub runs: Map<u64, Arc<Run>>,
    /// Executions by the stage's key.
    pub executions: Map<Digest, Arc<StageExecution>>,
    /// The execution of each task, and the task's index in it.
    pub tasks: Map<TaskId, (Digest, usize)>,
    /// Executions that running runs wait for, by their needs.
    pub queue: Queue,
    /// For each recomputed execution, the executions that wait for it.
    pub mends: Map<Digest, Set<Digest>>,
    /// Runs by the client's idempotency key.
    pub idempotent: Map<String, u64>,
    /// Runs that a restart paused.
    pub parked: Set<u64>,
    /// Running runs by group.
    pub groups: Map<Group, GroupRuns>,
    /// Set before a shutdown: no grants, and workers save and leave.
    pub draining: bool,
    pub heard: Heard,
    /// The number of facts recorded since this process started.
    pub recorded: u64,
    /// Gangs that could admit idle workers, which prepare for them. Rebuilt by each decision.
    pub open_gangs: Arc<Vec<(Digest, usize)>>,
    /// The number of runs, executions and workers inspected by decisions; tests use it to measure cost.
    pub visits: u64,
}
