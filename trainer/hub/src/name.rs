//! Names on the hub, and their distinction from paths.

/// A name on the hub, `ORG/NAME`, with an optional revision.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Name {
    pub(crate) repository: String,
    pub(crate) revision: String,
}

/// The default branch, if no revision is given.
const MAIN: &str = "main";
/// First parts of paths that are always folders, even if they do not exist: recipes keep data in them.
const FOLDERS: [&str; 4] = ["data", "deps", "models", "weights"];

impl Name {
    /// Parses a name and its revision, a branch, a tag or a commit; an empty revision is the branch `main`. `None` if
    /// this is a path and not a name on the hub.
    pub fn of(path: &str, revision: &str) -> Option<Self> {
        let (organisation, name) = path.split_once('/')?;
        let is_part = |part: &str| {
            let plain = part.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c));
            plain && !part.is_empty() && part.len() <= 96 && !part.starts_with(['-', '.']) && !part.contains("..")
        };
        let is_name = is_part(organisation) && is_part(name) && !FOLDERS.contains(&organisation);
        let revision = if revision.is_empty() { MAIN } else { revision };
        is_name.then(|| Self { repository: path.to_owned(), revision: revision.to_owned() })
    }

    /// Returns true if the revision is safe in an address and in a path.
    pub(crate) fn has_sound_revision(&self) -> bool {
        let plain = |part: &str| {
            !part.is_empty()
                && !part.starts_with('.')
                && part.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
        };
        self.revision.len() <= 200 && self.revision.split('/').all(plain)
    }

    /// Returns true if it names one commit, which never changes.
    pub(crate) fn is_commit(&self) -> bool {
        is_commit(&self.revision)
    }
}

/// Returns true if a text is the digest of a commit.
pub(crate) fn is_commit(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|c| c.is_ascii_digit() || (b'a'..=b'f').contains(&c))
}

impl std::fmt::Display for Name {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.repository)?;
        if self.revision == MAIN { Ok(()) } else { write!(f, "@{}", self.revision) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_told_from_paths() {
        let name = |path: &str| Name::of(path, "").map(|name| name.to_string());
        assert_eq!(
            name("sentence-transformers/sentence-t5-large").as_deref(),
            Some("sentence-transformers/sentence-t5-large")
        );
        for path in [
            "data/sentence-t5-large",
            "/a/b",
            "a",
            "a/b/c",
            "./a",
            "../a",
            "a/..",
            "a/b?x",
            "a /b",
            "",
            "a/",
            "/b",
            "a/.git",
        ] {
            assert_eq!(name(path), None, "{path}");
        }
        let pinned = Name::of("a/b", "v1.0").expect("a name");
        assert_eq!((pinned.to_string().as_str(), pinned.is_commit()), ("a/b@v1.0", false));
        assert!(Name::of("a/b", &"0f".repeat(20)).expect("a name").is_commit());
        for revision in ["../x", "a//b", "a b", ".x", "a?b", "refs/../../x"] {
            assert!(!Name::of("a/b", revision).expect("a name").has_sound_revision(), "{revision}");
        }
        assert!(Name::of("a/b", "refs/pr/3").expect("a name").has_sound_revision());
    }
}
