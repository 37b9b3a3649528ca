//! Check of a whole store: the database's own check, every blob hashed again, every reference resolved.

use protocol::Digest;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blob::{BlobStore, ManifestError};
use crate::{QueryError, ReadStore};

/// Result of a check.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Report {
    /// Number of hashed blobs.
    pub blobs: u64,
    /// Total bytes of these blobs.
    pub bytes: u64,
    /// Number of artifacts that rows name; each was checked.
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
        let blobs = self.blobs().clone();
        let ended = |e: tokio::task::JoinError| QueryError::Blob(format!("the check stopped early: {e}"));
        let checked = tokio::task::spawn_blocking(move || check(&blobs, &needs.roots)).await;
        let (mut report, broken) = checked.map_err(ended)?;
        problems.append(&mut report.problems);
        for (root, e) in broken {
            problems.push(format!("{}: {e}", self.named_by(root).await?));
        }
        Ok(Report { problems, ..report })
    }
}

/// Checks all blobs and `roots`. Returns the roots that are not whole beside the report.
fn check(blobs: &BlobStore, roots: &[Digest]) -> (Report, Vec<(Digest, ManifestError)>) {
    let mut report = Report::default();
    match blobs.list() {
        Ok(all) => {
            for entry in all {
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
    report.references = roots.len() as u64;
    let broken = roots.iter().filter_map(|root| blobs.complete_manifest(*root).err().map(|e| (*root, e)));
    let broken = broken.collect();
    (report, broken)
}
