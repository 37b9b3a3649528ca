//! The holder of a token, as a line of the token file describes it.
//!
//! Behind the token a line may have `KEY=VALUE` words, each key once. [`Caller::set`] is the one list of keys.

use protocol::WorkerId;

use crate::names::Names;
use crate::scope::Scopes;

/// The holder of a token. Two lines with one name are one holder, so a token can be exchanged while both work.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// A person, a machine or a service.
    pub name: String,
    pub scopes: Scopes,
    /// `workers=`: the names that its workers may bear. `None` allows every name.
    workers: Option<Names>,
}

impl Caller {
    /// A caller without limits beyond its scopes.
    pub fn new(name: impl Into<String>, scopes: Scopes) -> Self {
        Self { name: name.into(), scopes, workers: None }
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
            _ => return Err(format!("`{key}=` is not known; expected `workers=`")),
        }
        Ok(())
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
