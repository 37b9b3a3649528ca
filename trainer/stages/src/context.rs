//! The interface of a stage to the world.
//!
//! `worker` implements it over HTTP and TCP; tests implement it in memory. A stage owns its thread and is synchronous:
//! it has no clock, environment, network or global generator of its own.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use checkpoint::{Blob, BlobError, Blobs, Joined};
use motion::data_access::DataAccess;
use protocol::message::{FailureClass, StageTask};
use protocol::{ArtifactKind, Digest, Manifest, limits};

use crate::tree::Node;

/// [`GangContext::large`]: 32 MiB.
const LARGE: usize = 8 << 20;

/// An error of the context.
#[derive(Debug, thiserror::Error)]
pub enum ContextError {
    /// This attempt has ended: another holds the grant, or the run was cancelled. Nothing more may be written.
    #[error("the grant of this attempt has ended: {0}")]
    GrantEnded(String),
    /// Another member leads the gang now, and saves in place of this one.
    #[error("{0}")]
    NoLongerLeads(String),
    /// The store or the network failed after retries.
    #[error("{0}")]
    Unavailable(String),
    /// The coordinator or the other members refuse it, and would do so each time.
    #[error("{0}")]
    Refused(String),
    /// The store is full or not writable.
    #[error("{0}")]
    Storage(String),
    /// A stored object is intact but has the wrong contents.
    #[error("{0}")]
    Corrupt(String),
    /// A stored object is damaged or missing.
    #[error("{0}")]
    Damaged(String),
    /// The request contradicts the state of the stage: a fault of ours.
    #[error("{0}")]
    Fault(String),
}

/// An error of a stage. The message does not name the stage; the caller adds the name.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
    /// The user's data or settings; the message names file, line or field, the expected value and the remedy.
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
    /// An error of the context.
    #[error(transparent)]
    Context(#[from] ContextError),
    /// An internal fault.
    #[error("{0}")]
    Fault(String),
    /// The grant has ended or a stop was requested. [`yielded`] turns it into an outcome.
    #[error("the stage was stopped")]
    Interrupted,
}

/// Turns an interrupted attempt into one that yielded at its beginning.
pub fn yielded(result: Result<Outcome, StageError>) -> Result<Outcome, StageError> {
    match result {
        Err(StageError::Interrupted) => Ok(Outcome::Yielded { at: 0 }),
        result => result,
    }
}

impl StageError {
    /// The failure class, which decides about retries.
    pub fn class(&self) -> FailureClass {
        match self {
            Self::Input(_) => FailureClass::Input,
            Self::Diverged { .. } => FailureClass::Diverged,
            Self::Context(ContextError::Refused(_)) => FailureClass::Refused,
            Self::Context(ContextError::Storage(_)) => FailureClass::Storage,
            Self::Context(ContextError::Corrupt(_)) => FailureClass::Storage,
            Self::Context(ContextError::Damaged(_)) => FailureClass::Damaged,
            Self::Fault(_) | Self::Context(ContextError::Fault(_)) => FailureClass::Fault,
            Self::Interrupted
            | Self::Context(
                ContextError::GrantEnded(_) | ContextError::NoLongerLeads(_) | ContextError::Unavailable(_),
            ) => FailureClass::Infrastructure,
        }
    }
}

/// End of an attempt without an error.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The output is uploaded.
    Finished {
        /// Manifest of the output.
        output: Digest,
        /// Final metrics by name.
        metrics: BTreeMap<String, f64>,
    },
    /// Stopped between steps with a checkpoint committed; the next attempt continues from `at`.
    Yielded {
        /// Number of steps applied.
        at: u64,
    },
}

/// Position of a member that joins or rejoins a gang.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rendezvous {
    /// No peer is ahead; continue from your own state.
    Keep,
    /// A peer is ahead, or you have just started; [`GangContext::adopt`] its state.
    Behind,
}

/// Result of adopting a peer's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adopted {
    /// The state is complete.
    Whole,
    /// The members changed during the transfer; call [`GangContext::rendezvous`] again. A member that had a state of
    /// its own still has it. A member that had only initialised itself must not use its state.
    Cut,
}

/// Result of an exchange between members.
#[derive(Debug)]
pub enum Exchange {
    /// The sum over all slices, along the fixed tree.
    Sum {
        /// Element-wise sum.
        sum: Vec<f32>,
        /// Equal for all members: stop after applying it (save, then yield).
        drain: bool,
    },
    /// The membership changed before the sum was complete. Call [`GangContext::rendezvous`], then compute those of your
    /// slices that are not computed yet.
    Regroup,
}

/// The requests that every stage may make.
pub trait AttemptContext {
    /// The settings and inputs of this task.
    fn task(&self) -> &StageTask;
    /// The device to compute on, without autodiff. Training uses its `.autodiff()`.
    fn device(&self) -> burn::tensor::Device;
    /// Access to files outside the store, for [`external::read`](crate::external::read).
    fn data(&self) -> Arc<DataAccess>;
    /// Reads and stages blobs; every blob read is verified against its digest.
    fn blobs(&self) -> Arc<dyn Blobs>;
    /// Reads a manifest by digest.
    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError>;
    /// Uploads a manifest whose blobs are uploaded, and returns its digest.
    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError>;
    /// Reports progress. Never fails, never blocks.
    fn progress(&mut self, done: u64, total: u64, unit: &str, metrics: &[(&str, f64)]);
    /// Records values of a step, exactly once in spite of retries. Never fails, never blocks. Rank 0 only writes.
    fn record(&mut self, step: u64, metrics: &[(&str, f64)]);
    /// Writes a line to the user's log.
    fn log(&mut self, line: &str);
    /// Bytes of the blobs of a long file.
    fn chunk_bytes(&self) -> u64 {
        limits::CHUNK_BYTES
    }
    /// Returns true if the grant has ended or a stop was requested. Long loops without steps check it regularly.
    fn interrupted(&self) -> bool;
}

/// The additional requests of a gang stage.
pub trait GangContext: AttemptContext {
    /// The newest committed checkpoint of this task.
    fn latest_checkpoint(&self) -> Result<Option<Manifest>, ContextError>;

    /// Meets the other members of the current generation. `applied` is the number of steps in the caller's state,
    /// `None` if it has only initialised itself. `state` is its bytes, in pieces, for a peer that needs them.
    fn rendezvous(&mut self, applied: Option<u64>, state: &[&[u8]]) -> Result<Rendezvous, ContextError>;

    /// Follows [`Rendezvous::Behind`]: fills `state`, cut as the caller likes, with the bytes of the peer that is
    /// ahead. A member that had only initialised itself receives them in place, so that a large state is in memory
    /// once.
    fn adopt(&mut self, state: &mut [&mut [u8]]) -> Result<Adopted, ContextError>;

    /// This worker's slices of the coming exchange, a contiguous range of `0..slices`. Only
    /// [`rendezvous`](Self::rendezvous) changes it.
    fn share(&self, slices: usize) -> Range<usize>;

    /// Sums `parts` from all members, along the fixed binary tree over `0..slices`. `parts` are vectors of equal length:
    /// the sums of nodes of this tree that together are this worker's slices, in order. The vectors may be taken if the
    /// result is a sum. `steps` are the updates that the sum makes: one, or those of a round of replicas, which are then
    /// the slices.
    fn exchange(
        &mut self,
        steps: Range<u64>,
        slices: usize,
        parts: &mut [(Node, Vec<f32>)],
    ) -> Result<Exchange, ContextError>;

    /// Number of values from which the results of a slice are large: they are added as soon as both parts of a node of
    /// the tree are there. Smaller ones are kept apart, because a regroup may take some of them to another member.
    fn large(&self) -> usize {
        LARGE
    }

    /// Returns true for rank 0, the only member that saves, records and reports.
    fn leads(&self) -> bool;

    /// Waits with the caller's state in memory while rank 0 saves and reports the last step. Returns after a change of
    /// the members. The caller then calls [`rendezvous`](Self::rendezvous); if it leads now, it makes the last save.
    ///
    /// # Errors
    /// [`ContextError::GrantEnded`] once the report of rank 0 is acknowledged: the work is complete.
    fn hold(&mut self) -> Result<(), ContextError>;

    /// Returns true if a checkpoint could be stored now. A member that keeps its state in memory loses nothing by
    /// saving later. So training does not wait at a due checkpoint for a coordinator that is away.
    fn can_save(&self) -> bool {
        true
    }

    /// Begins to store a checkpoint of the caller's state. Returns once `files`, by name and in pieces, are copied; they
    /// are uploaded and committed while the caller trains on. A save under way is waited for. Rank 0 only.
    fn save(&mut self, checkpoint: Checkpoint, files: &[(&str, &[&[u8]])]) -> Result<(), ContextError>;

    /// The step of the save that has ended since the last call, once the checkpoint is durable. Returns `None` if no save
    /// was begun, or if it is still under way and the caller does not `wait`.
    fn saved(&mut self, wait: bool) -> Option<Result<u64, ContextError>>;
}

/// A checkpoint to be stored, besides its files.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    /// Number of updates in the state.
    pub step: u64,
    /// Meta of its manifest.
    pub meta: serde_json::Value,
    /// Values of the training up to this step, by name.
    pub metrics: BTreeMap<String, f64>,
    /// Bytes of the blobs of a long file.
    pub chunk_bytes: u64,
    /// It may be saved later. If the store is busy, the save fails instead of waiting, and
    /// [`can_save`](GangContext::can_save) returns false for a while.
    pub may_wait: bool,
}

impl Checkpoint {
    /// Uploads the files and returns the manifest, which is not uploaded.
    pub fn upload<'a>(
        &self,
        blobs: &dyn Blobs,
        files: impl Iterator<Item = (&'a str, &'a dyn Blob)>,
    ) -> Result<Manifest, BlobError> {
        let mut manifest = Manifest::new(ArtifactKind::Checkpoint, self.meta.clone());
        for (name, source) in files {
            let file = checkpoint::file::put_copy(blobs, source, self.chunk_bytes)?;
            manifest.list([(name.to_owned(), file)]);
        }
        Ok(manifest)
    }

    /// Like [`upload`](Self::upload), of files in pieces.
    pub fn upload_pieces(&self, blobs: &dyn Blobs, files: &[(&str, &[&[u8]])]) -> Result<Manifest, BlobError> {
        let joined: Vec<_> = files.iter().map(|(name, pieces)| (*name, Joined::new(pieces.to_vec()))).collect();
        self.upload(blobs, joined.iter().map(|(name, file)| (*name, file as &dyn Blob)))
    }
}

/// The part of a map stage that a task computes.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// One shard of the work.
    Shard {
        /// Index of the shard, from 0.
        index: usize,
        /// Number of shards.
        of: usize,
    },
    /// The merge of all shards' artifacts, in order.
    Merge {
        /// Manifests of the shards.
        shards: Vec<Digest>,
    },
}
