//! Files and folders outside the store, by the settings that name them.
//!
//! The only way for a stage to open a path of its settings. The content has the digest in the stage's key, which is
//! checked before and after reading. A stage builds no path itself (`tests/layers.rs` checks this).

use std::collections::BTreeMap;

use motion::DataPath;
use motion::data_access::{AccessError, Opened};
pub use motion::data_access::{DataAccess, open_roots};
use protocol::Digest;

use crate::context::{AttemptContext, StageError};

/// The files and folders that a task's settings name, by field.
#[derive(Debug)]
pub struct Given(BTreeMap<String, Opened>);

impl Given {
    /// The path in the field `field`, if there is one.
    pub fn get(&self, field: &str) -> Option<&DataPath> {
        self.0.get(field).map(Opened::path)
    }

    /// The path in the field `field`.
    ///
    /// # Errors
    /// If it names nothing.
    pub fn path(&self, field: &str) -> Result<&DataPath, StageError> {
        self.get(field).ok_or_else(|| StageError::Input(format!("`{field}` is empty; name a file or folder")))
    }
}

/// Opens the files and folders that the task's settings name, calls `read`, and fails if one of them changed meanwhile.
///
/// # Errors
/// If a path may not be read, its content is not the expected one, or `read` fails. [`StageError::Interrupted`] if the
/// grant ends or a stop is requested during digesting.
pub fn read<C: AttemptContext + ?Sized, T>(
    cx: &mut C,
    read: impl FnOnce(&mut C, &Given) -> Result<T, StageError>,
) -> Result<T, StageError> {
    let access = cx.data();
    let task = cx.task();
    let go_on = || !cx.interrupted();
    let mut given = Given(BTreeMap::new());
    for folder in task.settings.folders() {
        let expected = task.inputs.get(&folder.field);
        given.0.insert(folder.field.clone(), access.open(folder, expected, &go_on).map_err(refusal)?);
    }
    let value = read(cx, &given)?;
    let go_on = || !cx.interrupted();
    given.0.values().try_for_each(|opened| access.expect_unchanged(opened, &go_on)).map_err(refusal)?;
    Ok(value)
}

/// Digests of all that the settings of the task name, for a stage that came without them.
///
/// # Errors
/// If something may not or cannot be read.
pub fn digests(cx: &dyn AttemptContext) -> Result<BTreeMap<String, Digest>, StageError> {
    let access = cx.data();
    let folders = cx.task().settings.folders().into_iter();
    folders
        .map(|folder| Ok((folder.field.clone(), access.digest(&folder, &|| !cx.interrupted()).map_err(refusal)?)))
        .collect()
}

fn refusal(error: AccessError) -> StageError {
    let text = error.to_string();
    match error {
        AccessError::NoRoots { .. }
        | AccessError::Outside { .. }
        | AccessError::Differs { .. }
        | AccessError::Unreadable(_) => StageError::Input(text),
        AccessError::Interrupted => StageError::Interrupted,
        // Another try finds it settled, or different.
        AccessError::Changed { .. } | AccessError::Unresolved { .. } => StageError::Fault(text),
    }
}
