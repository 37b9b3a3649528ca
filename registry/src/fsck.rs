//! Whether what is kept is whole: the database's own check, every blob hashed again, every reference resolved.

use serde::{Deserialize, Serialize};

use crate::blob::BlobStore;
use crate::catalog::Root;
use crate::{QueryError, ReadStore};

/// What a check found.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Report {
    /// Blobs that were hashed.
    pub blobs: u64,
    /// Their bytes.
    pub bytes: u64,
    /// References that were followed.
    pub references: u64,
    /// What is wrong, in words.
    pub problems: Vec<String>,
    /// What lies in the store and is not part of it: strangers' files, and damaged blobs that were put aside and made anew.
    #[serde(default)]
    pub notes: Vec<String>,
}

impl ReadStore {
    /// Checks everything. Reads every byte, so it takes as long as that takes.
    pub async fn fsck(&self) -> Result<Report, QueryError> {
        let mut problems = Vec::new();
        if let Err(problem) = self.check_identity().await {
            problems.push(problem);
        }
        problems.extend(self.problems().await?);
        let roots = self.needs().await?.roots;
        let blobs = self.blobs().clone();
        let ended = |e: tokio::task::JoinError| QueryError::Blob(format!("the check ended early: {e}"));
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
    match (blobs.strays(), blobs.aside()) {
        (Ok(strays), Ok(aside)) => {
            report.notes.extend(strays.iter().map(|path| format!("`{path}` is not the store's and is left alone")));
            report.notes.extend(aside.iter().map(|path| format!("`{path}` is a damaged blob that was put aside")));
        }
        (Err(e), _) | (_, Err(e)) => report.problems.push(e.to_string()),
    }
    for root in roots {
        report.references += 1;
        if let Err(e) = blobs.complete_manifest(root.digest) {
            report.problems.push(format!("{}: {e}", root.what));
        }
    }
    report
}
