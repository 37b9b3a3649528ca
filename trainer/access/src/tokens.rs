//! The server's table of tokens.
//!
//! ```text
//! # NAME   SCOPES          TOKEN
//! alice    submit,promote  5f0c...
//! nodes    worker          91ab...
//! grafana  read            c2d4...
//! ```
//!
//! A file with a token alone is one of `admin`, named after the file. The name is what the log of promotions shows.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use protocol::Digest;

use crate::scope::Scopes;
use crate::secret::{FileError, Token, TokenError, entries, read_secret};

/// Who a token belongs to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// A person, a machine or a service; for logs.
    pub name: String,
    /// What it may do.
    pub scopes: Scopes,
}

/// All tokens that a server knows, by their digests.
#[derive(Debug, Clone, Default)]
pub struct Tokens(BTreeMap<Digest, Arc<Caller>>);

impl Tokens {
    /// Reads a token file.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let text = read_secret(path)?;
        let lines: Vec<_> = entries(&text).collect();
        let mut tokens = Self::default();
        for (line, words) in &lines {
            let wrong = |message: &dyn std::fmt::Display| FileError::line(path, *line, message);
            let (name, scopes, token) = match words.as_slice() {
                [token] if lines.len() == 1 => (stem(path), Scopes::all(), token),
                [name, scopes, token] => {
                    ((*name).to_owned(), scopes.parse().map_err(|error: String| wrong(&error))?, token)
                }
                _ => return Err(wrong(&"expected `NAME SCOPES TOKEN`, such as `alice submit,promote` and a token")),
            };
            if !protocol::id::is_name(&name) {
                let expected = "expected a letter or digit, then letters, digits, `.`, `_` or `-`, at most 64";
                return Err(wrong(&format!("`{name}` is no name: {expected}")));
            }
            let token: Token = token.parse().map_err(|error: TokenError| wrong(&error))?;
            if !tokens.add(name, scopes, &token) {
                return Err(wrong(&"this token stands in an earlier line as well"));
            }
        }
        if tokens.is_empty() {
            return Err(FileError::new(path, "has no token")
                .hint("write lines `NAME SCOPES TOKEN`; `openssl rand -hex 32` makes a token"));
        }
        Ok(tokens)
    }

    /// Adds a token; `false` if it is known already.
    pub fn add(&mut self, name: impl Into<String>, scopes: Scopes, token: &Token) -> bool {
        self.0.insert(token.digest(), Arc::new(Caller { name: name.into(), scopes })).is_none()
    }

    /// Whose token this is.
    pub fn find(&self, text: &str) -> Option<&Arc<Caller>> {
        self.0.get(&Digest::of(text.trim().as_bytes()))
    }

    /// Whether nobody can be let in.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

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
    fn mistakes_are_named_with_their_line_and_without_the_token() {
        for (text, expected) in [
            (format!("alice submit {A}\n{B}\n"), "line 2: expected `NAME SCOPES TOKEN`"),
            (format!("alice root {A}\n"), "line 1: `root` is no scope"),
            (format!("../a read {A}\n"), "line 1: `../a` is no name"),
            ("alice read short\n".to_owned(), "line 1: the token has 5 characters"),
            (format!("a read {A}\nb worker {A}\n"), "line 2: this token stands in an earlier line"),
            ("# nothing\n".to_owned(), "has no token"),
            ("  \n".to_owned(), "has no token"),
        ] {
            let error = read(&text).unwrap_err();
            assert!(error.contains(expected), "{error}");
            assert!(!error.contains(A), "{error}");
        }
    }
}
