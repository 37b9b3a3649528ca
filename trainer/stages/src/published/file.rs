//! A file of weights whose names and shapes are known.

use std::collections::{BTreeMap, BTreeSet};

use motion::DataPath;
use protocol::excerpts;
use text_models::Weights;

use crate::context::StageError;

/// Largest number of tensors in a file; an optimizer's state triples the thousand of a large network.
pub(super) const TENSORS: usize = 20_000;
/// Largest number of names in an error.
pub(super) const SHOWN: usize = 20;

/// A file of weights, with only names and shapes read so far.
#[derive(Debug)]
pub struct Checkpoint {
    file: DataPath,
    pub(super) weights: Weights,
}

impl Checkpoint {
    /// Reads names and shapes of a file.
    ///
    /// # Errors
    /// If the file is neither torch's nor safetensors, or declares more data than it holds.
    pub fn open(file: &DataPath) -> Result<Self, StageError> {
        let weights = Weights::open_file(file).map_err(|e| StageError::Input(e.to_string()))?;
        let found = Self { file: file.clone(), weights };
        let count = found.weights.tensors().len() + found.weights.others().len();
        if count > TENSORS {
            return Err(found.refuse(format!("it has {count} tensors; expected at most {TENSORS}")));
        }
        Ok(found)
    }

    /// Summarises the names that are not in `read`, such as `t2m_textencoder (19)`; `None` if all were read.
    pub fn left_out(&self, read: &BTreeSet<String>) -> Option<String> {
        let groups = self.groups(|name| !read.contains(name));
        let count: usize = groups.values().sum();
        let words: Vec<String> = groups.iter().map(|(group, count)| format!("`{group}` ({count})")).collect();
        (count > 0).then(|| format!("{count} tensors: {}", excerpts(words.iter().map(String::as_str), SHOWN)))
    }

    /// Makes an error that names the file.
    pub fn refuse(&self, what: impl std::fmt::Display) -> StageError {
        StageError::Input(format!("{}: {what}", self.file.display()))
    }

    /// Counts tensors by the first word of their names, or by the first two words inside a dict that holds everything.
    pub(super) fn groups(&self, counts: impl Fn(&str) -> bool) -> BTreeMap<String, usize> {
        let mut groups = BTreeMap::new();
        let names = self.weights.tensors().keys().chain(self.weights.others().keys());
        for name in names.filter(|name| counts(name)) {
            let words = if name.starts_with("state_dict.") { 2 } else { 1 };
            let group: Vec<&str> = name.split('.').take(words).collect();
            *groups.entry(group.join(".")).or_default() += 1;
        }
        groups
    }
}
