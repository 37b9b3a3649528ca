//! Re-runs steps of a training stage from a committed checkpoint and keeps the results, to be compared with those
//! stored when the stage ran.
//!
//! The whole gang is this thread: a sum along the fixed tree does not depend on the members that computed its leaves.
//! Results are written only to memory; the store is read and never changed.

use std::collections::BTreeMap;
use std::sync::Arc;

use burn::tensor::Device;
use checkpoint::Blobs;
use protocol::message::StageTask;
use protocol::{Digest, Manifest};

use super::solo::{Overlay, Solo};
use crate::context::{Outcome, StageError};
use crate::kinds;

pub use crate::run::solo::state_digest;

/// Results of re-run steps.
#[derive(Debug, Clone)]
pub struct Rerun {
    /// Number of steps in the initial state.
    pub from: u64,
    /// Number of steps in the final state.
    pub to: u64,
    /// Recorded values by step and name.
    pub values: BTreeMap<(u64, String), f64>,
    /// Digest of the whole training state by step, for each saved one.
    pub states: BTreeMap<u64, Digest>,
    /// Output of the stage, if it reached its end.
    pub output: Option<Digest>,
}

/// Runs `task` from `checkpoint`, or from the start without one, until `until` steps are applied, or to its end.
///
/// # Errors
/// Any error of the stage.
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
