//! An attempt at a stage with a world in memory, and its results.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use burn::tensor::Device;
use checkpoint::{BlobError, Blobs};
use protocol::message::StageTask;
use protocol::{Digest, Manifest, limits};

use stages::context::{AttemptContext, ContextError, Outcome};
use stages::external::DataAccess;

/// Locks even if another thread panicked with the lock held: the panic is reported where it happened.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Blobs in memory.
#[derive(Debug, Default)]
pub struct MemoryBlobs {
    blobs: Mutex<HashMap<Digest, Arc<[u8]>>>,
}

impl MemoryBlobs {
    /// Total number of bytes of all blobs.
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

/// Reports of an attempt.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Told {
    /// Lines of the user's log.
    pub log: Vec<String>,
    /// Recorded values: step, name, value.
    pub records: Vec<(u64, String, f64)>,
    /// The last progress: done, total, unit.
    pub progress: Option<(u64, u64, String)>,
}

/// An attempt context with a world in memory.
#[derive(Debug)]
pub struct MemoryAttempt {
    task: StageTask,
    device: Device,
    blobs: Arc<MemoryBlobs>,
    stop: Arc<AtomicBool>,
    /// Access to files outside the store: unrestricted, without expected digests.
    pub data: Arc<DataAccess>,
    /// Bytes of the blobs of a long file.
    pub chunk_bytes: u64,
    /// Number of values from which the results of a slice are large.
    pub large: Option<usize>,
    /// Reports of the attempt so far.
    pub told: Told,
}

impl MemoryAttempt {
    /// Creates an attempt at `task` that computes on `device`.
    pub fn new(task: StageTask, device: Device, blobs: Arc<MemoryBlobs>) -> Self {
        let data = Arc::new(DataAccess::unverified());
        let chunk_bytes = limits::CHUNK_BYTES;
        Self { task, device, blobs, stop: Arc::default(), data, chunk_bytes, large: None, told: Told::default() }
    }

    /// A flag that makes [`AttemptContext::interrupted`] true once set.
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

    fn data(&self) -> Arc<DataAccess> {
        Arc::clone(&self.data)
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
            let blob = checkpoint::file::get(&*self.blobs, entry);
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

    fn chunk_bytes(&self) -> u64 {
        self.chunk_bytes
    }

    fn interrupted(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// Result of a stage.
#[derive(Debug, Clone)]
pub struct Ran {
    /// Outcome of the stage.
    pub outcome: Outcome,
    /// Reports: those of a map stage's merge, or of a gang's last leader.
    pub told: Told,
}

impl Ran {
    /// Digest of the output's manifest.
    ///
    /// # Panics
    /// If the stage yielded.
    pub fn output(&self) -> Digest {
        match &self.outcome {
            Outcome::Finished { output, .. } => *output,
            Outcome::Yielded { at } => panic!("the stage yielded at step {at}"),
        }
    }

    /// Final metrics of the stage.
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
