//! An in-memory, single-process context for verifying and estimating: a gang of one thread over a read-only store.

use std::collections::{BTreeMap, HashMap};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use burn::tensor::Device;
use checkpoint::{BlobError, Blobs};
use protocol::message::StageTask;
use protocol::{Digest, Manifest};

use super::clock::Clock;
use crate::context::{Adopted, AttemptContext, Checkpoint, ContextError, Exchange, GangContext, Rendezvous};
use crate::external::DataAccess;
use crate::train::STATE_FILE;
use crate::tree::{Node, tree_sum};

/// The digest of a checkpoint's training state. Its manifest also names the build and processor that made it.
pub fn state_digest(checkpoint: &Manifest) -> Option<Digest> {
    checkpoint.files.get(STATE_FILE).map(|entry| entry.digest)
}

/// Blobs in memory over an optional read-only store.
#[derive(Debug, Default)]
pub(crate) struct Overlay {
    below: Option<Arc<dyn Blobs>>,
    above: Mutex<HashMap<Digest, Arc<[u8]>>>,
}

impl Overlay {
    pub(crate) fn over(below: Arc<dyn Blobs>) -> Self {
        Self { below: Some(below), above: Mutex::default() }
    }
}

impl Blobs for Overlay {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        let found = self.above.lock().unwrap_or_else(PoisonError::into_inner).get(&digest).cloned();
        match (found, &self.below) {
            (Some(found), _) => Ok(found),
            (None, Some(below)) => below.get(digest),
            (None, None) => Err(BlobError::NotFound(digest)),
        }
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        let digest = Digest::of(&bytes);
        self.above.lock().unwrap_or_else(PoisonError::into_inner).insert(digest, bytes.into());
        Ok(digest)
    }
}

/// An attempt context for a gang of one.
#[derive(Debug)]
pub(crate) struct Solo {
    task: StageTask,
    device: Device,
    blobs: Arc<Overlay>,
    checkpoint: Option<Manifest>,
    until: u64,
    /// Result of the save that was not asked for yet.
    saved: Option<Result<u64, ContextError>>,
    /// Recorded values by step and name.
    pub(crate) values: BTreeMap<(u64, String), f64>,
    /// Digest of the training state by step, for each saved one.
    pub(crate) states: BTreeMap<u64, Digest>,
    /// The clock of the progress reports.
    pub(crate) clock: Clock,
    /// Readings of the clock at the progress reports.
    pub(crate) progressed: Vec<Duration>,
}

impl Solo {
    /// Creates the context of `task`, to start from `checkpoint`, if there is one, and to stop once `until` steps are
    /// applied.
    pub(crate) fn new(
        task: StageTask,
        device: Device,
        blobs: Arc<Overlay>,
        checkpoint: Option<Manifest>,
        until: u64,
    ) -> Self {
        let values = BTreeMap::new();
        let states = BTreeMap::new();
        let clock = Clock::Wall(Instant::now());
        Self { task, device, blobs, checkpoint, until, saved: None, values, states, clock, progressed: Vec::new() }
    }
}

impl AttemptContext for Solo {
    fn task(&self) -> &StageTask {
        &self.task
    }
    fn device(&self) -> Device {
        self.device.clone()
    }
    fn data(&self) -> Arc<DataAccess> {
        // Its results are compared and not stored.
        Arc::new(DataAccess::unverified())
    }
    fn blobs(&self) -> Arc<dyn Blobs> {
        Arc::clone(&self.blobs) as Arc<dyn Blobs>
    }
    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        let bytes = self.blobs.get(digest).map_err(|e| ContextError::Corrupt(e.to_string()))?;
        serde_json::from_slice(&bytes)
            .map_err(|e| ContextError::Corrupt(format!("cannot parse the manifest {digest}: {e}")))
    }
    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError> {
        self.blobs.put(manifest.to_bytes()).map_err(|e| ContextError::Storage(e.to_string()))
    }
    fn progress(&mut self, _: u64, _: u64, _: &str, _: &[(&str, f64)]) {
        self.progressed.push(self.clock.read());
    }
    fn record(&mut self, step: u64, metrics: &[(&str, f64)]) {
        self.values.extend(metrics.iter().map(|(name, value)| ((step, (*name).to_owned()), *value)));
    }
    fn log(&mut self, _: &str) {}
    fn interrupted(&self) -> bool {
        false
    }
}

impl GangContext for Solo {
    fn latest_checkpoint(&self) -> Result<Option<Manifest>, ContextError> {
        Ok(self.checkpoint.clone())
    }

    fn rendezvous(&mut self, _: Option<u64>, _: &[&[u8]]) -> Result<Rendezvous, ContextError> {
        Ok(Rendezvous::Keep)
    }

    fn adopt(&mut self, _: &mut [&mut [u8]]) -> Result<Adopted, ContextError> {
        Ok(Adopted::Cut)
    }

    fn share(&self, slices: usize) -> Range<usize> {
        0..slices
    }

    fn exchange(
        &mut self,
        steps: Range<u64>,
        slices: usize,
        parts: &mut [(Node, Vec<f32>)],
    ) -> Result<Exchange, ContextError> {
        let parts = parts.iter_mut().map(|(node, part)| (node.clone(), std::mem::take(part)));
        Ok(Exchange::Sum { sum: tree_sum(slices, parts), drain: steps.end >= self.until })
    }

    fn hold(&mut self) -> Result<(), ContextError> {
        Err(ContextError::Unavailable("a gang of one member has no peer to wait for".to_owned()))
    }

    fn leads(&self) -> bool {
        true
    }

    fn save(&mut self, checkpoint: Checkpoint, files: &[(&str, &[&[u8]])]) -> Result<(), ContextError> {
        let stored = checkpoint.upload_pieces(&*self.blobs, files).map_err(|e| ContextError::Storage(e.to_string()));
        self.saved = Some(stored.map(|manifest| {
            self.states.extend(state_digest(&manifest).map(|digest| (checkpoint.step, digest)));
            checkpoint.step
        }));
        Ok(())
    }

    fn saved(&mut self, _: bool) -> Option<Result<u64, ContextError>> {
        self.saved.take()
    }
}
