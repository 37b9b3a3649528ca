//! Results of hashing blobs, whole or damaged, by the blob's stamp at that time.
//!
//! A stamp changes with every write to a blob, so a result is valid until then. This spares a run hashing gigabytes at
//! each start. The file `verified` is a cache with one digest and stamp a line; unreadable lines are skipped, and the
//! file may be deleted. Bytes that rot without a write keep their stamp; the next reader notices, because every read
//! hashes.

use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use protocol::Digest;

use super::backend::Stat;
use super::disk::regular;

/// Surplus of lines over blobs at which the file is rewritten.
const SPARE_LINES: usize = 10_000;

/// Result of hashing a blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Finding {
    Whole,
    /// The bytes have this digest instead.
    Damaged(Digest),
}

/// All results, with the file that keeps them.
#[derive(Debug, Default)]
pub(super) struct Known {
    found: HashMap<Digest, (String, Finding)>,
    path: Option<PathBuf>,
    file: Option<File>,
    lines: usize,
}

impl Known {
    /// Reads the whole blobs that an earlier process recorded.
    pub(super) fn read(path: &Path) -> Self {
        let mut known = Self { path: Some(path.to_owned()), ..Self::default() };
        let text = regular(OpenOptions::new().read(true), path).and_then(std::io::read_to_string).unwrap_or_default();
        for line in text.lines() {
            known.lines += 1;
            let Some((digest, stamp)) = line.split_once(' ') else { continue };
            let Ok(digest) = digest.parse() else { continue };
            known.found.insert(digest, (stamp.to_owned(), Finding::Whole));
        }
        known
    }

    /// Returns the result for a blob with this stamp.
    pub(super) fn finding(&self, digest: Digest, stamp: &str) -> Option<Finding> {
        self.found.get(&digest).filter(|(then, _)| then == stamp).map(|(_, finding)| *finding)
    }

    /// Returns true if the last read found the blob damaged.
    pub(super) fn is_damaged(&self, digest: Digest) -> bool {
        matches!(self.found.get(&digest), Some((_, Finding::Damaged(_))))
    }

    pub(super) fn set(&mut self, digest: Digest, stamp: String, finding: Finding) {
        if self.finding(digest, &stamp) == Some(finding) {
            return;
        }
        let line = (finding == Finding::Whole).then(|| format!("{digest} {stamp}\n"));
        self.found.insert(digest, (stamp, finding));
        if let Some(line) = line {
            self.append(&line);
        }
    }

    pub(super) fn forget(&mut self, digest: Digest) {
        self.found.remove(&digest);
    }

    fn append(&mut self, line: &str) {
        let Some(path) = &self.path else { return };
        let written = if self.file.is_none() || self.lines > self.found.len() + SPARE_LINES {
            self.lines = self.found.len();
            rewrite(path, &self.found).map(|file| self.file = Some(file))
        } else {
            self.lines += 1;
            self.file.as_mut().map_or(Ok(()), |file| file.write_all(line.as_bytes()))
        };
        if let Err(error) = written {
            // The only cost is that blobs are hashed once more.
            tracing::debug!("cannot write `{}`: {error}", path.display());
            self.path = None;
        }
    }
}

fn rewrite(path: &Path, found: &HashMap<Digest, (String, Finding)>) -> std::io::Result<File> {
    let fresh = path.with_extension("new");
    // Removes any file of that name, such as one of an older process or a foreign pipe.
    match fs::remove_file(&fresh) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    let mut file = OpenOptions::new().write(true).create_new(true).open(&fresh)?;
    let whole = found.iter().filter(|(_, (_, finding))| *finding == Finding::Whole);
    let text: String = whole.map(|(digest, (stamp, _))| format!("{digest} {stamp}\n")).collect();
    file.write_all(text.as_bytes())?;
    fs::rename(&fresh, path)?;
    Ok(file)
}

/// Results shared by a store and its readers.
#[derive(Debug)]
pub(super) struct Findings(Mutex<Known>);

impl Findings {
    pub(super) fn new(known: Known) -> Self {
        Self(Mutex::new(known))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Known> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Records the result of reading a blob.
    pub(super) fn note(&self, digest: Digest, stat: &Stat, finding: Finding) {
        if let Finding::Damaged(found) = finding {
            tracing::error!("blob {digest} is damaged: its bytes hash to {found}");
        }
        self.lock().set(digest, stat.stamp.clone(), finding);
    }
}
