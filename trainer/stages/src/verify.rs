//! Re-runs steps of a training stage from a committed checkpoint and keeps what came out, to be compared with what was
//! stored when the stage ran.
//!
//! The whole gang is this thread: a sum along the fixed tree does not depend on who computed its leaves. What is computed is
//! written to memory only; the store is read and never changed.

use std::collections::{BTreeMap, HashMap};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use burn::tensor::Device;
use checkpoint::{BlobError, Blobs};
use protocol::message::StageTask;
use protocol::{Digest, Manifest};

use crate::context::{Adopted, AttemptContext, ContextError, Exchange, GangContext, Outcome, Rendezvous, StageError};
use crate::kinds;
use crate::train::{STATE_FILE, tree_sum};

/// What re-run steps gave.
#[derive(Debug, Clone)]
pub struct Rerun {
    /// Steps of the state it began from.
    pub from: u64,
    /// Steps of the state it ended with.
    pub to: u64,
    /// What was recorded on the way: step and name, value.
    pub values: BTreeMap<(u64, String), f64>,
    /// The digest of the whole training state after a step, wherever one was saved.
    pub states: BTreeMap<u64, Digest>,
    /// The stage's output, if it came to its end.
    pub output: Option<Digest>,
}

/// The digest of a checkpoint's training state. Its manifest says besides by which build on which processor it was made.
pub fn state_digest(checkpoint: &Manifest) -> Option<Digest> {
    checkpoint.files.get(STATE_FILE).map(|entry| entry.digest)
}

/// Runs `task` from `checkpoint` (from nothing if there is none) until `until` steps are applied, or to its end.
///
/// # Errors
/// Whatever the stage says no with.
pub fn rerun(
    task: StageTask,
    device: Device,
    blobs: Arc<dyn Blobs>,
    checkpoint: Option<Manifest>,
    until: u64,
) -> Result<Rerun, StageError> {
    let from = checkpoint.as_ref().and_then(|manifest| manifest.meta["step"].as_u64()).unwrap_or(0);
    let over = Arc::new(Overlay { below: blobs, above: Mutex::default() });
    let mut cx =
        Solo { task, device, blobs: over, checkpoint, until, values: BTreeMap::new(), states: BTreeMap::new() };
    let outcome = kinds::run_gang(&mut cx)?;
    let (to, output) = match outcome {
        Outcome::Yielded { at } => (at, None),
        Outcome::Finished { output, .. } => (cx.states.keys().next_back().copied().unwrap_or(from), Some(output)),
    };
    Ok(Rerun { from, to, values: cx.values, states: cx.states, output })
}

/// A store below, and what was put since in memory.
#[derive(Debug)]
struct Overlay {
    below: Arc<dyn Blobs>,
    above: Mutex<HashMap<Digest, Arc<[u8]>>>,
}

impl Blobs for Overlay {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        let found = self.above.lock().unwrap_or_else(PoisonError::into_inner).get(&digest).cloned();
        found.map_or_else(|| self.below.get(digest), Ok)
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        let digest = Digest::of(&bytes);
        self.above.lock().unwrap_or_else(PoisonError::into_inner).insert(digest, bytes.into());
        Ok(digest)
    }
}

/// A gang of one that is nobody's worker.
#[derive(Debug)]
struct Solo {
    task: StageTask,
    device: Device,
    blobs: Arc<Overlay>,
    checkpoint: Option<Manifest>,
    until: u64,
    values: BTreeMap<(u64, String), f64>,
    states: BTreeMap<u64, Digest>,
}

impl AttemptContext for Solo {
    fn task(&self) -> &StageTask {
        &self.task
    }
    fn device(&self) -> Device {
        self.device.clone()
    }
    fn blobs(&self) -> Arc<dyn Blobs> {
        Arc::clone(&self.blobs) as Arc<dyn Blobs>
    }
    fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        let bytes = self.blobs.get(digest).map_err(|e| ContextError::Corrupt(e.to_string()))?;
        serde_json::from_slice(&bytes).map_err(|e| ContextError::Corrupt(format!("{digest} is not a manifest: {e}")))
    }
    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError> {
        self.blobs.put(manifest.to_bytes()).map_err(|e| ContextError::Storage(e.to_string()))
    }
    fn progress(&mut self, _: u64, _: u64, _: &str, _: &[(&str, f64)]) {}
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

    fn exchange(&mut self, step: u64, _: usize, parts: &[(usize, Vec<f32>)]) -> Result<Exchange, ContextError> {
        let parts: Vec<Vec<f32>> = parts.iter().map(|(_, part)| part.clone()).collect();
        Ok(Exchange::Sum { sum: tree_sum(&parts), drain: step + 1 >= self.until })
    }

    fn hold(&mut self) -> Result<(), ContextError> {
        Err(ContextError::Unavailable("one member alone has nobody to wait for".to_owned()))
    }

    fn leads(&self) -> bool {
        true
    }

    fn commit_checkpoint(
        &mut self,
        step: u64,
        manifest: &Manifest,
        _: &BTreeMap<String, f64>,
    ) -> Result<(), ContextError> {
        self.states.extend(state_digest(manifest).map(|digest| (step, digest)));
        Ok(())
    }
}
