//! Inputs and effects of decisions.
//!
//! An [`Event`] is decided exactly once; only the resulting facts ([`Fact`](crate::Fact)) are stored. An
//! [`Observation`] is a poll or a tick of the clock. [`observe`](crate::observe) turns it into events only where
//! something follows from it, so that heartbeats cost no disk write.

use std::collections::BTreeMap;
use std::sync::Arc;

use pipeline::Pipeline;
use protocol::message::{CommitCheckpoint, Join, Poll, ReportOutcome, TaskOutcome};
use protocol::stage::Keep;
use protocol::{Alias, Digest, Fence, Group, GroupLimits, Incarnation, Owner, RunId, StageName, TaskId, WorkerId};
use registry::Write;

use crate::state::execution::StageExecution;
use crate::state::run::{Control, Run};
use crate::state::worker::Identity;
use crate::value::{Candidate, Known};

/// An occurrence or a request to decide.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The coordinator started. Every lease gets one interval of grace.
    Started {
        /// No worker of an earlier coordinator can reach this one, so all of them are gone.
        alone: bool,
        /// Pauses active runs until a client resumes them.
        park: bool,
    },
    /// A client submitted a pipeline.
    Submit {
        pipeline: Box<Pipeline>,
        /// The YAML as written.
        source: String,
        /// Submissions with the same key create only one run.
        idempotency_key: Option<String>,
        /// Digest of the submission as it was sent, for an idempotency key.
        submission: Option<Digest>,
        /// The last stage to run.
        until: Option<StageName>,
        /// The owner of the submitting token.
        owner: Owner,
    },
    /// A worker process joined.
    Join {
        join: Join,
        /// The authenticated caller.
        by: Identity,
    },
    /// A worker polled again after its lease had expired or after it had been removed from a gang.
    WorkerBack { worker: WorkerId },
    /// A worker has fetched the inputs of tasks that it may be given.
    WorkerReady {
        worker: WorkerId,
        incarnation: Incarnation,
        /// The complete list of these tasks.
        tasks: Vec<TaskId>,
    },
    /// A worker reports that its process was asked to end.
    WorkerLeaves { worker: WorkerId, incarnation: Incarnation },
    /// A worker did not poll for the length of its lease.
    LeaseExpired { worker: WorkerId, incarnation: Incarnation },
    /// A worker process has ended for certain, unlike after an expired lease.
    WorkerGone {
        worker: WorkerId,
        /// The process that reported its own end. `None` is a report of the launcher, which saw the newest process
        /// exit.
        incarnation: Option<Incarnation>,
    },
    /// Members of a gang complain of each other; see [`Heard::words`](crate::state::Heard::words).
    GangDivided { task: TaskId, fence: Fence },
    /// A stage that work has begun on made no progress for long. It is only noted.
    Quiet {
        key: Digest,
        /// The time without progress. Milliseconds.
        for_ms: u64,
    },
    /// Waiting work should get a worker that is busy, or an idle worker is no longer kept for a group.
    Unshared,
    /// The limits of groups changed.
    Limits { limits: Arc<BTreeMap<Group, GroupLimits>> },
    /// No member of a gang has advanced by a step for too long.
    GangStalled { task: TaskId, fence: Fence },
    /// A checkpoint was uploaded and is to be committed.
    Checkpoint { commit: CommitCheckpoint },
    /// An assignment ended.
    Outcome { report: ReportOutcome },
    /// A client controls a run.
    Control {
        run: RunId,
        action: Control,
        /// The archived run, if it has ended and is not in memory.
        archived: Option<Box<Run>>,
    },
    /// A worker has been silent so long that its name can be forgotten.
    WorkerForgotten { worker: WorkerId, incarnation: Incarnation },
    /// The coordinator is about to stop: workers save their work and leave.
    Drain,
    /// A back-off ended.
    BackoffOver { task: TaskId },
    /// A worker did not drain within the grace period.
    GraceOver {
        task: TaskId,
        /// The fence of the draining grant.
        fence: Fence,
    },
    /// The answer to [`Effect::Lookup`].
    LookedUp {
        key: Digest,
        /// The stage's value, if stored.
        known: Option<Known>,
        /// The run and stage under which the value's logs and metrics are stored.
        source: Option<(RunId, StageName)>,
        /// State of an earlier try, if there is no value.
        archived: Option<Box<StageExecution>>,
    },
    /// The answer to [`Effect::Register`]: the model bundles are stored.
    Bundled {
        key: Digest,
        /// Bundles in the order of the candidates.
        bundles: Vec<Digest>,
    },
    /// A register stage failed: a bundle cannot be made, or a gate does not hold.
    RegisterRefused {
        key: Digest,
        /// The reason, as text for the user.
        message: String,
    },
}

impl Event {
    /// Artifacts that the resulting rows will name. Each is verified as complete before the decision.
    pub(crate) fn artifacts(&self) -> Vec<Digest> {
        match self {
            Self::Checkpoint { commit } => vec![commit.manifest],
            Self::Outcome { report } => match report.outcome {
                TaskOutcome::Finished { output, .. } => vec![output],
                TaskOutcome::Resolved { .. } | TaskOutcome::Yielded { .. } | TaskOutcome::Failed { .. } => Vec::new(),
            },
            Self::Bundled { bundles, .. } => bundles.clone(),
            Self::Started { .. }
            | Self::Submit { .. }
            | Self::Join { .. }
            | Self::WorkerBack { .. }
            | Self::WorkerReady { .. }
            | Self::WorkerLeaves { .. }
            | Self::LeaseExpired { .. }
            | Self::WorkerGone { .. }
            | Self::GangDivided { .. }
            | Self::Quiet { .. }
            | Self::Unshared
            | Self::Limits { .. }
            | Self::GangStalled { .. }
            | Self::Control { .. }
            | Self::WorkerForgotten { .. }
            | Self::Drain
            | Self::BackoffOver { .. }
            | Self::GraceOver { .. }
            | Self::LookedUp { .. }
            | Self::RegisterRefused { .. } => Vec::new(),
        }
    }
}

/// Input that changes the state only if something follows from it.
#[derive(Debug, Clone, PartialEq)]
pub enum Observation {
    /// A worker polled.
    Poll { worker: WorkerId, poll: Poll },
    /// The timer fired.
    Tick {
        /// The timer's delay in milliseconds, a period in which this process did not run and received nothing. A wait
        /// for the disk does not count, because polls are received meanwhile.
        overslept: u64,
    },
}

/// An action that follows from a decision.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect {
    /// One transaction. It precedes all other effects; if the store refuses it, the event did not happen.
    Store(Vec<Write>),
    /// Look up a stage's value in the store and answer with [`Event::LookedUp`].
    Lookup { key: Digest },
    /// Add sampler and parts to each candidate and answer with [`Event::Bundled`] or [`Event::RegisterRefused`].
    Register {
        key: Digest,
        /// Candidates in the order of the stage's `from`.
        candidates: Vec<Candidate>,
        /// The alias to move to the best version.
        promotes: Option<Alias>,
        owner: Owner,
    },
    /// Delete a task's checkpoints except those to keep, after the newer checkpoint or the stage's value is stored.
    Prune {
        task: TaskId,
        keep: Keep,
        /// The stage's value is stored.
        at_end: bool,
    },
    /// The run of a submission.
    Submitted(RunId),
    /// The incarnation of a joining worker.
    Joined(Incarnation),
    /// Assignments or the state of a run may have changed; waiting polls check again.
    Wake,
}
