//! Transfer of weights between a flat buffer or a network and a store, without a second copy in memory.

use burn::module::Module;
use checkpoint::Blobs;
use models::flat::Entry;
use models::names::{Weights, load_from};
use protocol::{ArtifactKind, Digest, Manifest};

use crate::artifacts::{self, Draft, MODEL_FILE};
use crate::context::{AttemptContext, ContextError, StageError};

/// File of published tensors that a network's size determines; our readers do not need them.
pub const CONSTANTS_FILE: &str = "constants.safetensors";

/// Uploads weights as a file of an artifact.
pub fn add(draft: &mut Draft, (entries, values): (&[Entry], &[f32])) -> Result<(), StageError> {
    draft.add_pieces(MODEL_FILE, &Weights::new(entries, values).pieces())
}

/// Uploads weights from several buffers as one file of an artifact.
pub fn add_all(draft: &mut Draft, buffers: &[(&[Entry], &[f32])]) -> Result<(), StageError> {
    draft.add_pieces(MODEL_FILE, &Weights::of(buffers).pieces())
}

/// Uploads weights and their manifest.
pub fn publish(
    cx: &mut dyn AttemptContext,
    kind: ArtifactKind,
    meta: serde_json::Value,
    weights: (&[Entry], &[f32]),
) -> Result<Digest, StageError> {
    let mut draft = Draft::new(cx, kind, meta);
    add(&mut draft, weights)?;
    draft.finish(cx)
}

/// Loads the weights of an artifact into `blank`, tensor by tensor; `what` names them in the error.
pub fn load<M: Module>(blank: M, blobs: &dyn Blobs, manifest: &Manifest, what: &str) -> Result<M, StageError> {
    load_under(blank, blobs, manifest, "", what)
}

/// Like [`load`], only for weights whose names have `prefix`.
pub fn load_under<M: Module>(
    blank: M,
    blobs: &dyn Blobs,
    manifest: &Manifest,
    prefix: &str,
    what: &str,
) -> Result<M, StageError> {
    let file = artifacts::open(blobs, manifest, MODEL_FILE)?;
    let loaded = load_from(blank, file.bytes(), &mut |offset, out| file.read_at(offset, out), prefix);
    let misfit = |e| StageError::Context(ContextError::Corrupt(format!("{what}: {e}")));
    loaded.map_err(artifacts::blob_error)?.map_err(misfit)
}
