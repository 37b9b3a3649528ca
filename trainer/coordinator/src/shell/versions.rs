//! Resolution of registry versions that a pipeline uses in place of stages, at the time of submission.
//!
//! The resolved digests become part of the pipeline, like those of folders. Keys include them and a resumed run keeps
//! them, so that a later move of an alias has no effect.

use checkpoint::model::{Model, part_of_kind};
use pipeline::Pipeline;
use protocol::stage::VersionInput;
use protocol::{ArtifactKind, Digest};
use registry::{BlobStore, QueryError, ReadStore};

/// Adds the digests of the pipeline's versions: of a whole model, or of its part that the stage reads.
///
/// # Errors
/// All versions that do not exist or lack the part, one per line; otherwise the error of the store.
pub async fn resolve_versions(pipeline: &mut Pipeline, store: &ReadStore) -> Result<(), QueryError> {
    let mut wrong = Vec::new();
    for stage in &mut pipeline.stages {
        for input in stage.versions() {
            let found = match store.resolve(&input.version).await {
                Ok(version) => {
                    let input = input.clone();
                    store.ask_blobs(move |blobs| part(blobs, version.artifact, &input)).await
                }
                Err(error) => Err(error),
            };
            match found {
                Ok(digest) => {
                    stage.external.insert(input.field, digest);
                }
                Err(QueryError::NotFound(why) | QueryError::Invalid(why)) => {
                    wrong.push(format!("stage `{}`: `{}` is `{}`: {why}", stage.name, input.field, input.version));
                }
                Err(error) => return Err(error),
            }
        }
    }
    if wrong.is_empty() { Ok(()) } else { Err(QueryError::Invalid(wrong.join("\n"))) }
}

fn damaged(error: impl std::fmt::Display) -> QueryError {
    QueryError::Blob(error.to_string())
}

/// The artifact or part that a stage reads of the version registered as `artifact`.
fn part(blobs: &BlobStore, artifact: Digest, input: &VersionInput) -> Result<Digest, QueryError> {
    let manifest = blobs.manifest(artifact).map_err(damaged)?;
    let model = Model::read(&manifest).map_err(|e| QueryError::Invalid(e.to_string()))?;
    let wanted = if input.kind == ArtifactKind::Model { input.part } else { Some(input.kind) };
    let Some(wanted) = wanted else { return Ok(artifact) };
    let found = part_of_kind(&model, wanted, |digest| blobs.manifest(digest)).map_err(damaged)?;
    let (_, digest, _) = found.map_err(|e| QueryError::Invalid(e.to_string()))?;
    Ok(if input.kind == ArtifactKind::Model { artifact } else { digest })
}
