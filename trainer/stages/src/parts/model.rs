//! Parts of a model by their roles, and a model from its parts.

use std::collections::BTreeMap;

use checkpoint::Blobs;
use checkpoint::model::{self, Model, ModelError};
use protocol::artifact::Role;
use protocol::stage::DataFormat;
use protocol::{ArtifactKind, Digest, Manifest};

use crate::artifacts;
use crate::context::{AttemptContext, ContextError, StageError};

/// The stage's error for a broken or unsuitable model.
pub fn model_error(error: ModelError) -> StageError {
    StageError::Input(error.to_string())
}

/// The manifest of a part of `model`. Refuses a part of another kind.
pub fn part(blobs: &dyn Blobs, model: &Model, role: &Role, kind: ArtifactKind) -> Result<Manifest, StageError> {
    let manifest = manifest(blobs, model.part(role).map_err(model_error)?, &format!("the part `{role}`"))?;
    artifacts::expect(&format!("the part `{role}`"), &manifest, kind)?;
    Ok(manifest)
}

/// Refuses a dataset in another format than that of the training data of `what`.
pub(super) fn expect_format(what: &str, trained_on: DataFormat, found: DataFormat) -> Result<(), StageError> {
    if trained_on == found {
        return Ok(());
    }
    let ours = trained_on.name();
    let theirs = found.name();
    Err(StageError::Input(format!("{what} was trained on `{ours}` features, but the dataset has `{theirs}` features")))
}

/// Reads a manifest from the blobs of an artifact; `what` names it in errors.
pub fn manifest(blobs: &dyn Blobs, digest: Digest, what: &str) -> Result<Manifest, StageError> {
    let bytes = blobs.get(digest).map_err(artifacts::blob_error)?;
    serde_json::from_slice(&bytes).map_err(|e| {
        StageError::Context(ContextError::Corrupt(format!("cannot parse the manifest {digest} of {what}: {e}")))
    })
}

/// Uploads a model with the generator `generator` and these parts, whose files are already uploaded.
pub fn publish_model(
    cx: &mut dyn AttemptContext,
    generator: &str,
    format: DataFormat,
    parts: &BTreeMap<Role, Manifest>,
) -> Result<Digest, StageError> {
    for part in parts.values() {
        cx.put_manifest(part)?;
    }
    let model = model::assemble(generator, format, parts).map_err(model_error)?;
    Ok(cx.put_manifest(&model)?)
}
