//! The server's table of tokens.
//!
//! ```text
//! # NAME   SCOPES          TOKEN    KEY=VALUE ...
//! alice    submit,promote  5f0c...
//! nodes    worker          91ab...  workers=nodes-*
//! grafana  read            c2d4...
//! bob      submit          77e0...  project=motion expires=2026-12-31 max_runs=4
//! protect  prod=alice,bob
//! ```
//!
//! A line `protect ALIAS=NAME,...` allows only tokens of these names and of `admin` to move that alias, in every model.
//!
//! A file with a single token and no other words gives that token the scope `admin` and the file's name. The log of
//! promotions shows the name. The keys are documented at [`Caller`].

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use protocol::{Alias, Digest, Group, GroupLimits, Owner};

use crate::caller::Caller;
use crate::scope::{Scope, Scopes};
use crate::secret::{FileError, Token, TokenError, entries, read_secret};

/// All tokens known to a server, by digest, and its protected aliases.
#[derive(Debug, Clone, Default)]
pub struct Tokens {
    callers: BTreeMap<Digest, Arc<Caller>>,
    protected: BTreeMap<Alias, BTreeSet<String>>,
}

/// The caller or owner who moves an alias.
#[derive(Debug, Clone, Copy)]
pub struct Promoter<'a> {
    pub name: &'a str,
    pub project: Option<&'a str>,
}

impl<'a> From<&'a Owner> for Promoter<'a> {
    fn from(owner: &'a Owner) -> Self {
        Self { name: &owner.name, project: owner.project.as_deref() }
    }
}

impl<'a> From<&'a Caller> for Promoter<'a> {
    fn from(caller: &'a Caller) -> Self {
        Self { name: &caller.name, project: caller.project.as_deref() }
    }
}

impl Tokens {
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let text = read_secret(path)?;
        let lines: Vec<_> = entries(&text).collect();
        let mut tokens = Self::default();
        for (line, words) in &lines {
            let wrong = |message: &dyn std::fmt::Display| FileError::line(path, *line, message);
            if let ["protect", rest @ ..] = words.as_slice()
                && !matches!(rest, [_, _, ..])
            {
                tokens.protect_line(rest).map_err(|error| wrong(&error))?;
                continue;
            }
            let (mut caller, token, settings) = match words.as_slice() {
                [token] if lines.len() == 1 => (Caller::new(stem(path), Scopes::all()), token, &[][..]),
                [name, scopes, token, settings @ ..] => {
                    let scopes = scopes.parse().map_err(|error: String| wrong(&error))?;
                    (Caller::new(*name, scopes), token, settings)
                }
                _ => return Err(wrong(&"expected `NAME SCOPES TOKEN`, such as `alice submit,promote` and a token")),
            };
            if !protocol::id::is_name(&caller.name) {
                let expected =
                    "expected a letter or digit, then letters, digits, `.`, `_` or `-`, at most 64 characters";
                return Err(wrong(&format!("`{}` is not a valid name: {expected}", caller.name)));
            }
            let token: Token = token.parse().map_err(|error: TokenError| wrong(&error))?;
            caller.set_all(settings).map_err(|error| wrong(&error))?;
            if !tokens.insert(caller, &token) {
                return Err(wrong(&"an earlier line has the same token"));
            }
        }
        if tokens.is_empty() {
            return Err(FileError::new(path, "has no token")
                .hint("write lines `NAME SCOPES TOKEN`; `openssl rand -hex 32` makes a token"));
        }
        tokens.check_protected().map_err(|error| FileError::new(path, error))?;
        Ok(tokens)
    }

    /// Adds a token; returns `false` if it was already present.
    pub fn add(&mut self, name: impl Into<String>, scopes: Scopes, token: &Token) -> bool {
        self.insert(Caller::new(name, scopes), token)
    }

    /// Adds a token with all settings of its caller; returns `false` if it was already present.
    pub fn insert(&mut self, caller: Caller, token: &Token) -> bool {
        self.callers.insert(token.digest(), Arc::new(caller)).is_none()
    }

    /// The caller with this token.
    pub fn find(&self, text: &str) -> Option<&Arc<Caller>> {
        self.find_digest(digest_of(text))
    }

    /// The caller whose token has this digest.
    pub fn find_digest(&self, digest: Digest) -> Option<&Arc<Caller>> {
        self.callers.get(&digest)
    }

    /// The limits of each group that has some.
    pub fn limits(&self) -> BTreeMap<Group, GroupLimits> {
        let mut limits: BTreeMap<Group, GroupLimits> = BTreeMap::new();
        for caller in self.callers.values().filter(|caller| caller.limits != GroupLimits::default()) {
            let of_group = limits.entry(caller.owner().group()).or_default();
            *of_group = of_group.lower(caller.limits);
        }
        limits
    }

    /// Digests of all tokens.
    pub fn digests(&self) -> impl Iterator<Item = Digest> {
        self.callers.keys().copied()
    }

    /// Restricts `alias` to tokens of these names and of `admin`.
    pub fn protect(&mut self, alias: Alias, names: impl IntoIterator<Item = String>) {
        self.protected.entry(alias).or_default().extend(names);
    }

    fn protect_line(&mut self, words: &[&str]) -> Result<(), String> {
        let [word] = words else { return Err(EXPECTED_PROTECT.to_owned()) };
        let (alias, names) = word.split_once('=').ok_or(EXPECTED_PROTECT)?;
        let alias: Alias = alias.parse().map_err(|error| format!("{error}"))?;
        if let Some(wrong) = names.split(',').find(|name| !protocol::id::is_name(name)) {
            return Err(format!("`{wrong}` is not a valid name; {EXPECTED_PROTECT}"));
        }
        self.protect(alias, names.split(',').map(str::to_owned));
        Ok(())
    }

    /// Refuses protected aliases with an unknown name, which is probably misspelt and would lock the alias.
    fn check_protected(&self) -> Result<(), String> {
        let is_known = |name: &String| self.callers.values().any(|caller| caller.name == *name);
        for (alias, names) in &self.protected {
            if let Some(name) = names.iter().find(|name| !is_known(name)) {
                return Err(format!("`protect {alias}=`: no line has the name `{name}`"));
            }
        }
        Ok(())
    }

    /// Checks that `promoter` may move `alias` of a model of `group`. A model that does not exist yet belongs to its
    /// creator. The scopes that count are those of the tokens that now have the promoter's name and project.
    ///
    /// # Errors
    /// The reason for the refusal, as text for the user.
    pub fn may_move(
        &self,
        promoter: Promoter<'_>,
        alias: &Alias,
        group: Option<&Group>,
        now_ms: u64,
    ) -> Result<(), String> {
        let Promoter { name, project } = promoter;
        let is_its = |caller: &&Arc<Caller>| {
            caller.name == name
                && caller.project.as_deref() == project
                && caller.expires.as_ref().is_none_or(|expires| !expires.is_over(now_ms))
        };
        let callers: Vec<&Arc<Caller>> = self.callers.values().filter(is_its).collect();
        let allow = |scope| callers.iter().any(|caller| caller.scopes.allow(scope));
        if callers.is_empty() {
            return Err(format!("no token of `{name}` is still valid"));
        }
        if !allow(Scope::Promote) {
            return Err(format!("the token of `{name}` does not have the scope `promote`"));
        }
        if allow(Scope::Admin) {
            return Ok(());
        }
        match self.protected.get(alias) {
            // A protected alias may be moved in every model that the caller sees.
            Some(names) if names.contains(name) && callers.iter().any(|caller| caller.may_see(group)) => Ok(()),
            Some(names) if !names.contains(name) => {
                Err(format!("alias `{alias}` is protected, and `{name}` may not move it"))
            }
            Some(_) | None if group == Some(&Group::of(name, project)) => Ok(()),
            Some(_) | None => Err(format!("the model does not belong to `{name}`")),
        }
    }

    /// Returns true if there are no tokens.
    pub fn is_empty(&self) -> bool {
        self.callers.is_empty()
    }
}

/// The digest of a token as it was sent.
pub fn digest_of(text: &str) -> Digest {
    Digest::of(text.trim().as_bytes())
}

const EXPECTED_PROTECT: &str = "expected `protect ALIAS=NAME,NAME`, such as `protect prod=alice,bob`";

fn stem(path: &Path) -> String {
    let stem = path.file_stem().and_then(|stem| stem.to_str()).filter(|stem| protocol::id::is_name(stem));
    stem.unwrap_or("admin").to_owned()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::scope::Scope;

    const A: &str = "0123456789abcdef";
    const B: &str = "fedcba9876543210";

    fn read(text: &str) -> Result<Tokens, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("stride.token");
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        Tokens::read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn a_file_names_its_callers() {
        let tokens = read(&format!("# who\n\nalice submit,promote {A}\nnodes worker {B}\n")).unwrap();
        let alice = tokens.find(A).unwrap();
        assert_eq!(alice.name, "alice");
        assert!(alice.scopes.allow(Scope::Promote) && !alice.scopes.allow(Scope::Worker));
        assert!(!tokens.find(B).unwrap().scopes.allow(Scope::Read));
        assert!(tokens.find("0123456789abcdeg").is_none());
    }

    #[test]
    fn a_token_alone_is_the_admins() {
        let tokens = read(&format!("{A}\n")).unwrap();
        let caller = tokens.find(A).unwrap();
        assert_eq!((caller.name.as_str(), caller.scopes), ("stride", Scopes::all()));
    }

    #[test]
    fn a_line_may_limit_the_names_of_its_workers() {
        let tokens = read(&format!("nodes worker {A} workers=nodes-*,gpu1\nlab worker {B}\n")).unwrap();
        let names = tokens.find(A).unwrap().worker_names().unwrap();
        assert!(names.allow("nodes-7") && names.allow("gpu1") && !names.allow("gpu2"));
        assert!(tokens.find(B).unwrap().worker_names().is_none(), "without `workers=` every name is allowed");
    }

    #[test]
    fn an_alias_moves_by_its_owners_and_a_protected_one_by_those_who_are_named() {
        let token = |n: u8| format!("0123456789abcde{n}");
        let text = format!(
            "protect prod=paul,ben\nroot admin {}\nalice promote {} project=motion\nanna submit {} project=motion\n\
             ben promote {} project=speech\npaul read,promote {}\nold promote {} expires=2020-01-01\n",
            token(0),
            token(1),
            token(2),
            token(3),
            token(4),
            token(5)
        );
        let tokens = read(&text).unwrap();
        let motion = Group::of("anna", Some("motion"));
        let may = |name: &str, project: Option<&str>, alias: &str, group: Option<&Group>| {
            let promoter = Promoter { name, project };
            tokens.may_move(promoter, &Alias::new(alias), group, 1_800_000_000_000).map_err(|why| why[..10].to_owned())
        };
        for (name, project, alias, fine) in [
            ("alice", Some("motion"), "staging", true),
            ("alice", Some("motion"), "prod", false),
            ("alice", None, "staging", false),
            ("anna", Some("motion"), "staging", false),
            ("ben", Some("speech"), "staging", false),
            ("ben", Some("speech"), "prod", false),
            ("paul", None, "prod", true),
            ("paul", None, "staging", false),
            ("root", None, "staging", true),
            ("root", None, "prod", true),
            ("nobody", None, "staging", false),
            ("old", None, "staging", false),
        ] {
            let answer = may(name, project, alias, Some(&motion));
            assert_eq!(answer.is_ok(), fine, "{name} {alias}: {answer:?}");
        }
        assert!(may("ben", Some("speech"), "prod", Some(&Group::of("ben", Some("speech")))).is_ok());
        assert!(may("root", None, "prod", None).is_ok() && may("paul", None, "staging", None).is_err());
        let old = Group::of("old", None);
        assert!(may("old", None, "staging", Some(&old)).is_err(), "its time is over");
    }

    #[test]
    fn a_project_or_a_name_says_what_is_seen() {
        let text = format!("alice submit {A} project=motion expires=2026-12-31\nbob submit,read {B}\n");
        let tokens = read(&text).unwrap();
        let alice = tokens.find(A).unwrap();
        let bob = tokens.find(B).unwrap();
        assert_eq!(alice.sees(), Some(Group::of("anna", Some("motion"))));
        assert!(alice.controls(alice.sees().as_ref()) && !alice.may_see(None));
        assert_eq!(bob.sees(), None);
        assert!(bob.may_see(alice.sees().as_ref()) && !bob.controls(alice.sees().as_ref()) && !bob.controls(None));
        assert_eq!(alice.expires.as_ref().map(ToString::to_string).as_deref(), Some("2026-12-31"));
    }

    #[test]
    fn the_lowest_limit_of_a_group_counts() {
        let text = format!(
            "alice submit {A} project=motion max_workers=8 max_runs=4\nanna submit {B} project=motion max_workers=2 max_gib=1.5\n\
             bob submit 0123456789abcde0\n"
        );
        let limits = GroupLimits { workers: Some(2), runs: Some(4), bytes: Some(3 << 29) };
        assert_eq!(read(&text).unwrap().limits(), BTreeMap::from([(Group::of("anna", Some("motion")), limits)]));
    }

    #[test]
    fn mistakes_are_named_with_their_line_and_without_the_token() {
        for (text, expected) in [
            (format!("alice submit {A}\n{B}\n"), "line 2: expected `NAME SCOPES TOKEN`"),
            (format!("alice root {A}\n"), "line 1: `root` is not a scope"),
            (format!("../a read {A}\n"), "line 1: `../a` is not a valid name"),
            ("alice read short\n".to_owned(), "line 1: the token has 5 characters"),
            (format!("a read {A}\nb worker {A}\n"), "line 2: an earlier line has the same token"),
            (format!("a worker {A} nodes-*\n"), "line 1: expected `KEY=VALUE` after the token"),
            (
                format!("a worker {A} colour=red\n"),
                "line 1: unknown key `colour=`; expected `workers=`, `project=`, `expires=`, `max_workers=`,",
            ),
            (format!("a worker {A} workers=a workers=b\n"), "line 1: `workers=` is given twice"),
            (format!("a worker {A} workers=\n"), "line 1: `` is not a name pattern"),
            (format!("a submit {A} project=@b\n"), "line 1: `@b` is not a project name"),
            (format!("a submit {A} max_runs=-1\n"), "line 1: `-1` is not a whole number"),
            (format!("a submit {A} max_gib=nan\n"), "line 1: `nan` is not a number of GiB"),
            (format!("a submit {A} max_gib=-1\n"), "line 1: `-1` is not a number of GiB"),
            (format!("a submit {A} expires=soon\n"), "line 1: `soon` is not a time"),
            (format!("a promote {A}\nprotect prod\n"), "line 2: expected `protect ALIAS=NAME,NAME`"),
            (format!("a promote {A}\nprotect prod=\n"), "line 2: `` is not a valid name"),
            (format!("a promote {A}\nprotect Prod!=a\n"), "line 2: "),
            (format!("a promote {A}\nprotect prod=a,bob\n"), "`protect prod=`: no line has the name `bob`"),
            ("protect prod=a\n".to_owned(), "has no token"),
            ("# nothing\n".to_owned(), "has no token"),
            ("  \n".to_owned(), "has no token"),
        ] {
            let error = read(&text).unwrap_err();
            assert!(error.contains(expected), "{error}");
            assert!(!error.contains(A), "{error}");
        }
    }
}
