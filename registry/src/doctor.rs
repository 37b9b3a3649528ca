//! Checks of a store's folder, for `trainer doctor` and the page. They change nothing.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use schemars::JsonSchema;
use serde::Serialize;

use crate::blob::disk::free_bytes;

/// Free space below which a training may fill the disk, and below which nothing can be stored.
const LITTLE: u64 = 5 << 30;
const NONE: u64 = 200 << 20;

/// Result of a check in a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum State {
    Ok,
    Warn,
    Fail,
}

/// Result of one check.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Finding {
    pub state: State,
    /// The part that was checked.
    pub what: &'static str,
    pub found: String,
    /// Advice for a problem.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
}

impl Finding {
    pub fn ok(what: &'static str, found: impl Into<String>) -> Self {
        Self { state: State::Ok, what, found: found.into(), hint: None }
    }

    pub fn warn(what: &'static str, found: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { state: State::Warn, what, found: found.into(), hint: Some(hint.into()) }
    }

    pub fn fail(what: &'static str, found: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { state: State::Fail, what, found: found.into(), hint: Some(hint.into()) }
    }
}

/// Checks the disk of the store, or of the folder in which it would be created.
pub fn disk(dir: &Path) -> Finding {
    let absolute = std::path::absolute(dir).unwrap_or_else(|_| dir.to_owned());
    let existing = absolute.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
    match free_bytes(existing) {
        Ok(free) => space(free, existing),
        Err(error) => {
            Finding::fail("disk", format!("`{}`: {error}", existing.display()), "choose another folder with --store")
        }
    }
}

fn space(free: u64, folder: &Path) -> Finding {
    let found = format!("{:.1} GiB are free in `{}`", free as f64 / f64::from(1 << 30), folder.display());
    let hint = "`trainer registry gc` removes unneeded data; --store selects a folder on another disk";
    match free {
        0..NONE => Finding::fail("disk", found, hint),
        NONE..LITTLE => Finding::warn("disk", found, hint),
        _ => Finding::ok("disk", found),
    }
}

/// Warns if other users may write to the store's folder, which is shown as `name`.
pub fn permissions(dir: &Path, name: &str) -> Option<Finding> {
    let mode = std::fs::metadata(dir).map_or(0, |found| found.permissions().mode());
    let found = format!("other users may write to `{name}`");
    (mode & 0o022 != 0).then(|| Finding::warn("store", found, format!("`chmod go-w {name}` prevents that")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_fails_and_a_nearly_full_one_warns() {
        for (free, state) in [(1, State::Fail), (NONE, State::Warn), (LITTLE, State::Ok)] {
            assert_eq!(space(free, Path::new("/")).state, state);
        }
    }
}
