//! Parsing of tokens and reading of files that contain them.

use std::fmt;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use protocol::Digest;

use crate::file::open_regular;

/// Minimum length in bytes; shorter tokens could be guessed.
const SHORTEST: usize = 16;
const LONGEST: usize = 512;
/// Limit of a token file, which has one line per caller.
const FILE_BYTES: u64 = 1 << 20;

/// The secret by which a caller authenticates. Debug output does not show it.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// Creates a token of 256 bits from the system's random generator.
    pub fn random() -> Self {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes).expect("the system has random bytes");
        Self(hex::encode(bytes))
    }

    /// The text, for the `Authorization` header.
    pub fn secret(&self) -> &str {
        &self.0
    }

    /// The digest that a server stores. Comparing digests leaks no timing information about the token.
    pub fn digest(&self) -> Digest {
        Digest::of(self.0.as_bytes())
    }

    /// Reads a client's token: a file with the token alone, or with a line `NAME SCOPES TOKEN KEY=VALUE ...` of a
    /// server's file.
    pub fn from_file(path: &Path) -> Result<Self, FileError> {
        let text = read_secret(path)?;
        let mut lines = entries(&text);
        let (Some((line, words)), None) = (lines.next(), lines.next()) else {
            return Err(FileError::new(path, "the file has no token or several; expected one")
                .hint("the token file of a client has one line with its token"));
        };
        let word = match words.as_slice() {
            [token] | [_, _, token, ..] => token,
            _ => return Err(FileError::line(path, line, "expected a token, or `NAME SCOPES TOKEN`")),
        };
        word.parse().map_err(|error: TokenError| FileError::line(path, line, error))
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

/// Errors in the text of a token. Messages do not repeat the text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TokenError {
    /// The text has only white space.
    #[error("the token is empty; `openssl rand -hex 32` makes one")]
    Empty,
    /// The token is short enough to be guessed.
    #[error("the token has {0} characters, expected at least {SHORTEST}; `openssl rand -hex 32` makes one")]
    Short(usize),
    /// The token does not fit into a header.
    #[error("the token has more than {LONGEST} characters")]
    Long,
    /// The token has characters that headers do not allow.
    #[error("the token has a space or a character that is not printable ASCII")]
    Characters,
}

impl FromStr for Token {
    type Err = TokenError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let text = text.trim();
        if text.is_empty() {
            return Err(TokenError::Empty);
        }
        if !text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(TokenError::Characters);
        }
        match text.len() {
            n if n < SHORTEST => Err(TokenError::Short(n)),
            n if n > LONGEST => Err(TokenError::Long),
            _ => Ok(Self(text.to_owned())),
        }
    }
}

/// An error in a file with a secret.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{}`{}: {message}", path.display(), line.map_or_else(String::new, |line| format!(", line {line}")))]
pub struct FileError {
    path: PathBuf,
    line: Option<usize>,
    message: String,
    hint: Option<String>,
}

impl FileError {
    pub fn new(path: &Path, message: impl fmt::Display) -> Self {
        Self { path: path.to_owned(), line: None, message: message.to_string(), hint: None }
    }

    pub fn line(path: &Path, line: usize, message: impl fmt::Display) -> Self {
        Self { line: Some(line), ..Self::new(path, message) }
    }

    pub(crate) fn hint(mut self, hint: &str) -> Self {
        self.hint = Some(hint.to_owned());
        self
    }

    /// Adds the options that name the file, unless there is other advice.
    #[must_use]
    pub fn named_by(self, options: &str) -> Self {
        if self.hint.is_some() { self } else { self.hint(&format!("{options} names this file")) }
    }

    /// The user's next action, if there is one.
    pub fn advice(&self) -> Option<&str> {
        self.hint.as_deref()
    }
}

/// Reads a file that must be closed to other users.
pub fn read_secret(path: &Path) -> Result<String, FileError> {
    let failed = |error: std::io::Error| FileError::new(path, error);
    let file = open_regular(path).map_err(failed)?;
    let metadata = file.metadata().map_err(failed)?;
    let mode = metadata.permissions().mode() & 0o777;
    if mode & 0o007 != 0 {
        return Err(FileError::new(path, format!("is open to every user of this machine (mode {mode:03o})"))
            .hint(&format!("`chmod 600 {}`; if others could read it, make a new one", path.display())));
    }
    let mut text = String::new();
    file.take(FILE_BYTES + 1).read_to_string(&mut text).map_err(failed)?;
    if text.len() as u64 > FILE_BYTES {
        return Err(FileError::new(path, "has more than 1 MiB; expected a token file"));
    }
    Ok(text)
}

/// Lines that are neither empty nor comments, with their numbers and words.
pub fn entries(text: &str) -> impl Iterator<Item = (usize, Vec<&str>)> {
    let lines = text.lines().enumerate().map(|(i, line)| (i + 1, line.split_whitespace().collect::<Vec<_>>()));
    lines.filter(|(_, words)| words.first().is_some_and(|word| !word.starts_with('#')))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn blanks_and_short_texts_are_no_tokens() {
        for (text, expected) in [
            ("", TokenError::Empty),
            (" \t\n", TokenError::Empty),
            ("secret", TokenError::Short(6)),
            ("a token with blanks in it", TokenError::Characters),
            ("ein-längerer-Schlüssel", TokenError::Characters),
            (&"x".repeat(513), TokenError::Long),
        ] {
            assert_eq!(text.parse::<Token>(), Err(expected), "{text:?}");
        }
        let token: Token = " 0123456789abcdef\n".parse().unwrap();
        assert_eq!(token.secret(), "0123456789abcdef");
        assert!(!format!("{token:?}").contains("0123"));
        assert_ne!(Token::random(), Token::random());
        assert!(Token::random().secret().parse::<Token>().is_ok());
    }

    #[test]
    fn a_file_open_to_everybody_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("token");
        std::fs::write(&path, "0123456789abcdef\n").unwrap();
        for (mode, fine) in [(0o644, false), (0o604, false), (0o602, false), (0o640, true), (0o600, true)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            let read = Token::from_file(&path);
            assert_eq!(read.is_ok(), fine, "{mode:o}: {read:?}");
            assert!(read.err().is_none_or(|error| error.advice().unwrap().contains("chmod 600")));
        }
    }

    #[test]
    fn a_clients_file_has_one_token() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("token");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
            Token::from_file(&path).map(|token| token.secret().to_owned()).map_err(|error| error.to_string())
        };
        assert_eq!(read("# mine\nw worker 0123456789abcdef\n").unwrap(), "0123456789abcdef");
        assert_eq!(read("w worker 0123456789abcdef workers=w*\n").unwrap(), "0123456789abcdef");
        assert!(read("").is_err() && read("a read 0123456789abcdef\nb read 0123456789abcdeg\n").is_err());
        assert!(
            read("\n secret\n").unwrap_err().ends_with(
                "line 2: the token has 6 characters, expected at least 16; `openssl rand -hex 32` makes one"
            )
        );
    }
}
