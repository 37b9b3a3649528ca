//! The calls of an engine that a launcher needs, and their errors.

use std::time::Duration;

use async_trait::async_trait;

/// The state of a job as its engine reports it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JobState {
    /// It waits for a machine.
    Pending,
    Running,
    /// It was asked to end.
    Ending,
    /// The engine has ended it: cancelled, preempted, or its machine was lost. Its template is not to blame.
    Revoked,
}

impl JobState {
    /// Returns true if nothing of the job is left to end.
    pub fn has_ended(self) -> bool {
        self == Self::Revoked
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Running => "running",
            Self::Ending => "ending",
            Self::Revoked => "revoked",
        }
    }
}

/// A job, which runs one worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Job {
    /// The worker's name, which is also the job's.
    pub worker: String,
    /// The engine's own name for the job.
    pub id: String,
    pub state: JobState,
}

/// A failed call of an engine.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EngineError {
    #[error("`{program}` did not answer within {} s", limit.as_secs_f64())]
    Hangs { program: String, limit: Duration },
    #[error("cannot start `{program}`: {why}")]
    Missing { program: String, why: String },
    #[error("`{program}` failed: {said}")]
    Refused { program: String, said: String },
    #[error("cannot read the answer of `{program}`: {why}")]
    Answer { program: String, why: String },
    #[error("no reachable machine has a free slot: {0}")]
    NoSlot(String),
}

impl EngineError {
    /// Returns true if a later call may succeed, so that this one says nothing against the job's template.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Hangs { .. } | Self::NoSlot(_) | Self::Answer { .. } => true,
            Self::Missing { .. } | Self::Refused { .. } => false,
        }
    }
}

/// An engine that runs jobs. Every call returns within a bounded time.
#[async_trait]
pub trait Launcher: Send + Sync {
    /// This launcher's jobs, without those that have ended by themselves. An engine may list revoked ones for a while.
    async fn list(&self) -> Result<Vec<Job>, EngineError>;

    /// Submits a job that runs a worker with this name. After an error, the job may exist all the same.
    async fn submit(&self, worker: &str) -> Result<(), EngineError>;

    /// Asks a job to end: its worker saves and leaves. Asking twice is the same as once.
    async fn retire(&self, job: &Job) -> Result<(), EngineError>;

    /// The place of a worker's log, for messages; NAME stands for the worker's name.
    fn log(&self) -> &'static str;

    /// Largest number of jobs that the engine can hold; `None` if only the engine knows.
    fn capacity(&self) -> Option<usize> {
        None
    }
}
