//! Reading the parts of models, and putting models together; what a model is stands in [`checkpoint::model`].

use std::collections::BTreeMap;

use checkpoint::Blobs;
use checkpoint::model::{self, Model, ModelError};
use protocol::artifact::Role;
use protocol::stage::DataFormat;
use protocol::{ArtifactKind, Digest, Manifest};

use crate::artifacts;
use crate::context::{AttemptContext, ContextError, StageError};

/// What a broken or unfit model means for the stage.
pub fn model_error(error: ModelError) -> StageError {
    StageError::Input(error.to_string())
}

/// The manifest of a part of `model`, which must be of this kind.
pub fn part(blobs: &dyn Blobs, model: &Model, role: &Role, kind: ArtifactKind) -> Result<Manifest, StageError> {
    let manifest = manifest(blobs, model.part(role).map_err(model_error)?, &format!("the part `{role}`"))?;
    artifacts::expect(&format!("the part `{role}`"), &manifest, kind)?;
    Ok(manifest)
}

/// A manifest among the blobs of an artifact; `what` names it in errors.
pub fn manifest(blobs: &dyn Blobs, digest: Digest, what: &str) -> Result<Manifest, StageError> {
    let bytes = blobs.get(digest).map_err(artifacts::blob_error)?;
    serde_json::from_slice(&bytes)
        .map_err(|e| StageError::Context(ContextError::Corrupt(format!("{what}, {digest}, is not a manifest: {e}"))))
}

/// Uploads a model that is drawn by `generator` with these parts, whose files are uploaded.
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
