//! Lookup in the cache of the hub.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use motion::DataPath;

use crate::error::HubError;
use crate::found::Found;
use crate::name::{Name, is_commit};
use crate::settings::Settings;
use crate::wanted::{Encoder, Failure, Repository, get_all};

/// Largest size of a file with a commit, in bytes.
const COMMIT_BYTES: u64 = 1 << 10;

/// Folder of a repository in the cache.
pub(crate) fn root(settings: &Settings, name: &Name) -> PathBuf {
    settings.cache.join(format!("models--{}", name.repository.replace('/', "--")))
}

/// Folder of a commit in the cache.
pub(crate) fn snapshot(settings: &Settings, name: &Name, commit: &str) -> PathBuf {
    root(settings, name).join("snapshots").join(commit)
}

/// Returns true if the name is that of a file below a folder, and cannot lead out of it.
pub(crate) fn is_sound(name: &str) -> bool {
    let plain = |part: &str| !part.is_empty() && part != "." && part != ".." && !part.contains(['\\', '\0']);
    name.len() <= 1_000 && name.split('/').all(plain)
}

/// A commit's files in the cache.
struct Snapshot {
    folder: PathBuf,
    names: BTreeSet<String>,
}

impl Repository for Snapshot {
    fn names(&self) -> &BTreeSet<String> {
        &self.names
    }

    fn get(&mut self, name: &str) -> Result<PathBuf, Failure> {
        Ok(self.folder.join(name))
    }
}

fn commit(settings: &Settings, name: &Name) -> Option<String> {
    if name.is_commit() {
        return Some(name.revision.clone());
    }
    // A branch that was never resolved has no file.
    let bytes = DataPath::local(root(settings, name).join("refs").join(&name.revision)).read(COMMIT_BYTES).ok()?;
    String::from_utf8(bytes).ok().map(|text| text.trim().to_owned()).filter(|text| is_commit(text))
}

fn names(folder: &Path) -> BTreeSet<String> {
    // Missing files are reported by the reader that needs them.
    let Ok(all) = DataPath::local(folder).tree() else { return BTreeSet::new() };
    let name = |path: DataPath| Some(path.shown().strip_prefix(folder).ok()?.to_string_lossy().into_owned());
    all.into_iter().filter_map(name).collect()
}

/// Finds the complete snapshot of a name; `why` is the reason for not fetching, for errors.
pub(crate) fn find(settings: &Settings, name: &Name, encoder: Encoder, why: &str) -> Result<Found, HubError> {
    let away = |why: String| HubError::NotHere { name: name.to_string(), cache: settings.cache.clone(), why };
    let commit = commit(settings, name).ok_or_else(|| away(why.to_owned()))?;
    let folder = snapshot(settings, name, &commit);
    let mut snapshot = Snapshot { names: names(&folder), folder: folder.clone() };
    if snapshot.names.is_empty() {
        return Err(away(why.to_owned()));
    }
    match get_all(&mut snapshot, encoder) {
        Ok(()) => Ok(Found { folder, commit, note: None }),
        Err(Failure::Said(error)) => Err(error),
        Err(Failure::Content(what) | Failure::Away(what)) => {
            Err(away(format!("the cached copy is incomplete: {what}; {why}")))
        }
    }
}
