//! Blobs that held tasks have stored and no row names yet.
//!
//! Workers continue while a coordinator restarts, so this table is also kept in a file, one line with digest and task
//! for each blob. Unreadable lines are skipped. The file is not synced: blobs whose lines a power loss takes still have
//! the grace period of fresh blobs.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use protocol::{Digest, TaskId};

use super::disk::regular;

/// Blobs by the task that stored them.
#[derive(Debug, Default)]
pub(super) struct Holds {
    tasks: BTreeMap<TaskId, BTreeSet<Digest>>,
    path: Option<PathBuf>,
    /// True if another process writes the file, which is then read for every request.
    is_others: bool,
}

impl Holds {
    /// Reads the holds of an earlier process and keeps this process's holds in the same file.
    pub(super) fn keep(path: &Path) -> Self {
        Self { tasks: read(path), path: Some(path.to_owned()), is_others: false }
    }

    /// Opens the holds of the process that has the store open, for reading.
    pub(super) fn of_others(path: &Path) -> Self {
        Self { path: Some(path.to_owned()), is_others: true, ..Self::default() }
    }

    pub(super) fn hold(&mut self, task: &TaskId, digest: Digest) {
        if self.tasks.entry(task.clone()).or_default().insert(digest) {
            let append = |path: &Path| {
                let mut file = regular(OpenOptions::new().append(true).create(true), path)?;
                file.write_all(format!("{digest} {task}\n").as_bytes())
            };
            self.kept(append);
        }
    }

    /// Returns true if the task has stored the blob and is still held.
    pub(super) fn has(&self, task: &TaskId, digest: Digest) -> bool {
        self.tasks.get(task).is_some_and(|digests| digests.contains(&digest))
    }

    pub(super) fn all(&self) -> BTreeSet<Digest> {
        match &self.path {
            Some(path) if self.is_others => read(path).into_values().flatten().collect(),
            _ => self.tasks.values().flatten().copied().collect(),
        }
    }

    /// Forgets the tasks that are no longer held.
    pub(super) fn let_go(&mut self, is_held: impl Fn(&TaskId) -> bool) {
        let before = self.tasks.len();
        self.tasks.retain(|task, _| is_held(task));
        if self.tasks.len() < before {
            let line = |(task, digests): (&TaskId, &BTreeSet<Digest>)| -> String {
                digests.iter().map(|digest| format!("{digest} {task}\n")).collect()
            };
            let text: String = self.tasks.iter().map(line).collect();
            self.kept(|path| {
                let fresh = path.with_extension("new");
                fs::write(&fresh, text)?;
                fs::rename(&fresh, path)
            });
        }
    }

    fn kept(&self, write: impl FnOnce(&Path) -> io::Result<()>) {
        let Some(path) = &self.path else { return };
        if let Err(error) = write(path) {
            tracing::warn!(
                "cannot write `{}`; a restart will not know the blobs of held tasks: {error}",
                path.display()
            );
        }
    }
}

fn read(path: &Path) -> BTreeMap<TaskId, BTreeSet<Digest>> {
    let text = match regular(OpenOptions::new().read(true), path).and_then(io::read_to_string) {
        Ok(text) => text,
        Err(error) => {
            if error.kind() != ErrorKind::NotFound {
                tracing::warn!("cannot read `{}`: {error}", path.display());
            }
            return BTreeMap::new();
        }
    };
    let mut tasks: BTreeMap<TaskId, BTreeSet<Digest>> = BTreeMap::new();
    for line in text.lines() {
        let Some((digest, task)) = line.split_once(' ') else { continue };
        if let Ok(digest) = digest.parse() {
            tasks.entry(TaskId::new(task)).or_default().insert(digest);
        }
    }
    tasks
}
