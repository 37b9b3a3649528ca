//! The holder of a token, as a line of the token file describes it.
//!
//! Behind the token a line may have `KEY=VALUE` words, each key once. [`Caller::set`] is the one list of keys.

use protocol::{Group, Owner, WorkerId};

use crate::expiry::Expiry;
use crate::names::Names;
use crate::scope::{Scope, Scopes};

/// The holder of a token. Two lines with one name are one holder, so a token can be exchanged while both work.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// A person, a machine or a service.
    pub name: String,
    pub scopes: Scopes,
    /// `workers=`: the names that its workers may bear. `None` allows every name.
    workers: Option<Names>,
    /// `project=`: whose runs and models it sees and controls. Without one: its own, or with the scope `read` all to look at.
    pub project: Option<String>,
    /// `expires=`: from when on it is refused.
    pub expires: Option<Expiry>,
}

impl Caller {
    /// A caller without limits beyond its scopes.
    pub fn new(name: impl Into<String>, scopes: Scopes) -> Self {
        Self { name: name.into(), scopes, workers: None, project: None, expires: None }
    }

    /// Takes up the words behind the token.
    ///
    /// # Errors
    /// A word without `=`, a key that is unknown or repeated, a value that does not parse.
    pub(crate) fn set_all(&mut self, words: &[&str]) -> Result<(), String> {
        let mut keys = Vec::new();
        for word in words {
            let (key, value) =
                word.split_once('=').ok_or("expected `KEY=VALUE` behind the token, such as `workers=nodes-*`")?;
            if keys.contains(&key) {
                return Err(format!("`{key}=` stands twice"));
            }
            keys.push(key);
            self.set(key, value)?;
        }
        Ok(())
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), String> {
        match key {
            "workers" => self.workers = Some(value.parse()?),
            "project" if protocol::id::is_name(value) => self.project = Some(value.to_owned()),
            "project" => {
                let expected = "expected a letter or digit, then letters, digits, `.`, `_` or `-`, at most 64";
                return Err(format!("`{value}` is no name of a project: {expected}"));
            }
            "expires" => self.expires = Some(value.parse()?),
            _ => return Err(format!("`{key}=` is not known; expected `workers=`, `project=` or `expires=`")),
        }
        Ok(())
    }

    /// The owner of what it submits.
    pub fn owner(&self) -> Owner {
        Owner {
            name: self.name.clone(),
            project: self.project.clone(),
            promotes: self.scopes.allow(Scope::Promote),
            admin: self.scopes.allow(Scope::Admin),
        }
    }

    /// The group whose runs and models it sees; `None` sees all.
    pub fn sees(&self) -> Option<Group> {
        let sees_all = self.scopes.allow(Scope::Admin) || (self.scopes.read_all() && self.project.is_none());
        (!sees_all).then(|| self.owner().group())
    }

    /// Whether it sees what belongs to `group`; what belongs to no group is the store's user's.
    pub fn may_see(&self, group: Option<&Group>) -> bool {
        self.sees().is_none_or(|seen| group == Some(&seen))
    }

    /// Whether it controls what belongs to `group`.
    pub fn controls(&self, group: Option<&Group>) -> bool {
        self.scopes.allow(Scope::Admin) || group.is_some_and(|group| self.owner().controls(group))
    }

    /// Whether its workers may bear this name.
    pub fn may_name(&self, worker: &WorkerId) -> bool {
        self.workers.as_ref().is_none_or(|names| names.allow(worker.as_str()))
    }

    /// The names that its workers may bear, as written; `None` without a limit.
    pub fn worker_names(&self) -> Option<&Names> {
        self.workers.as_ref()
    }
}
