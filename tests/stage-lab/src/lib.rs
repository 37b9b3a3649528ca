//! A world in memory for tests: blobs, attempts, and gangs of threads that lose and gain members by a script.
//!
//! It guarantees exactly what [`stages::context`] guarantees: sums along the fixed tree, one leader, verified
//! blobs. Not its job: fences, leases, networks; the worker's own tests cover those.

mod attempt;
mod gang;
pub mod hostile;
pub mod hostile_models;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use burn::tensor::Device;
use checkpoint::Blobs as _;
use protocol::message::StageTask;
use protocol::stage::{CheckpointPolicy, Shape, StageSettings};
use protocol::{Digest, Manifest, RunId, Seed, StageName, limits};

use stages::context::{ContextError, Part, StageError};
use stages::kinds;

pub use attempt::{MemoryAttempt, MemoryBlobs, Ran, Told};
pub use gang::{Body, Script};

/// Runs stages one after the other, and keeps their outputs in memory.
#[derive(Debug)]
pub struct Bench {
    device: Device,
    seed: Seed,
    blobs: Arc<MemoryBlobs>,
    checkpoints: BTreeMap<String, Vec<(u64, Manifest)>>,
    /// Checkpoint cadence of gang stages.
    pub checkpoint: CheckpointPolicy,
    /// Number of members of a gang.
    pub members: usize,
    /// Losses and joins of members.
    pub script: Script,
    /// Bytes of the blobs of a long file.
    pub chunk_bytes: u64,
    /// Number of values from which the results of a slice are large.
    pub large: Option<usize>,
}

impl Bench {
    /// Creates an empty world in which a gang has `members` threads.
    pub fn new(device: Device, seed: u64, members: usize) -> Self {
        Self {
            device,
            seed: Seed(seed),
            blobs: Arc::default(),
            checkpoints: BTreeMap::new(),
            checkpoint: CheckpointPolicy::default(),
            members,
            script: Script::default(),
            chunk_bytes: limits::CHUNK_BYTES,
            large: None,
        }
    }

    pub fn blobs(&self) -> Arc<MemoryBlobs> {
        Arc::clone(&self.blobs)
    }

    pub fn device(&self) -> Device {
        self.device.clone()
    }

    /// Reads a manifest.
    pub fn manifest(&self, digest: Digest) -> Result<Manifest, ContextError> {
        let bytes = self.blobs.get(digest).map_err(|e| ContextError::Corrupt(e.to_string()))?;
        serde_json::from_slice(&bytes).map_err(|e| ContextError::Corrupt(e.to_string()))
    }

    /// Steps of the saved checkpoints of the stage `name`.
    pub fn checkpoints(&self, name: &str) -> Vec<u64> {
        self.checkpoints.get(name).into_iter().flatten().map(|(step, _)| *step).collect()
    }

    /// Removes the checkpoints of the stage `name` after step `last`, and returns them.
    pub fn forget_after(&mut self, name: &str, last: u64) -> Vec<(u64, Manifest)> {
        let saved = self.checkpoints.entry(name.to_owned()).or_default();
        let (kept, forgotten) = std::mem::take(saved).into_iter().partition(|(step, _)| *step <= last);
        *saved = kept;
        forgotten
    }

    /// Removes all checkpoints of the stage `name`, so that it starts again.
    pub fn forget(&mut self, name: &str) {
        self.checkpoints.remove(name);
    }

    /// The newest checkpoint of the stage `name`.
    pub fn newest(&self, name: &str) -> Option<&(u64, Manifest)> {
        self.checkpoints.get(name).and_then(|saved| saved.last())
    }

    /// Removes all checkpoints of the stage `name` and returns the newest, as at the end of a sweep's rung.
    pub fn take_checkpoint(&mut self, name: &str) -> Option<(u64, Digest)> {
        self.checkpoints.remove(name)?.pop().map(|(step, manifest)| (step, manifest.digest()))
    }

    /// Runs the stage `name` to its end, or until its script stops it. A gang stage continues its newest checkpoint.
    ///
    /// Shards of a map stage run last to first, because their order must not matter.
    ///
    /// # Panics
    /// If the stage records or returns values that its kind does not declare.
    pub fn run(&mut self, name: &str, settings: &StageSettings, inputs: &[(&str, Digest)]) -> Result<Ran, StageError> {
        let task = self.task(name, settings, inputs);
        let attempt = self.attempt(task);
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
                let ran = Ran { outcome, told: cx.told };
                // A gate on any other metric is refused before a run.
                if let Some(may) = settings.metrics() {
                    let unsaid: Vec<&String> = ran.metrics().keys().filter(|name| !may.contains(*name)).collect();
                    assert!(unsaid.is_empty(), "`{}` gives {unsaid:?}, and does not say so", settings.kind());
                }
                Ok(ran)
            }
            Shape::Gang => {
                let ran = self.run_gang(name, settings, inputs, &kinds::run_gang)?;
                // Keeping checkpoints by any other value is refused before a run.
                let recorded: BTreeSet<&str> = ran.told.records.iter().map(|(_, name, _)| name.as_str()).collect();
                let said = BTreeSet::from_iter(settings.recorded());
                assert!(
                    said.is_empty() || recorded.is_empty() || recorded == said,
                    "`{}` records {recorded:?}, and says {said:?}",
                    settings.kind()
                );
                Ok(ran)
            }
            Shape::Registry => Err(StageError::Fault(format!("`{}` runs in the coordinator", settings.kind()))),
        }
    }

    /// Runs `body` as the gang stage `name`, for any kind of its settings, such as a kind that does not exist yet.
    ///
    /// # Errors
    /// The error of the last member.
    pub fn run_gang(
        &mut self,
        name: &str,
        settings: &StageSettings,
        inputs: &[(&str, Digest)],
        body: &Body<'_>,
    ) -> Result<Ran, StageError> {
        let task = self.task(name, settings, inputs);
        let attempt = self.attempt(task);
        let saved = self.checkpoints.entry(name.to_owned()).or_default();
        gang::run(attempt, self.members, &self.script, saved, body)
    }

    /// Creates attempts at `task`.
    fn attempt(&self, task: StageTask) -> impl Fn() -> MemoryAttempt + use<> {
        let device = self.device.clone();
        let blobs = Arc::clone(&self.blobs);
        let (chunk_bytes, large) = (self.chunk_bytes, self.large);
        move || {
            let mut attempt = MemoryAttempt::new(task.clone(), device.clone(), Arc::clone(&blobs));
            (attempt.chunk_bytes, attempt.large) = (chunk_bytes, large);
            attempt
        }
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
