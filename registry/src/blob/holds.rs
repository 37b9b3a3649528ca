//! What tasks that are still held have stored and no row names yet.
//!
//! A coordinator may be restarted while its workers go on, so this is kept in a file as well: a line with a digest and a task for
//! each. A line that does not read is skipped. The file is not synced: what a loss of power takes of it has the grace that every fresh
//! blob has from collection.

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
    /// Another process writes the file, so that it is read whenever somebody asks.
    is_others: bool,
}

impl Holds {
    /// Those of an earlier process, and from now on of this one.
    pub(super) fn keep(path: &Path) -> Self {
        Self { tasks: read(path), path: Some(path.to_owned()), is_others: false }
    }

    /// Those that the process which holds the store has written down.
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

    /// True if a task has stored a blob and is still held.
    pub(super) fn has(&self, task: &TaskId, digest: Digest) -> bool {
        self.tasks.get(task).is_some_and(|digests| digests.contains(&digest))
    }

    pub(super) fn all(&self) -> BTreeSet<Digest> {
        match &self.path {
            Some(path) if self.is_others => read(path).into_values().flatten().collect(),
            _ => self.tasks.values().flatten().copied().collect(),
        }
    }

    /// Forgets the tasks that are not held any more.
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
                "`{}` is not kept, so that a restart will not know what tasks have stored: {error}",
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
                tracing::warn!("`{}` does not read: {error}", path.display());
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
