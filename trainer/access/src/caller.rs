//! The caller behind a token, as one line of the token file describes it.
//!
//! `KEY=VALUE` words may follow the token, each key at most once. [`Caller::set`] is the only list of keys.

use protocol::{Group, GroupLimits, Owner};

use crate::expiry::Expiry;
use crate::names::Names;
use crate::scope::{Scope, Scopes};

/// A token's caller. Lines with the same name are one caller, so a token can be replaced while the old one still works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// A person, a machine or a service.
    pub name: String,
    pub scopes: Scopes,
    /// `workers=`: allowed names of its workers. `None` allows every name.
    workers: Option<Names>,
    /// `project=`: the project whose runs and models it sees and controls. Without a project, it sees and controls its
    /// own; the scope `read` lets it see all.
    pub project: Option<String>,
    /// `expires=`: the moment from which the token is refused.
    pub expires: Option<Expiry>,
    /// `max_workers=`, `max_runs=` and `max_gib=`: limits of its group. The lowest of all lines of the group counts.
    pub limits: GroupLimits,
}

impl Caller {
    /// A caller without limits beyond its scopes.
    pub fn new(name: impl Into<String>, scopes: Scopes) -> Self {
        Self { name: name.into(), scopes, workers: None, project: None, expires: None, limits: GroupLimits::default() }
    }

    /// Applies the `KEY=VALUE` words that follow the token.
    ///
    /// # Errors
    /// A word without `=`, an unknown or repeated key, or a value that does not parse.
    pub(crate) fn set_all(&mut self, words: &[&str]) -> Result<(), String> {
        let mut keys = Vec::new();
        for word in words {
            let (key, value) =
                word.split_once('=').ok_or("expected `KEY=VALUE` after the token, such as `workers=nodes-*`")?;
            if keys.contains(&key) {
                return Err(format!("`{key}=` is given twice"));
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
                let expected =
                    "expected a letter or digit, then letters, digits, `.`, `_` or `-`, at most 64 characters";
                return Err(format!("`{value}` is not a project name: {expected}"));
            }
            "expires" => self.expires = Some(value.parse()?),
            "max_workers" => self.limits.workers = Some(whole(value)?),
            "max_runs" => self.limits.runs = Some(whole(value)?),
            "max_gib" => self.limits.bytes = Some(gib(value)?),
            _ => {
                let known = "`workers=`, `project=`, `expires=`, `max_workers=`, `max_runs=` or `max_gib=`";
                return Err(format!("unknown key `{key}=`; expected {known}"));
            }
        }
        Ok(())
    }

    /// The owner recorded for its submissions.
    pub fn owner(&self) -> Owner {
        Owner {
            name: self.name.clone(),
            project: self.project.clone(),
            promotes: self.scopes.allow(Scope::Promote),
            admin: self.scopes.allow(Scope::Admin),
        }
    }

    /// The group whose runs and models it sees; `None` means all.
    pub fn sees(&self) -> Option<Group> {
        let sees_all = self.scopes.allow(Scope::Admin) || (self.scopes.read_all() && self.project.is_none());
        (!sees_all).then(|| self.owner().group())
    }

    /// Returns true if it sees the data of `group`. Data without a group belongs to the store's user.
    pub fn may_see(&self, group: Option<&Group>) -> bool {
        self.sees().is_none_or(|seen| group == Some(&seen))
    }

    /// Returns true if it controls the data of `group`.
    pub fn controls(&self, group: Option<&Group>) -> bool {
        self.scopes.allow(Scope::Admin) || group.is_some_and(|group| self.owner().controls(group))
    }

    /// The allowed names of its workers, as written; `None` allows every name.
    pub fn worker_names(&self) -> Option<&Names> {
        self.workers.as_ref()
    }
}

fn whole(value: &str) -> Result<usize, String> {
    value.parse().map_err(|_| format!("`{value}` is not a whole number"))
}

/// Parses a number of GiB, such as `500` or `0.5`.
fn gib(value: &str) -> Result<u64, String> {
    let most = f64::from(u32::MAX);
    let number = value.parse::<f64>().ok().filter(|number| (0.0..=most).contains(number));
    let number = number.ok_or_else(|| format!("`{value}` is not a number of GiB"))?;
    Ok((number * f64::from(1 << 30)) as u64)
}
