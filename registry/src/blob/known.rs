//! Which blobs were hashed and found whole, and which damaged, by the stamp that they had then.
//!
//! A stamp changes with every write to a blob, so what was found holds until then; it spares a run the hashing of gigabytes at
//! each start. The file `verified` is a cache: each line is a digest and a stamp, a line that does not read is skipped, and
//! the file may be deleted. Bytes that rot without a write keep their stamp; they are noticed by their next reader, for
//! every read hashes.

use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use protocol::Digest;

use super::backend::Stat;
use super::disk::regular;

/// How many lines more than blobs the file may have before it is written anew.
const SPARE_LINES: usize = 10_000;

/// What was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Finding {
    Whole,
    /// Its bytes have this digest instead.
    Damaged(Digest),
}

/// All that was found.
#[derive(Debug, Default)]
pub(super) struct Known {
    found: HashMap<Digest, (String, Finding)>,
    path: Option<PathBuf>,
    file: Option<File>,
    lines: usize,
}

impl Known {
    /// What an earlier process found whole.
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

    /// What was found about a blob with this stamp.
    pub(super) fn finding(&self, digest: Digest, stamp: &str) -> Option<Finding> {
        self.found.get(&digest).filter(|(then, _)| then == stamp).map(|(_, finding)| *finding)
    }

    /// Whether the blob was found damaged the last time that it was read.
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
            // Blobs are hashed once more, that is all.
            tracing::debug!("`{}` is not kept: {error}", path.display());
            self.path = None;
        }
    }
}

fn rewrite(path: &Path, found: &HashMap<Digest, (String, Finding)>) -> std::io::Result<File> {
    let fresh = path.with_extension("new");
    // Whatever has that name: an older process's, or somebody's pipe.
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

/// What was found, for all who read: a store and its readers share it.
#[derive(Debug)]
pub(super) struct Findings(Mutex<Known>);

impl Findings {
    pub(super) fn new(known: Known) -> Self {
        Self(Mutex::new(known))
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Known> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes note of what reading a blob has shown.
    pub(super) fn note(&self, digest: Digest, stat: &Stat, finding: Finding) {
        if let Finding::Damaged(found) = finding {
            tracing::error!("blob {digest} is damaged: its bytes hash to {found}");
        }
        self.lock().set(digest, stat.stamp.clone(), finding);
    }
}
