//! What happens to the coordinator, and what it wants done about it.
//!
//! An [`Event`] is decided once and never again: what is kept are the facts that came of it ([`Fact`](crate::Fact)). What a worker
//! merely says (a poll, a tick of the clock) is an [`Observation`]; [`observe`](crate::observe) turns it into events when
//! it means something, so that heartbeats cost no disk write.

use protocol::message::{CommitCheckpoint, Join, Poll, ReportOutcome, TaskOutcome};
use protocol::pipeline::Pipeline;
use protocol::stage::Keep;
use protocol::{Alias, Digest, Fence, Incarnation, Owner, RunId, StageName, TaskId, WorkerId};
use registry::Write;

use crate::state::execution::StageExecution;
use crate::state::run::{Control, Run};
use crate::state::worker::Identity;
use crate::value::{Candidate, Known};

/// Something that happened, or that somebody asks for.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The coordinator started. Every lease gets one interval of grace.
    Started {
        /// No worker of before can reach this coordinator: all are gone for certain.
        alone: bool,
        /// Runs that were under way are paused until somebody asks for them.
        park: bool,
    },
    /// A client submitted a pipeline.
    Submit {
        pipeline: Box<Pipeline>,
        /// The YAML as written.
        source: String,
        /// Submitting twice with one key gives one run.
        idempotency_key: Option<String>,
        /// Stop after this stage.
        until: Option<StageName>,
        /// The token that submitted it.
        owner: Owner,
    },
    /// A worker process offered itself.
    Join {
        /// What it said.
        join: Join,
        /// Whose word it is.
        by: Identity,
    },
    /// A worker that had lost its lease, or that had to leave a gang some time ago, was heard again.
    WorkerBack {
        /// Who.
        worker: WorkerId,
    },
    /// A worker has what it needs for tasks that it may be given.
    WorkerReady {
        /// Who.
        worker: WorkerId,
        /// Which process.
        incarnation: Incarnation,
        /// Which tasks, all of them.
        tasks: Vec<TaskId>,
    },
    /// A worker was not heard of for the length of its lease.
    LeaseExpired {
        /// Who.
        worker: WorkerId,
        /// Which process.
        incarnation: Incarnation,
    },
    /// The process has ended: certain, unlike an expired lease.
    WorkerGone {
        /// Who.
        worker: WorkerId,
        /// Which process said so of itself. `None` is the word of the launcher, which saw the newest one exit.
        incarnation: Option<Incarnation>,
    },
    /// Members of a gang complain of each other, as [`Heard::words`](crate::state::Heard::words) says.
    GangDivided {
        task: TaskId,
        /// The generation.
        fence: Fence,
    },
    /// No member of a gang has had a step more for too long.
    GangStalled {
        task: TaskId,
        /// The generation.
        fence: Fence,
    },
    /// A checkpoint was uploaded and shall count.
    Checkpoint {
        /// Which.
        commit: CommitCheckpoint,
    },
    /// An assignment ended.
    Outcome {
        /// How.
        report: ReportOutcome,
    },
    /// A client asked something of a run.
    Control {
        /// Which.
        run: RunId,
        /// What.
        action: Control,
        /// The run as it was archived when it ended, for one that is not in memory.
        archived: Option<Box<Run>>,
    },
    /// A worker has not been heard of for so long that nothing is lost with its name.
    WorkerForgotten {
        /// Who.
        worker: WorkerId,
        /// Which process.
        incarnation: Incarnation,
    },
    /// The coordinator is about to stop: workers save and leave.
    Drain,
    /// A back-off ended.
    BackoffOver {
        /// Whose.
        task: TaskId,
    },
    /// A worker that was asked to drain did not within the grace period.
    GraceOver {
        /// Of which task.
        task: TaskId,
        /// Under which fence.
        fence: Fence,
    },
    /// The answer to [`Effect::Lookup`].
    LookedUp {
        /// The stage's key.
        key: Digest,
        /// Its value, if the store has it.
        known: Option<Known>,
        /// Under whose names the value's logs and metrics are stored, if there is a value.
        source: Option<(RunId, StageName)>,
        /// What an earlier try has left, if there is no value.
        archived: Option<Box<StageExecution>>,
    },
    /// The answer to [`Effect::Register`]: the model bundles are stored.
    Bundled {
        /// The register stage's key.
        key: Digest,
        /// One for each candidate, in order.
        bundles: Vec<Digest>,
    },
    /// A register stage was refused: a bundle that cannot be made, or a gate that does not hold.
    RegisterRefused {
        key: Digest,
        /// Why, for the user.
        message: String,
    },
}

impl Event {
    /// The artifacts that rows are to name because of it. They are proven whole before it is decided.
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
            | Self::LeaseExpired { .. }
            | Self::WorkerGone { .. }
            | Self::GangDivided { .. }
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

/// What was merely heard.
#[derive(Debug, Clone, PartialEq)]
pub enum Observation {
    /// A worker polled.
    Poll {
        /// Who.
        worker: WorkerId,
        /// What it said.
        poll: Poll,
    },
    /// The clock was looked at.
    Tick {
        /// How much later than it meant to, in milliseconds: then this whole process did not run and heard nobody. A wait
        /// for the disk is not part of it, for polls are heard meanwhile.
        overslept: u64,
    },
}

/// What is to be done about an event.
#[derive(Debug, Clone, PartialEq)]
pub enum Effect {
    /// One transaction. It comes before all other effects, and if it is refused the event has not happened.
    Store(Vec<Write>),
    /// Ask the store for a stage's value and answer with [`Event::LookedUp`].
    Lookup {
        /// The stage's key.
        key: Digest,
    },
    /// Give each candidate its sampler and parts and answer with [`Event::Bundled`] or [`Event::RegisterRefused`].
    Register {
        /// The register stage's key.
        key: Digest,
        /// In the order of the stage's `from`.
        candidates: Vec<Candidate>,
        /// The alias that moves with it.
        promotes: Option<Alias>,
        /// On whose behalf.
        owner: Owner,
    },
    /// Forget a task's checkpoints but those to keep. Never before the newer one is stored.
    Prune {
        task: TaskId,
        /// Which stay.
        keep: Keep,
    },
    /// Which run a submission gave.
    Submitted(RunId),
    /// Which process a joining worker is.
    Joined(Incarnation),
    /// Somebody's desired assignments or a run's state may have changed: waiting polls look again.
    Wake,
}
