//! A world in memory for tests: blobs, attempts, and gangs of threads that lose and gain members on cue.
//!
//! What it promises is what [`context`](crate::context) promises, no more: sums along the fixed tree, one leader, verified
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
use protocol::{Digest, Manifest, RunId, Seed, StageName};

use crate::context::{ContextError, Part, StageError};
use crate::kinds;

pub use crate::train::tree_sum;
pub use attempt::{MemoryAttempt, MemoryBlobs, Ran, Told};
pub use gang::{Body, Script};

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
    ///
    /// # Panics
    /// If the stage records or gives what its kind does not say.
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
                let ran = Ran { outcome, told: cx.told };
                // A gate on anything else is refused before a run.
                if let Some(may) = settings.metrics() {
                    let unsaid: Vec<&String> = ran.metrics().keys().filter(|name| !may.contains(*name)).collect();
                    assert!(unsaid.is_empty(), "`{}` gives {unsaid:?}, and does not say so", settings.kind());
                }
                Ok(ran)
            }
            Shape::Gang => {
                let ran = self.run_gang(name, settings, inputs, &kinds::run_gang)?;
                // Keeping checkpoints by anything else is refused before a run.
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
