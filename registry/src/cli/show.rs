//! Looks up models, versions and artifacts by their names, for `show`, `lineage` and other commands.

use std::collections::BTreeMap;

use checkpoint::model::{self, Model as ModelMeta, Parts};
use protocol::artifact::Role;
use protocol::{Digest, Manifest, ModelName};

use super::answer::{Data, Refused, invalid};
use crate::versions::{BEST, LATEST, Model, ModelRef, Version};
use crate::{QueryError, ReadStore};

/// Number of versions searched for bases of a control part.
pub const MOST_BASES: usize = 1_000;

pub(super) async fn lineage(store: &ReadStore, reference: &str) -> Result<Data, Refused> {
    let digest = match reference.parse::<Digest>() {
        Ok(digest) => digest,
        Err(_) => store.resolve(reference).await?.artifact,
    };
    let nodes = store.lineage(digest).await?;
    if nodes.iter().all(|node| node.kind.is_none() && node.inputs.is_empty()) && !exists(store, digest).await? {
        return Err(Refused::from(QueryError::NotFound(format!("no artifact {digest}"))));
    }
    Ok(Data::Lineage { nodes })
}

/// Returns the version that a reference names. A model alone means its best version, or its newest if no metric ranks
/// them.
pub(super) async fn one(store: &ReadStore, text: &str) -> Result<Version, Refused> {
    let reference: ModelRef = text.parse().map_err(invalid)?;
    if reference.pick.is_some() {
        return Ok(store.resolve(text).await?);
    }
    let pick = if known(store, text).await?.0.best.is_some() { BEST } else { LATEST };
    Ok(store.resolve(&format!("{text}@{pick}")).await?)
}

/// Returns a model and its versions, oldest first.
pub(super) async fn known(store: &ReadStore, name: &str) -> Result<(Model, Vec<Version>), Refused> {
    let name: ModelName = name.parse().map_err(invalid)?;
    match store.model(&name).await? {
        Some(found) => Ok(found),
        // The error of `resolve` lists the known models.
        None => Err(store
            .resolve(&format!("{name}@latest"))
            .await
            .map_or_else(Refused::from, |_| invalid("the model was created meanwhile; run the command again"))),
    }
}

async fn exists(store: &ReadStore, digest: Digest) -> Result<bool, Refused> {
    store.ask_blobs(move |blobs| blobs.exists(digest)).await.map_err(|e| Refused::from(QueryError::Blob(e.to_string())))
}

pub(super) async fn manifest(store: &ReadStore, digest: Digest) -> Result<Manifest, QueryError> {
    store.ask_blobs(move |blobs| blobs.manifest(digest)).await.map_err(|e| QueryError::Blob(e.to_string()))
}

pub(super) async fn show(store: &ReadStore, text: &str) -> Result<Data, Refused> {
    let reference: ModelRef = text.parse().map_err(invalid)?;
    if reference.pick.is_none() {
        let (model, versions) = known(store, reference.model.as_str()).await?;
        return Ok(Data::Model { model, versions });
    }
    let version = store.resolve(text).await?;
    let manifest = manifest(store, version.artifact).await?;
    let fits = fits(store, &manifest).await?;
    let bases = match fits.get(&Role::CONTROL) {
        Some(wanted) => bases(store, &version, wanted).await?,
        None => Vec::new(),
    };
    Ok(Data::Version { version, manifest, fits, bases })
}

/// Finds other versions that contain all `wanted` parts: the models that a control part fits.
async fn bases(store: &ReadStore, own: &Version, wanted: &Parts) -> Result<Vec<String>, Refused> {
    let mut all = Vec::new();
    for model in store.models().await? {
        all.extend(store.versions(&model.model).await?);
    }
    all.sort_by_key(|version| std::cmp::Reverse(version.created_ms));
    let mut bases = Vec::new();
    for version in all.iter().take(MOST_BASES).filter(|version| version.artifact != own.artifact) {
        // Skips artifacts that are damaged or not models; `fsck` reports them.
        let Ok(manifest) = manifest(store, version.artifact).await else { continue };
        let Ok(model) = ModelMeta::read(&manifest) else { continue };
        if wanted.iter().all(|(role, digest)| model.parts.get(role) == Some(digest)) {
            bases.push(format!("{}:{}", version.model, version.version));
        }
    }
    Ok(bases)
}

/// Returns for each part of a model the parts it was made for. Empty for other artifacts.
async fn fits(store: &ReadStore, of: &Manifest) -> Result<BTreeMap<Role, Parts>, Refused> {
    let Ok(model) = ModelMeta::read(of) else { return Ok(BTreeMap::new()) };
    let mut all = BTreeMap::new();
    for (role, digest) in model.parts {
        let part = manifest(store, digest).await?;
        let fits = model::fits(&role, &part).map_err(|e| QueryError::Blob(e.to_string()))?;
        if !fits.is_empty() {
            all.insert(role, fits);
        }
    }
    Ok(all)
}
