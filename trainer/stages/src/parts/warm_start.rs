//! Initial weights of a training from an existing model: the settings key `init`, the same for every kind.
//!
//! `init` names a stage or a version of the registry. The source is found by kind of artifact: an artifact of the
//! trained kind, or the only part of that kind in a model. Tensors with equal name and shape are copied; all others
//! keep their fresh values and are listed in the log. So a VAE of KIT-ML starts from one of HumanML3D, fresh only at
//! the features' input and output. It is an error if nothing fits, or only tensors with one axis such as biases. Other
//! differences (statistics of the data, another text encoder, another noise schedule) are logged and allowed, unless
//! the kind refuses them. Not its job: a checkpoint, which is the complete state of a training and is loaded later.

use std::collections::BTreeSet;

use burn::module::Module;
use checkpoint::Blob;
use checkpoint::model::{Model, part_of_kind};
use models::flat::{self, Entry};
use models::names;
use protocol::{ArtifactKind, Digest, Manifest};
use serde::Serialize;
use serde_json::Value;

use crate::artifacts::{self, MODEL_FILE, to_meta};
use crate::context::{AttemptContext, ContextError, GangContext, StageError};
use crate::parts::{self, model_error};

/// The settings key that names the source.
const INIT: &str = "init";

/// Largest number of tensors that the log lists one by one.
const LISTED: usize = 40;

/// Initial weights of a training; `None` if `init` is not set.
#[derive(Debug)]
pub(crate) struct WarmStart(Option<Weights>);

/// The weights to be copied.
#[derive(Debug)]
struct Weights {
    digest: Digest,
    part: Manifest,
    file: Box<dyn Blob>,
    taken: usize,
    /// Number of copied tensors with two axes or more.
    matrices: usize,
    fresh: Vec<String>,
    /// Names in the file that our network has too.
    known: BTreeSet<String>,
}

impl WarmStart {
    /// Opens the artifact of `kind` that `init` names, or that is a part of the model there.
    pub(crate) fn find(cx: &dyn AttemptContext, kind: ArtifactKind) -> Result<Self, StageError> {
        let Some(&digest) = cx.task().inputs.get(INIT) else { return Ok(Self(None)) };
        let blobs = cx.blobs();
        let manifest = cx.manifest(digest)?;
        let (digest, part) = if manifest.kind == ArtifactKind::Model {
            let model = Model::read(&manifest).map_err(model_error)?;
            let part = part_of_kind(&model, kind, |digest| parts::manifest(&*blobs, digest, "a part of `init`"))?;
            let (_, digest, part) = part.map_err(|e| StageError::Input(format!("`{INIT}`: {e}")))?;
            (digest, part)
        } else {
            artifacts::expect(&format!("`{INIT}`"), &manifest, kind)?;
            (digest, manifest)
        };
        let file = artifacts::open(&*blobs, &part, MODEL_FILE)?;
        Ok(Self(Some(Weights { digest, part, file, taken: 0, matrices: 0, fresh: Vec::new(), known: BTreeSet::new() })))
    }

    /// Loads into the only network of a training the weights of `init` that fit it; `meta` is that of the new artifact.
    pub(crate) fn begin<M: Module>(
        cx: &mut dyn GangContext,
        kind: ArtifactKind,
        network: M,
        meta: &impl Serialize,
    ) -> Result<M, StageError> {
        let mut start = Self::find(cx, kind)?;
        let network = start.take(network, "")?;
        start.finish(cx, meta)?;
        Ok(network)
    }

    /// The manifest of the source, if `init` is set, so that a kind can check more than names and shapes.
    pub(crate) fn part(&self) -> Option<&Manifest> {
        self.0.as_ref().map(|weights| &weights.part)
    }

    /// Loads into `network` the weights that fit it, from names with `prefix`.
    pub(crate) fn take<M: Module>(&mut self, network: M, prefix: &str) -> Result<M, StageError> {
        let entries = flat::layout(&network);
        let Some(values) = self.values(&entries, prefix)? else { return Ok(network) };
        let mut all = flat::read(&network);
        let mut rest = all.as_mut_slice();
        for (entry, values) in entries.iter().zip(values) {
            let (tensor, later) = rest.split_at_mut(entry.len());
            if let Some(values) = values {
                tensor.copy_from_slice(&values);
            }
            rest = later;
        }
        Ok(flat::write(network, &all))
    }

    /// The values that fit `entries`, for trained values outside networks; `None` if `init` is not set.
    pub(crate) fn values(
        &mut self,
        entries: &[Entry],
        prefix: &str,
    ) -> Result<Option<Vec<Option<Vec<f32>>>>, StageError> {
        let Some(weights) = &mut self.0 else { return Ok(None) };
        let file = &weights.file;
        let found = names::fitting(entries, file.bytes(), &mut |offset, out| file.read_at(offset, out), prefix);
        let fitted = found.map_err(artifacts::blob_error)?.map_err(corrupt)?;
        weights.taken += fitted.values.iter().flatten().count();
        let matrices =
            entries.iter().zip(&fitted.values).filter(|(entry, values)| values.is_some() && entry.shape.len() > 1);
        weights.matrices += matrices.count();
        weights.fresh.extend(fitted.fresh);
        weights.known.extend(entries.iter().map(|entry| format!("{prefix}{}", entry.name)));
        Ok(Some(fitted.values))
    }

    /// Logs the tensors that were copied and those that were not; `meta` is the meta of the new artifact.
    ///
    /// # Errors
    /// If nothing fitted.
    pub(crate) fn finish(self, cx: &mut dyn GangContext, meta: &impl Serialize) -> Result<(), StageError> {
        let Some(Weights { digest, part, file, taken, matrices, fresh, known }) = self.0 else { return Ok(()) };
        let there = names::tensors(file.bytes(), &mut |offset, out| file.read_at(offset, out));
        let there = there.map_err(artifacts::blob_error)?.map_err(corrupt)?;
        if matrices == 0 {
            return Err(StageError::Input(format!(
                "`{INIT}` does not match this network: of its {} tensors, no weight matrix has the name and shape of \
                 one here; expected for example {}, found for example {}; use the output of a stage of this kind with \
                 the same `network`",
                there.len(),
                fresh.first().map_or("none", String::as_str),
                there.first().map_or_else(|| "none".into(), |entry| format!("{} {:?}", entry.name, entry.shape)),
            )));
        }
        if !cx.leads() {
            return Ok(());
        }
        let kind = part.kind.noun();
        let all = taken + fresh.len();
        cx.log(&format!("starts with {taken} of {all} tensors from `{INIT}`, {kind}, {}", digest.short()));
        list(cx, "fresh", &fresh);
        let unused: Vec<String> = there
            .iter()
            .filter(|entry| !known.contains(&entry.name))
            .map(|entry| format!("{} {:?}", entry.name, entry.shape))
            .collect();
        list(cx, "not used", &unused);
        let differs = differing(&part.meta, &to_meta(meta));
        if !differs.is_empty() {
            cx.log(&format!(
                "`{INIT}` was trained with another {}; training continues from its weights",
                differs.join(", ")
            ));
        }
        Ok(())
    }
}

/// Logs the first of some tensors, one per line.
fn list(cx: &mut dyn GangContext, what: &str, tensors: &[String]) {
    tensors.iter().take(LISTED).for_each(|tensor| cx.log(&format!("{what}: {tensor}")));
    if tensors.len() > LISTED {
        cx.log(&format!("{what}: {} more", tensors.len() - LISTED));
    }
}

/// The differences between two metas of one kind, by key.
fn differing(theirs: &Value, ours: &Value) -> Vec<String> {
    let (Some(theirs), Some(ours)) = (theirs.as_object(), ours.as_object()) else { return Vec::new() };
    let differs = |key: &&String| theirs.get(*key) != ours.get(*key);
    ours.keys().filter(differs).map(|key| format!("`{key}`")).collect()
}

fn corrupt(error: names::LoadError) -> StageError {
    StageError::Context(ContextError::Corrupt(format!("the weights of `{INIT}`: {error}")))
}
