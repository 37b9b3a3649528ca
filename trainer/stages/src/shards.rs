//! The division of work into shards: their items, their artifacts, and reading all of them for the merge.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use protocol::{ArtifactKind, Digest};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};

/// Shard `index` of `of` of a range of `count` items.
pub(crate) fn shard_range(count: usize, index: usize, of: usize) -> Range<usize> {
    count * index / of..count * (index + 1) / of
}

/// Every `of`-th item, for items whose cost changes from the first to the last.
pub(crate) fn in_turn<T>(items: impl IntoIterator<Item = T>, index: usize, of: usize) -> impl Iterator<Item = T> {
    items.into_iter().skip(index).step_by(of)
}

/// Meta of a shard of units.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Units<U> {
    pub(crate) units: Vec<U>,
}

/// Uploads the tensors of a shard as `file`, and ends the shard.
pub(crate) fn publish(
    cx: &mut dyn AttemptContext,
    meta: &impl Serialize,
    file: &str,
    tensors: &Tensors,
    metrics: BTreeMap<String, f64>,
) -> Result<Outcome, StageError> {
    let output = artifacts::publish(cx, ArtifactKind::Shard, to_meta(meta), file, tensors.to_bytes()?)?;
    Ok(Outcome::Finished { output, metrics })
}

/// Meta and tensors of each shard, in order; `what` names the shards in errors.
pub(crate) fn read<M: DeserializeOwned>(
    cx: &dyn AttemptContext,
    shards: &[Digest],
    what: &str,
    file: &str,
) -> impl Iterator<Item = Result<(M, Tensors), StageError>> {
    shards.iter().map(move |shard| {
        let manifest = cx.manifest(*shard)?;
        let meta = artifacts::meta(&manifest, &format!("a shard of the {what}"))?;
        Ok((meta, Tensors::from_bytes(artifacts::mapped(&*cx.blobs(), &manifest, file)?, file)?))
    })
}

/// Refuses shards whose units are not the expected ones.
pub(crate) fn expect_units<U: Ord>(
    found: impl IntoIterator<Item = U>,
    expected: impl IntoIterator<Item = U>,
) -> Result<(), StageError> {
    let (found, expected): (BTreeSet<U>, BTreeSet<U>) = (found.into_iter().collect(), expected.into_iter().collect());
    if found == expected {
        return Ok(());
    }
    Err(StageError::Fault(format!("the shards have {} blocks; expected {}", found.len(), expected.len())))
}
