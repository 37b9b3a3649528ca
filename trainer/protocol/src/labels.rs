//! Labels of workers, such as `gpu=h100`. A stage may require some; only workers that have all of them get its work. A
//! worker whose label has the key `only` is kept for stages that require this label.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::id::is_name;
use crate::limits;

/// A set of labels, each `KEY=VALUE`.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Labels(BTreeSet<String>);

/// The key of labels that keep a worker for the stages that require them.
const ONLY: &str = "only=";
/// The label of workers that are kept for draws. While one is here, draws require it.
pub const ONLY_DRAWS: &str = "only=draws";

/// The reason for which a label is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LabelError {
    #[error(
        "`{0}` is not a label; expected KEY=VALUE, each a letter or digit, then letters, digits, `.`, `_` or `-`, at \
         most 64 characters"
    )]
    Malformed(String),
    #[error("{0} labels; expected at most {max}", max = limits::LABELS)]
    TooMany(usize),
}

impl Labels {
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub fn iter(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(String::as_str)
    }

    /// Returns true if a worker with these labels may work on a stage that requires `required`: it has all of them, and
    /// the stage requires those for which the worker is kept.
    pub fn have(&self, required: &Self) -> bool {
        let kept = self.iter().filter(|label| label.starts_with(ONLY)).all(|label| required.0.contains(label));
        kept && required.0.is_subset(&self.0)
    }

    /// Checks labels of another process or of a file.
    ///
    /// # Errors
    /// The first label that is malformed, or too many labels.
    pub fn check(&self) -> Result<(), LabelError> {
        if self.0.len() > limits::LABELS {
            return Err(LabelError::TooMany(self.0.len()));
        }
        let is_label = |text: &String| text.split_once('=').is_some_and(|(key, value)| is_name(key) && is_name(value));
        match self.0.iter().find(|text| !is_label(text)) {
            Some(wrong) => Err(LabelError::Malformed(crate::printable(wrong).into_owned())),
            None => Ok(()),
        }
    }
}

impl FromIterator<String> for Labels {
    fn from_iter<I: IntoIterator<Item = String>>(labels: I) -> Self {
        Self(labels.into_iter().collect())
    }
}

/// Labels separated by commas.
impl FromStr for Labels {
    type Err = LabelError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let labels: Self = text.split(',').filter(|label| !label.is_empty()).map(str::to_owned).collect();
        labels.check().map(|()| labels)
    }
}

impl fmt::Display for Labels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.iter().collect::<Vec<_>>().join(","))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_pairs_of_names() {
        let read = |text: &str| text.parse::<Labels>().map(|labels| labels.to_string());
        assert_eq!(read("zone=a,gpu=h100,zone=a").as_deref(), Ok("gpu=h100,zone=a"));
        assert_eq!(read("").as_deref(), Ok(""));
        for wrong in ["gpu", "gpu=", "=h100", "gpu=h 100", "a=b=c", "gpu=h100;rm", "-x=y"] {
            assert!(read(wrong).is_err_and(|error| error.to_string().contains("KEY=VALUE")), "{wrong}");
        }
        let many: Labels = (0..=limits::LABELS).map(|i| format!("k{i}=v")).collect();
        assert_eq!(many.check(), Err(LabelError::TooMany(limits::LABELS + 1)));
    }

    #[test]
    fn a_worker_may_have_more_labels_than_a_stage_requires() {
        let labels = |text: &str| text.parse::<Labels>().unwrap_or_default();
        assert!(labels("gpu=h100,zone=a").have(&labels("gpu=h100")));
        assert!(labels("").have(&labels("")));
        assert!(!labels("gpu=a100").have(&labels("gpu=h100")));
    }

    #[test]
    fn a_worker_is_kept_for_the_stages_that_require_its_label() {
        let labels = |text: &str| text.parse::<Labels>().unwrap_or_default();
        let kept = labels("only=draws,zone=a");
        assert!(kept.have(&labels(ONLY_DRAWS)));
        assert!(kept.have(&labels("only=draws,zone=a")));
        assert!(!kept.have(&labels("")));
        assert!(!kept.have(&labels("zone=a")));
        assert!(!labels("zone=a").have(&labels(ONLY_DRAWS)));
    }
}
