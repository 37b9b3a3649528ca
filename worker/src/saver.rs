//! Saves of checkpoints while the training continues.
//!
//! The stage's files are copied: small ones in memory, others to unnamed files on disk. A thread uploads the copies and
//! commits the checkpoint. One save runs at a time. It ends early if the grant ends or another member leads the gang.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use checkpoint::Blob;
use protocol::message::CommitCheckpoint;
use protocol::proof::Vouched;
use protocol::{Digest, Generation, Manifest};
use stages::context::{Checkpoint, ContextError};

use crate::active_assignment::ActiveAssignment;
use crate::blobs::HttpBlobs;
use crate::client::{CallError, Client};
use crate::errors::{blob_error, given_up};
use crate::failpoints;
use crate::gang::mesh::Halt;
use crate::retry::{self, GaveUp};
use crate::stage_log;
use crate::telemetry_buffer::{Mark, TelemetryBuffer};

/// Result of a save: its step.
type Saved = Result<u64, ContextError>;

/// The saves of one attempt.
#[derive(Debug, Default)]
pub(crate) struct Saver {
    running: Option<JoinHandle<Saved>>,
    ended: Option<Saved>,
}

impl Saver {
    /// Begins a save after the one that runs has ended.
    pub(crate) fn begin(&mut self, save: Save<'static>) -> Result<(), ContextError> {
        self.wait();
        let span = tracing::Span::current();
        let thread = thread::Builder::new().name("save".to_owned()).spawn(move || span.in_scope(|| save.run()));
        let thread = thread.map_err(|error| ContextError::Unavailable(format!("no thread for the save: {error}")))?;
        self.running = Some(thread);
        Ok(())
    }

    /// Makes a save while the stage waits, because its files could not be copied.
    pub(crate) fn make(&mut self, save: &Save<'_>) {
        self.ended = Some(save.run());
    }

    /// Returns true while a save runs.
    pub(crate) fn is_running(&self) -> bool {
        self.running.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Waits for the save that runs, if there is one.
    pub(crate) fn wait(&mut self) {
        let Some(thread) = self.running.take() else { return };
        let panicked = |_| Err(ContextError::Fault("the thread that saves a checkpoint has panicked".to_owned()));
        self.ended = Some(thread.join().unwrap_or_else(panicked));
    }

    /// Takes the result of a save that has ended.
    pub(crate) fn take(&mut self) -> Option<Saved> {
        if !self.is_running() {
            self.wait();
        }
        self.ended.take()
    }
}

impl Drop for Saver {
    /// Nothing is written under the grant once the attempt is over.
    fn drop(&mut self) {
        self.wait();
    }
}

/// A save with all that its thread needs.
#[derive(Debug)]
pub(crate) struct Save<'a> {
    pub(crate) checkpoint: Checkpoint,
    /// Copies of the files, by name, or the stage's own.
    pub(crate) files: Vec<(String, Box<dyn Blob + 'a>)>,
    /// The generation that the stage has met, in a gang.
    pub(crate) met: Option<Generation>,
    /// The recorded values and lines before the save.
    pub(crate) recorded: Mark,
    pub(crate) held: Arc<ActiveAssignment>,
    pub(crate) client: Client,
    pub(crate) blobs: Arc<HttpBlobs>,
    pub(crate) telemetry: Arc<TelemetryBuffer>,
}

impl Save<'_> {
    fn run(&self) -> Saved {
        let Self { checkpoint, held, .. } = self;
        held.set_postponable(checkpoint.may_wait);
        let saved = self.upload().and_then(|manifest| self.commit(&manifest));
        held.set_postponable(false);
        if let Err(ContextError::Unavailable(why)) = &saved
            && held.is_put_off()
        {
            self.telemetry.log(&format!("the checkpoint after step {} is delayed: {why}", checkpoint.step));
        }
        saved.map(|()| checkpoint.step)
    }

    fn upload(&self) -> Result<Manifest, ContextError> {
        let files = self.files.iter().map(|(name, copy)| (name.as_str(), &**copy));
        self.checkpoint.upload(&*self.blobs, files).map_err(blob_error)
    }

    fn commit(&self, manifest: &Manifest) -> Result<(), ContextError> {
        let Self { checkpoint, held, .. } = self;
        self.telemetry.flush(self.recorded).map_err(given_up)?;
        let digest: Digest = self.blobs.put_manifest(manifest).map_err(blob_error)?;
        let step = checkpoint.step;
        let finite = checkpoint.metrics.iter().filter(|(_, value)| value.is_finite());
        let metrics: BTreeMap<String, f64> = finite.map(|(name, value)| (name.clone(), *value)).collect();
        let receipts = self.blobs.receipts.for_manifest(digest);
        failpoints::hit("checkpoint::before_commit");
        retry::until_put_off(held, &format!("committing the checkpoint of step {step}"), |credential| {
            if self.met.is_some() && !held.leads() {
                return Err(CallError::NoLongerLeads("another member leads the gang now".to_owned()));
            }
            let grant = credential.grant.clone();
            let commit = CommitCheckpoint { grant, step, manifest: digest, metrics: metrics.clone() };
            let vouched = Vouched { what: commit, receipts: receipts.clone() };
            self.client.wait(self.client.tell("/v1/checkpoints", credential, &vouched))
        })
        .map_err(|gave_up| match gave_up {
            // The next leader has saved a later step.
            GaveUp::Answer(CallError::Refused(why)) if self.is_regrouped() => ContextError::NoLongerLeads(why),
            gave_up => given_up(gave_up),
        })?;
        failpoints::hit("checkpoint::after_commit");
        held.committed(digest);
        self.telemetry.log(&stage_log::checkpoint(step, manifest, &metrics));
        Ok(())
    }

    /// Returns true if the gang has a newer generation than at the beginning of the save.
    fn is_regrouped(&self) -> bool {
        self.met.is_some_and(|met| matches!(self.held.halt(met), Some(Halt::Regroup)))
    }
}
