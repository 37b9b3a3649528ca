//! Check of a whole store: the database's own check, every blob hashed again, every reference resolved.

use std::collections::BTreeSet;

use protocol::TaskId;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blob::BlobStore;
use crate::catalog::Root;
use crate::{QueryError, ReadStore};

/// Result of a check.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Report {
    /// Number of hashed blobs.
    pub blobs: u64,
    /// Total bytes of these blobs.
    pub bytes: u64,
    /// Number of references checked.
    pub references: u64,
    /// Descriptions of the problems.
    pub problems: Vec<String>,
    /// Other files in the store: foreign ones, damaged blobs that were put aside and stored again, and parts of uploads
    /// that have not ended.
    #[serde(default)]
    pub notes: Vec<String>,
}

impl ReadStore {
    /// Checks the whole store. Reads every byte.
    pub async fn fsck(&self) -> Result<Report, QueryError> {
        let mut problems = Vec::new();
        if let Err(problem) = self.check_identity().await {
            problems.push(problem);
        }
        problems.extend(self.problems().await?);
        let needs = self.needs().await?;
        // The result of a finished stage replaces its shards, so a backup leaves out their blobs.
        let replaced: BTreeSet<TaskId> = needs.done_shards.into_iter().collect();
        let mut roots = needs.roots;
        roots.retain(|root| root.shard.as_ref().is_none_or(|task| !replaced.contains(task)));
        let blobs = self.blobs().clone();
        let ended = |e: tokio::task::JoinError| QueryError::Blob(format!("the check stopped early: {e}"));
        let mut report = tokio::task::spawn_blocking(move || check(&blobs, &roots)).await.map_err(ended)?;
        problems.append(&mut report.problems);
        Ok(Report { problems, ..report })
    }
}

fn check(blobs: &BlobStore, roots: &[Root]) -> Report {
    let mut report = Report::default();
    match blobs.list() {
        Ok(all) => {
            for entry in all.values() {
                report.blobs += 1;
                report.bytes += entry.bytes;
                match blobs.check(entry.digest) {
                    // Collected since the listing.
                    Ok(()) | Err(checkpoint::BlobError::NotFound(_)) => {}
                    Err(e) => report.problems.push(e.to_string()),
                }
            }
        }
        Err(e) => report.problems.push(e.to_string()),
    }
    match (blobs.strays(), blobs.aside(), blobs.unfinished()) {
        (Ok(strays), Ok(aside), Ok(unfinished)) => {
            report
                .notes
                .extend(strays.iter().map(|path| format!("`{path}` does not belong to the store and is left alone")));
            report.notes.extend(aside.iter().map(|path| format!("`{path}` is a damaged blob that was put aside")));
            report.notes.extend(unfinished);
        }
        (Err(e), _, _) | (_, Err(e), _) | (_, _, Err(e)) => report.problems.push(e.to_string()),
    }
    for root in roots {
        report.references += 1;
        if let Err(e) = blobs.complete_manifest(root.digest) {
            report.problems.push(format!("{}: {e}", root.what));
        }
    }
    report
}
