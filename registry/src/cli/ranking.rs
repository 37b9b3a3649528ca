//! The versions of a leaderboard, and the published rows that may stand beside them.

use checkpoint::model::Model as ModelMeta;
use protocol::Digest;
use protocol::stage::{DataOpen, StageSpec};

use super::answer::Refused;
use super::show::{known, manifest};
use crate::ReadStore;
use crate::leaderboard::{self, Leaderboard};
use crate::versions::Version;

/// Kind of the artifacts with clips.
const DATASET: &str = "dataset";

/// Returns the data format of a version's motions; the papers' datasets have the same names.
async fn format_of(store: &ReadStore, version: &Version) -> Option<String> {
    let manifest = manifest(store, version.artifact).await.ok()?;
    ModelMeta::read(&manifest).ok().map(|model| model.format.name().to_owned())
}

/// Returns true if the version learned from clips that no published table was measured on: procedural ones or recordings.
async fn is_of_other_data(store: &ReadStore, version: &Version) -> Result<bool, Refused> {
    let nodes = store.lineage(version.artifact).await?;
    let datasets = nodes.iter().filter(|node| node.kind.as_deref() == Some(DATASET));
    for key in datasets.filter_map(|node| node.key.as_ref()?.parse::<Digest>().ok()) {
        let made_by = store.stage_result(key).await?;
        if made_by.is_some_and(|made_by| made_by.kind != DataOpen::KIND) {
            return Ok(true);
        }
    }
    Ok(false)
}

pub(super) async fn leaderboard(store: &ReadStore, of: &str, published: bool) -> Result<Leaderboard, Refused> {
    if leaderboard::FORMATS.contains(&of) {
        let mut all = Vec::new();
        for model in store.models().await? {
            for version in store.versions(&model.model).await? {
                if format_of(store, &version).await.as_deref() == Some(of) && !is_of_other_data(store, &version).await?
                {
                    all.push(version);
                }
            }
        }
        return Ok(leaderboard::leaderboard(of.to_owned(), &all, None, published.then_some(of)));
    }
    let (model, versions) = known(store, of).await?;
    let format = match versions.first().filter(|_| published) {
        Some(version) if !is_of_other_data(store, version).await? => format_of(store, version).await,
        _ => None,
    };
    Ok(leaderboard::leaderboard(of.to_owned(), &versions, model.metric.as_deref(), format.as_deref()))
}
