//! A world in memory for tests: blobs, attempts, and gangs of threads that lose and gain members on cue.
//!
//! What it promises is what [`context`](crate::context) promises, no more: sums along the fixed tree, one leader, verified
//! blobs. Not its job: fences, leases, networks; the worker's own tests cover those.

mod gang;

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use burn::tensor::Device;
use checkpoint::{BlobError, Blobs};
use protocol::message::StageTask;
use protocol::stage::{CheckpointPolicy, Shape, StageSettings};
use protocol::{Digest, Manifest, RunId, Seed, StageName};

use crate::context::{AttemptContext, ContextError, Outcome, Part, StageError};
use crate::kinds;

pub use crate::train::tree_sum;
pub use gang::{Body, Script};

/// Locks, whether or not another thread panicked while it held the lock: the panic is reported where it happened.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Blobs in memory.
#[derive(Debug, Default)]
pub struct MemoryBlobs {
    blobs: Mutex<HashMap<Digest, Arc<[u8]>>>,
}

impl MemoryBlobs {
    /// Bytes of all blobs together.
    pub fn total_bytes(&self) -> usize {
        lock(&self.blobs).values().map(|b| b.len()).sum()
    }
}

impl Blobs for MemoryBlobs {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        lock(&self.blobs).get(&digest).cloned().ok_or(BlobError::NotFound(digest))
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        let digest = Digest::of(&bytes);
        lock(&self.blobs).entry(digest).or_insert_with(|| bytes.into());
        Ok(digest)
    }
}

/// What an attempt told the world.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Told {
    /// Log lines.
    pub log: Vec<String>,
    /// Values by step: step, name, value.
    pub records: Vec<(u64, String, f64)>,
    /// The last progress: done, total, unit.
    pub progress: Option<(u64, u64, String)>,
}

/// An attempt whose world is memory.
#[derive(Debug)]
pub struct MemoryAttempt {
    task: StageTask,
    device: Device,
    blobs: Arc<MemoryBlobs>,
    stop: Arc<AtomicBool>,
    /// What it was told.
    pub told: Told,
}

impl MemoryAttempt {
    /// An attempt at `task` that computes on `device`.
    pub fn new(task: StageTask, device: Device, blobs: Arc<MemoryBlobs>) -> Self {
        Self { task, device, blobs, stop: Arc::default(), told: Told::default() }
    }

    /// Makes [`AttemptContext::interrupted`] true once set.
    pub fn stop_switch(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.stop)
    }
}

impl AttemptContext for MemoryAttempt {
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
        serde_json::from_slice(&bytes).map_err(|e| ContextError::Corrupt(format!("manifest {digest}: {e}")))
    }

    fn put_manifest(&mut self, manifest: &Manifest) -> Result<Digest, ContextError> {
        for (name, entry) in &manifest.files {
            let blob = self.blobs.get(entry.digest);
            let blob = blob.map_err(|e| ContextError::Corrupt(format!("file `{name}` of a manifest: {e}")))?;
            if blob.len() as u64 != entry.bytes {
                return Err(ContextError::Corrupt(format!(
                    "file `{name}` has {} bytes, its manifest says {}",
                    blob.len(),
                    entry.bytes
                )));
            }
        }
        self.blobs.put(manifest.to_bytes()).map_err(|e| ContextError::Storage(e.to_string()))
    }

    fn progress(&mut self, done: u64, total: u64, unit: &str, _metrics: &[(&str, f64)]) {
        self.told.progress = Some((done, total, unit.to_owned()));
    }

    fn record(&mut self, step: u64, metrics: &[(&str, f64)]) {
        self.told.records.extend(metrics.iter().map(|(name, value)| (step, (*name).to_owned(), *value)));
    }

    fn log(&mut self, line: &str) {
        self.told.log.push(line.to_owned());
    }

    fn interrupted(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// What a stage gave.
#[derive(Debug, Clone)]
pub struct Ran {
    /// How it ended.
    pub outcome: Outcome,
    /// What it told: of a map stage its merge, of a gang its last leader.
    pub told: Told,
}

impl Ran {
    /// The output's manifest.
    ///
    /// # Panics
    /// If the stage yielded.
    pub fn output(&self) -> Digest {
        match &self.outcome {
            Outcome::Finished { output, .. } => *output,
            Outcome::Yielded { at } => panic!("the stage yielded at step {at}"),
        }
    }

    /// The final values.
    ///
    /// # Panics
    /// If the stage yielded.
    pub fn metrics(&self) -> &BTreeMap<String, f64> {
        match &self.outcome {
            Outcome::Finished { metrics, .. } => metrics,
            Outcome::Yielded { at } => panic!("the stage yielded at step {at}"),
        }
    }
}

/// Runs stages one after the other, with what they make kept in memory.
#[derive(Debug)]
pub struct Bench {
    device: Device,
    seed: Seed,
    blobs: Arc<MemoryBlobs>,
    checkpoints: BTreeMap<String, Vec<(u64, Manifest)>>,
    /// Cadence handed to gang stages.
    pub checkpoint: CheckpointPolicy,
    /// Members of a gang.
    pub members: usize,
    /// Who leaves or joins a gang, and when.
    pub script: Script,
}

impl Bench {
    /// An empty world in which `members` threads make up a gang.
    pub fn new(device: Device, seed: u64, members: usize) -> Self {
        Self {
            device,
            seed: Seed(seed),
            blobs: Arc::default(),
            checkpoints: BTreeMap::new(),
            checkpoint: CheckpointPolicy::default(),
            members,
            script: Script::default(),
        }
    }

    /// The blobs of this world.
    pub fn blobs(&self) -> Arc<MemoryBlobs> {
        Arc::clone(&self.blobs)
    }

    /// The device of this world.
    pub fn device(&self) -> Device {
        self.device.clone()
    }

    /// Reads a manifest.
    pub fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        let bytes = self.blobs.get(digest).map_err(|e| ContextError::Corrupt(e.to_string()))?;
        serde_json::from_slice(&bytes).map_err(|e| ContextError::Corrupt(e.to_string()))
    }

    /// The steps at which the stage `name` has saved checkpoints.
    pub fn checkpoints(&self, name: &str) -> Vec<u64> {
        self.checkpoints.get(name).into_iter().flatten().map(|(step, _)| *step).collect()
    }

    /// Forgets the checkpoints of the stage `name` after step `last`, as if it had not got further. Returns them.
    pub fn forget_after(&mut self, name: &str, last: u64) -> Vec<(u64, Manifest)> {
        let saved = self.checkpoints.entry(name.to_owned()).or_default();
        let (kept, forgotten) = std::mem::take(saved).into_iter().partition(|(step, _)| *step <= last);
        *saved = kept;
        forgotten
    }

    /// Forgets all checkpoints of the stage `name`: it begins anew.
    pub fn forget(&mut self, name: &str) {
        self.checkpoints.remove(name);
    }

    /// The newest checkpoint of the stage `name`.
    pub fn newest(&self, name: &str) -> Option<&(u64, Manifest)> {
        self.checkpoints.get(name).and_then(|saved| saved.last())
    }

    /// The newest checkpoint of the stage `name`, which is forgotten with all others of it: what a rung of a sweep leaves.
    pub fn take_checkpoint(&mut self, name: &str) -> Option<(u64, Digest)> {
        self.checkpoints.remove(name)?.pop().map(|(step, manifest)| (step, manifest.digest()))
    }

    /// Runs the stage `name` to its end, or until its script stops it. A gang stage continues its newest checkpoint.
    ///
    /// Shards of a map stage run last to first: their order must not matter.
    pub fn run(&mut self, name: &str, settings: &StageSettings, inputs: &[(&str, Digest)]) -> Result<Ran, StageError> {
        let task = self.task(name, settings, inputs);
        let attempt = || MemoryAttempt::new(task.clone(), self.device.clone(), Arc::clone(&self.blobs));
        match settings.shape() {
            Shape::Plain => {
                let mut cx = attempt();
                let outcome = kinds::run_alone(&mut cx)?;
                Ok(Ran { outcome, told: cx.told })
            }
            Shape::Map => {
                let of = settings.shards() as usize;
                let mut shards = Vec::with_capacity(of);
                for index in (0..of).rev() {
                    let outcome = kinds::run_part(&mut attempt(), Part::Shard { index, of })?;
                    shards.push(Ran { outcome, told: Told::default() }.output());
                }
                shards.reverse();
                let mut cx = attempt();
                let outcome = kinds::run_part(&mut cx, Part::Merge { shards })?;
                Ok(Ran { outcome, told: cx.told })
            }
            Shape::Gang => self.run_gang(name, settings, inputs, &kinds::run_gang),
            Shape::Registry => Err(StageError::Fault(format!("`{}` runs in the coordinator", settings.kind()))),
        }
    }

    /// Runs `body` as the gang stage `name`, whatever kind its settings are of: a stage that no kind is yet.
    ///
    /// # Errors
    /// What the last member said no with.
    pub fn run_gang(
        &mut self,
        name: &str,
        settings: &StageSettings,
        inputs: &[(&str, Digest)],
        body: &Body<'_>,
    ) -> Result<Ran, StageError> {
        let task = self.task(name, settings, inputs);
        let attempt = || MemoryAttempt::new(task.clone(), self.device.clone(), Arc::clone(&self.blobs));
        let saved = self.checkpoints.entry(name.to_owned()).or_default();
        gang::run(attempt, self.members, &self.script, saved, body)
    }

    fn task(&self, name: &str, settings: &StageSettings, inputs: &[(&str, Digest)]) -> StageTask {
        StageTask {
            run: RunId::new("test-1"),
            name: StageName::new(name),
            settings: settings.clone(),
            inputs: inputs.iter().map(|(field, digest)| ((*field).to_owned(), *digest)).collect(),
            seed: self.seed,
            checkpoint: self.checkpoint.clone(),
        }
    }
}
