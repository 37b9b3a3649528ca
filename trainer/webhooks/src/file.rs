//! The file that lists hooks.
//!
//! ```text
//! # NAME  URL                            SECRET    KEY=VALUE ...
//! lab     https://chat.example.org/hook  5f0c...   on=failed,stalled project=motion
//! ```

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;

use access::{FileError, entries, read_secret};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use protocol::Group;
use reqwest::Url;

use crate::message::Topic;

/// Maximum number of hooks; each has a connection and a place in the store.
const MOST: usize = 32;
/// Length in bytes below which a secret could be guessed.
const SHORTEST: usize = 16;
/// Prefix of secrets that are base64, as Standard Webhooks writes them.
const PREFIX: &str = "whsec_";

/// An address and the messages that it gets.
#[derive(Clone, PartialEq, Eq)]
pub struct Hook {
    /// Its name in logs and in the store.
    pub name: String,
    pub url: Url,
    secret: Vec<u8>,
    topics: BTreeSet<Topic>,
    /// Limits its messages to the runs and models of a project; `None` means all.
    pub project: Option<Group>,
}

impl fmt::Debug for Hook {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Hook").field("name", &self.name).field("topics", &self.topics).finish_non_exhaustive()
    }
}

impl Hook {
    /// Returns true if it gets messages about `topic`.
    pub fn wants(&self, topic: Topic) -> bool {
        self.topics.contains(&topic)
    }

    /// The key of its signatures.
    pub(crate) fn secret(&self) -> &[u8] {
        &self.secret
    }
}

/// All hooks of a server.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Hooks(Vec<Hook>);

impl Hooks {
    /// Reads a file that no other user may read, because it has secrets.
    ///
    /// # Errors
    /// The line with a mistake, without its secret.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let text = read_secret(path)?;
        let mut hooks: Vec<Hook> = Vec::new();
        for (line, words) in entries(&text) {
            let wrong = |message: String| FileError::line(path, line, message);
            let [name, url, secret, settings @ ..] = words.as_slice() else {
                return Err(wrong(
                    "expected `NAME URL SECRET`, such as `lab https://chat.example.org/hook` and a secret".to_owned(),
                ));
            };
            let hook = hook(name, url, secret, settings).map_err(wrong)?;
            if hooks.iter().any(|other| other.name == hook.name) {
                return Err(wrong(format!("an earlier line has the name `{name}` too")));
            }
            hooks.push(hook);
        }
        if hooks.len() > MOST {
            return Err(FileError::new(path, format!("has {} hooks; expected at most {MOST}", hooks.len())));
        }
        Ok(Self(hooks))
    }

    pub fn iter(&self) -> impl Iterator<Item = &Hook> {
        self.0.iter()
    }

    /// Returns true if there are no hooks.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

fn hook(name: &str, url: &str, secret: &str, settings: &[&str]) -> Result<Hook, String> {
    if !protocol::id::is_name(name) {
        return Err(format!(
            "`{name}` is not a valid name; expected letters, digits, `.`, `_` or `-`, at most 64 characters"
        ));
    }
    let mut hook = Hook {
        name: name.to_owned(),
        url: address(url)?,
        secret: key(secret)?,
        topics: Topic::ALL.into_iter().filter(|topic| topic.is_usual()).collect(),
        project: None,
    };
    let mut given = BTreeSet::new();
    for setting in settings {
        let (key, value) = setting.split_once('=').ok_or("expected `KEY=VALUE` after the secret")?;
        if !given.insert(key) {
            return Err(format!("`{key}=` is given twice"));
        }
        match key {
            "on" => hook.topics = value.split(',').map(topic).collect::<Result<_, _>>()?,
            "project" if protocol::id::is_name(value) => hook.project = Some(Group::of("", Some(value))),
            "project" => return Err(format!("`{value}` is not a project name")),
            _ => return Err(format!("unknown key `{key}=`; expected `on=` or `project=`")),
        }
    }
    Ok(hook)
}

/// Messages name runs and models, so they cross a network encrypted.
fn address(text: &str) -> Result<Url, String> {
    let url = Url::parse(text).map_err(|error| format!("the address is not a URL: {error}"))?;
    let host = url.host_str().unwrap_or_default();
    let is_local = host == "localhost"
        || host.trim_matches(['[', ']']).parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback());
    match url.scheme() {
        "https" => Ok(url),
        "http" if is_local => Ok(url),
        "http" => Err("the address is not encrypted; expected `https://`, or `http://` to this machine".to_owned()),
        _ => Err("the address has another scheme; expected `https://`".to_owned()),
    }
}

fn key(text: &str) -> Result<Vec<u8>, String> {
    let key = match text.strip_prefix(PREFIX) {
        Some(coded) => STANDARD.decode(coded).map_err(|_| format!("the secret after `{PREFIX}` is not base64"))?,
        None => text.as_bytes().to_vec(),
    };
    if key.len() < SHORTEST {
        let length = key.len();
        return Err(format!(
            "the secret has {length} bytes, expected at least {SHORTEST}; `openssl rand -hex 32` makes one"
        ));
    }
    Ok(key)
}

fn topic(text: &str) -> Result<Topic, String> {
    let names = || Topic::ALL.map(|topic| format!("`{}`", topic.short())).join(", ");
    let found = Topic::ALL.into_iter().find(|topic| topic.short() == text);
    found.ok_or_else(|| format!("`{text}` is not a topic; expected {}", names()))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    const SECRET: &str = "0123456789abcdef";

    fn read(text: &str) -> Result<Hooks, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("hooks");
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        Hooks::read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn a_file_lists_hooks_and_their_topics() {
        let hooks = read(&format!(
            "# who\nlab https://chat.example.org/h {SECRET}\nown http://127.0.0.1:9/ whsec_MDEyMzQ1Njc4OWFiY2RlZg== on=stalled project=motion\n"
        ));
        let hooks = hooks.unwrap();
        let [lab, own] = &hooks.0[..] else { panic!("{hooks:?}") };
        assert!(lab.wants(Topic::Failed) && lab.wants(Topic::Promoted) && !lab.wants(Topic::Cancelled));
        assert!(own.wants(Topic::Stalled) && !own.wants(Topic::Failed));
        assert_eq!(own.secret(), lab.secret(), "both ways to write a secret");
        assert_eq!((lab.project.as_ref(), own.project.as_ref()), (None, Some(&Group::of("x", Some("motion")))));
        assert!(!format!("{hooks:?}").contains("chat"), "an address may be a secret too");
    }

    #[test]
    fn mistakes_are_named_with_their_line_and_without_the_secret() {
        for (text, expected) in [
            (format!("lab {SECRET}\n"), "line 1: expected `NAME URL SECRET`"),
            (format!("-x https://a.example/ {SECRET}\n"), "line 1: `-x` is not a valid name"),
            (format!("lab chat.example.org {SECRET}\n"), "line 1: the address is not a URL"),
            (format!("lab http://chat.example.org/ {SECRET}\n"), "line 1: the address is not encrypted"),
            (format!("lab ftp://127.0.0.1/ {SECRET}\n"), "line 1: the address has another scheme"),
            ("lab https://a.example/ short\n".to_owned(), "line 1: the secret has 5 bytes"),
            ("lab https://a.example/ whsec_%%\n".to_owned(), "line 1: the secret after `whsec_` is not base64"),
            (format!("lab https://a.example/ {SECRET} on=lunch\n"), "line 1: `lunch` is not a topic"),
            (format!("lab https://a.example/ {SECRET} on=failed on=failed\n"), "line 1: `on=` is given twice"),
            (format!("lab https://a.example/ {SECRET} colour=red\n"), "line 1: unknown key `colour=`"),
            (format!("lab https://a.example/ {SECRET} project=@\n"), "line 1: `@` is not a project name"),
            (format!("a https://a.example/ {SECRET}\na https://b.example/ {SECRET}\n"), "line 2: an earlier line"),
        ] {
            let error = read(&text).unwrap_err();
            assert!(error.contains(expected), "{error}");
            assert!(!error.contains(SECRET), "{error}");
        }
        assert!(read("# none\n").unwrap().is_empty());
    }
}
