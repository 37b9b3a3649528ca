//! Re-runs steps of a training stage from a committed checkpoint and keeps what came out, to be compared with what was
//! stored when the stage ran.
//!
//! The whole gang is this thread: a sum along the fixed tree does not depend on who computed its leaves. What is computed is
//! written to memory only; the store is read and never changed.

use std::collections::BTreeMap;
use std::sync::Arc;

use burn::tensor::Device;
use checkpoint::Blobs;
use protocol::message::StageTask;
use protocol::{Digest, Manifest};

use crate::context::{Outcome, StageError};
use crate::kinds;
use crate::solo::{Overlay, Solo};

pub use crate::solo::state_digest;

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
    let mut cx = Solo::new(task, device, Arc::new(Overlay::over(blobs)), checkpoint, until);
    let outcome = kinds::run_gang(&mut cx)?;
    let (to, output) = match outcome {
        Outcome::Yielded { at } => (at, None),
        Outcome::Finished { output, .. } => (cx.states.keys().next_back().copied().unwrap_or(from), Some(output)),
    };
    Ok(Rerun { from, to, values: cx.values, states: cx.states, output })
}
