//! What a stage may ask of the world.
//!
//! `worker` implements it over HTTP and TCP; tests implement it in memory. A stage owns its thread and is synchronous:
//! no clock, no environment, no network, no global generator of its own.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use checkpoint::Blobs;
use protocol::message::{FailureClass, StageTask};
use protocol::{Digest, Manifest};

/// Why the world said no.
#[derive(Debug, thiserror::Error)]
pub enum ContextError {
    /// This attempt is over for us: another holds the grant, or the run was cancelled. Nothing more may be written.
    #[error("the grant of this attempt has ended: {0}")]
    GrantEnded(String),
    /// The store or the network failed after retries.
    #[error("{0}")]
    Unavailable(String),
    /// The store is full or not writable.
    #[error("{0}")]
    Storage(String),
    /// A stored object is whole and does not hold what it should.
    #[error("{0}")]
    Corrupt(String),
    /// A stored object is damaged or missing.
    #[error("{0}")]
    Damaged(String),
}

/// Why a stage failed. The message does not name the stage: its caller knows which one it was.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
    /// The user's data or settings; the message names file, line or field, what was expected and what to do.
    #[error("{0}")]
    Input(String),
    /// The loss or the gradient norm is not finite.
    #[error("training diverged at step {step}: loss {loss}, gradient norm {norm}; lower `lr` or lengthen `warmup`")]
    Diverged {
        /// The step whose update was not applied.
        step: u64,
        /// Mean loss of its batch.
        loss: f64,
        /// Global gradient norm before clipping.
        norm: f64,
    },
    /// The world said no.
    #[error(transparent)]
    Context(#[from] ContextError),
    /// A fault of ours.
    #[error("{0}")]
    Fault(String),
}

impl StageError {
    /// What this says about trying again.
    pub fn class(&self) -> FailureClass {
        match self {
            Self::Input(_) => FailureClass::Input,
            Self::Diverged { .. } => FailureClass::Diverged,
            Self::Context(ContextError::Storage(_)) => FailureClass::Storage,
            Self::Context(ContextError::Corrupt(_)) => FailureClass::Storage,
            Self::Context(ContextError::Damaged(_)) => FailureClass::Damaged,
            Self::Context(_) => FailureClass::Infrastructure,
            Self::Fault(_) => FailureClass::Fault,
        }
    }
}

/// How an attempt ended, short of an error.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The output is uploaded.
    Finished {
        /// Its manifest.
        output: Digest,
        /// Final values.
        metrics: BTreeMap<String, f64>,
    },
    /// Stopped between steps with a checkpoint committed; the next attempt continues from `at`.
    Yielded {
        /// Steps applied.
        at: u64,
    },
}

/// What a member of a gang finds when it (re)joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rendezvous {
    /// Nobody is ahead: go on from the state you have.
    Keep,
    /// A peer is ahead, or you have just started: [`GangContext::adopt`] its state.
    Behind,
}

/// What became of taking over a peer's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adopted {
    /// All of it is there.
    Whole,
    /// The members changed meanwhile: [`GangContext::rendezvous`] again. A member that came with a state of its own still has it; what
    /// one that had only initialised itself has now is of no use.
    Cut,
}

/// What an exchange gave.
#[derive(Debug)]
pub enum Exchange {
    /// The sum over all slices of the step, along the fixed tree.
    Sum {
        /// Element-wise sum.
        sum: Vec<f32>,
        /// The same for all members: stop after applying this step (save, then yield).
        drain: bool,
    },
    /// The membership changed before the sum was complete. Call [`GangContext::rendezvous`], then compute what is yours and
    /// was not computed yet.
    Regroup,
}

/// What every stage may ask.
pub trait AttemptContext {
    /// What to do.
    fn task(&self) -> &StageTask;
    /// Where to compute: the plain device. Training takes `.autodiff()` of it.
    fn device(&self) -> burn::tensor::Device;
    /// Reads and stages blobs; every blob read is verified against its digest.
    fn blobs(&self) -> Arc<dyn Blobs>;
    /// Reads a manifest by digest.
    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError>;
    /// Uploads a manifest whose blobs are uploaded, and returns its digest.
    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError>;
    /// Says how far the work is. Never fails, never blocks.
    fn progress(&mut self, done: u64, total: u64, unit: &str, metrics: &[(&str, f64)]);
    /// Records values of a step, exactly once whatever is retried. Never fails, never blocks. Rank 0 only writes.
    fn record(&mut self, step: u64, metrics: &[(&str, f64)]);
    /// A line for the user's log.
    fn log(&mut self, line: &str);
    /// Whether the grant has ended or a stop was asked for; long loops without steps ask now and then.
    fn interrupted(&self) -> bool;
}

/// What a gang stage may ask besides.
pub trait GangContext: AttemptContext {
    /// The newest committed checkpoint of this task.
    fn latest_checkpoint(&self) -> Result<Option<Manifest>, ContextError>;

    /// Meets the other members of the current generation. `applied` is the number of steps in the caller's state, `None`
    /// when it has only initialised itself; `state` is its bytes, piece after piece, for a peer that needs them.
    fn rendezvous(&mut self, applied: Option<u64>, state: &[&[u8]]) -> Result<Rendezvous, ContextError>;

    /// After [`Rendezvous::Behind`]: fills `state`, cut as the caller likes, with the bytes of the peer that is ahead. Those of a member
    /// that had only initialised itself arrive where they belong, so that a large state is in memory once.
    fn adopt(&mut self, state: &mut [&mut [u8]]) -> Result<Adopted, ContextError>;

    /// The slices of the coming step that are this worker's: a contiguous range of `0..slices`. Changes only with
    /// [`rendezvous`](Self::rendezvous).
    fn share(&self, slices: usize) -> Range<usize>;

    /// Sums `parts` over all slices of `step`, no matter which member computed them, along the fixed binary tree over `0..slices`.
    /// `parts` are this worker's slices in order: all vectors of one length.
    fn exchange(&mut self, step: u64, slices: usize, parts: &[(usize, Vec<f32>)]) -> Result<Exchange, ContextError>;

    /// Whether this member is rank 0, which alone saves, records and reports.
    fn leads(&self) -> bool;

    /// Waits with the caller's state in memory while rank 0 saves and reports the last step. Returns once the members have changed:
    /// then [`rendezvous`](Self::rendezvous), and if this member leads now, the last save is its own.
    ///
    /// # Errors
    /// [`ContextError::GrantEnded`] once what rank 0 reported is acknowledged: nothing is left to do.
    fn hold(&mut self) -> Result<(), ContextError>;

    /// Whether a checkpoint could be stored now. A member that keeps its state in memory loses nothing by saving later, so
    /// training does not wait at a due checkpoint for a coordinator that is away.
    fn can_save(&self) -> bool {
        true
    }

    /// Commits an uploaded manifest as the newest checkpoint; returns once it is durable. Rank 0 only.
    fn commit_checkpoint(
        &mut self,
        step: u64,
        manifest: &Manifest,
        metrics: &BTreeMap<String, f64>,
    ) -> Result<(), ContextError>;
}

/// What a map stage's shard or merge is.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// One shard.
    Shard {
        /// Which.
        index: usize,
        /// Of how many.
        of: usize,
    },
    /// All shards' artifacts, in order.
    Merge {
        /// Shard manifests.
        shards: Vec<Digest>,
    },
}
