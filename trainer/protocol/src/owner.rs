//! Owners of runs and models.
//!
//! A run belongs to the token that submitted it, and keeps what that token allowed at that moment. Owners of one group see and control
//! each other's runs and models: all tokens of a project, or the tokens of one name without a project.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The token that submitted a run, as it was then.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Owner {
    /// The token's name; empty for a run of a store that knew no owners.
    pub name: String,
    /// The token's project.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub project: Option<String>,
    /// True if its pipelines may move aliases.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub promotes: bool,
    /// True if it may control objects of all owners.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub admin: bool,
}

impl Owner {
    /// The user of this machine's store, who may do everything.
    pub fn local(name: impl Into<String>) -> Self {
        Self { name: name.into(), project: None, promotes: true, admin: true }
    }

    /// The group that runs and models belong to.
    pub fn group(&self) -> Group {
        Group::of(&self.name, self.project.as_deref())
    }

    /// True if it may control runs and models of `group`.
    pub fn controls(&self, group: &Group) -> bool {
        self.admin || self.group() == *group
    }
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = if self.name.is_empty() { "unknown" } else { &self.name };
        match &self.project {
            Some(project) => write!(f, "{name} ({project})"),
            None => f.write_str(name),
        }
    }
}

/// Limits of a group, as the token file has them. `None` is no limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GroupLimits {
    /// Largest number of workers at a time.
    pub workers: Option<usize>,
    /// Largest number of runs at work; further ones are queued.
    pub runs: Option<usize>,
    /// Number of stored bytes from which submissions are refused.
    pub bytes: Option<u64>,
}

impl GroupLimits {
    /// The lower one of each limit.
    #[must_use]
    pub fn lower(self, other: Self) -> Self {
        fn lower<T: Ord>(one: Option<T>, other: Option<T>) -> Option<T> {
            match (one, other) {
                (Some(one), Some(other)) => Some(one.min(other)),
                (one, other) => one.or(other),
            }
        }
        Self {
            workers: lower(self.workers, other.workers),
            runs: lower(self.runs, other.runs),
            bytes: lower(self.bytes, other.bytes),
        }
    }
}

/// The group of an owner: `@PROJECT`, or a token's name. A name never begins with `@`.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Group(String);

impl Group {
    /// The group of a token by its name and project.
    pub fn of(name: &str, project: Option<&str>) -> Self {
        Self(project.map_or_else(|| name.to_owned(), |project| format!("@{project}")))
    }

    /// A group as it is stored.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// As it is stored.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// A client's idempotency key, apart from the same key of another group.
    pub fn key(&self, key: &str) -> String {
        format!("{}/{key}", self.0)
    }
}

impl fmt::Display for Group {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_project_is_a_group_and_so_is_a_name_without_one() {
        let owner = |name: &str, project: Option<&str>| Owner {
            name: name.into(),
            project: project.map(str::to_owned),
            ..Owner::default()
        };
        let alice = owner("alice", Some("motion"));
        let bob = owner("bob", Some("motion"));
        assert!(alice.controls(&bob.group()) && bob.controls(&alice.group()));
        let alone = owner("alice", None);
        assert!(!alone.controls(&alice.group()) && !alice.controls(&alone.group()), "her other token");
        // A person who is called as a project is, and a store without owners.
        assert!(!owner("motion", None).controls(&alice.group()));
        assert!(!alone.controls(&Owner::default().group()));
        assert!(Owner::local("root").controls(&alice.group()) && Owner::local("root").controls(&Group::default()));
        assert_ne!(alice.group().key("k"), alone.group().key("k"));
        assert_eq!((alice.to_string(), alone.to_string()), ("alice (motion)".into(), "alice".into()));
    }
}
