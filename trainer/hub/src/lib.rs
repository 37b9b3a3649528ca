//! Published text encoders by their names on the Hugging Face hub.
//!
//! [`Hub::folder`] gives a folder with what an encoder needs of a repository: from the cache that all programs of the hub share, else fetched into it. The cache is
//! that of `huggingface_hub`: `models--ORG--NAME/snapshots/COMMIT/FILE` leads to `models--ORG--NAME/blobs/ETAG`, and `refs/REVISION` holds the commit that a branch or
//! a tag had when it was last asked for. `HF_HOME`, `HF_HUB_CACHE`, `HF_HUB_OFFLINE`, `HF_TOKEN`, `HF_TOKEN_PATH` and `HF_ENDPOINT` mean what they mean there.
//!
//! Not the crate `hf-hub`: 1.0 brings a second TLS provider, which builds with CMake (`hf-xet`'s), and 0.5 a second HTTP client without the offline switch.
//! What is needed of it is a listing and a download. Files come whole or not at all: they are written beside their place, held against the length and, where
//! the hub says it, the SHA-256, and then renamed. A download that is cut begins anew.

mod cache;
mod remote;
mod settings;
mod wanted;

use std::path::PathBuf;

pub use settings::Settings;
pub use wanted::Encoder;

/// Why there is no folder.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// It is not in the cache, and the hub is not to be asked, or cannot be.
    #[error("`{name}` is not in the cache {}, {why}", cache.display())]
    NotHere {
        /// As the pipeline has it, with its revision.
        name: String,
        /// Where the cache is.
        cache: PathBuf,
        /// Why the hub is not asked.
        why: String,
    },
    /// The hub says no.
    #[error("{endpoint} says of `{name}`: {what}")]
    Refused {
        /// As the pipeline has it, with its revision.
        name: String,
        /// Where was asked.
        endpoint: String,
        /// What it says, and what to do.
        what: String,
    },
    /// A repository without what the encoder needs, or with something else in its place.
    #[error("`{name}`: {what}")]
    Content {
        /// As the pipeline has it, with its revision.
        name: String,
        /// What is wrong with it.
        what: String,
    },
    /// The cache cannot be written.
    #[error("{}: {source}", file.display())]
    Io {
        /// Which file.
        file: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl HubError {
    /// What to do.
    pub fn advice(&self) -> String {
        match self {
            Self::NotHere { name, .. } => {
                let bare = name.split('@').next().unwrap_or(name);
                format!(
                    "where there is a network, `hf download {bare}` or the same command without HF_HUB_OFFLINE fetches it into the cache; or copy the folder here and \
                     name it as `path`"
                )
            }
            Self::Refused { .. } => {
                "look at the name and its `revision`; what is private or gated needs HF_TOKEN".into()
            }
            Self::Content { .. } => {
                "name a repository in the layout of transformers or of sentence-transformers, or a folder".into()
            }
            Self::Io { .. } => "set HF_HOME to a folder that can be written".into(),
        }
    }
}

/// A name on the hub, `ORG/NAME`, perhaps of one revision.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Name {
    repository: String,
    revision: String,
}

/// The branch that is meant where no revision is given.
const MAIN: &str = "main";
/// First parts of paths that are folders whether they are there or not: recipes keep data in them.
const FOLDERS: [&str; 4] = ["data", "deps", "models", "weights"];

impl Name {
    /// A name and its revision, a branch, a tag or a commit; empty is the branch `main`. None if this is no name on the hub, but a path.
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

    /// Whether the revision may stand in an address and in a path.
    fn has_sound_revision(&self) -> bool {
        let plain = |part: &str| {
            !part.is_empty()
                && !part.starts_with('.')
                && part.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
        };
        self.revision.len() <= 200 && self.revision.split('/').all(plain)
    }

    /// Whether it names one commit, which never changes.
    fn is_commit(&self) -> bool {
        is_commit(&self.revision)
    }
}

fn is_commit(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|c| c.is_ascii_digit() || (b'a'..=b'f').contains(&c))
}

impl std::fmt::Display for Name {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.repository)?;
        if self.revision == MAIN { Ok(()) } else { write!(f, "@{}", self.revision) }
    }
}

/// A folder that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// The snapshot.
    pub folder: PathBuf,
    /// Its commit.
    pub commit: String,
    /// What was noticed on the way, for people.
    pub note: Option<String>,
}

/// The hub as this process sees it.
#[derive(Debug)]
pub struct Hub {
    settings: Settings,
}

impl Hub {
    /// By these settings.
    pub fn new(settings: Settings) -> Self {
        Self { settings }
    }

    /// What is in the cache; nothing is fetched.
    ///
    /// # Errors
    /// If it is not there, or not all of it.
    pub fn cached(&self, name: &Name, encoder: Encoder) -> Result<Found, HubError> {
        self.check(name)?;
        cache::find(&self.settings, name, encoder, "and nothing is fetched now")
    }

    /// From the cache, else fetched into it. A branch or a tag is asked for each time, and what it names today is fetched; where the hub cannot be reached, what it
    /// was when it was last asked for will do. Blocks; not for a thread that drives an async runtime.
    ///
    /// # Errors
    /// If it is neither here nor there, or is not such an encoder.
    pub fn folder(&self, name: &Name, encoder: Encoder, said: &mut dyn FnMut(&str)) -> Result<Found, HubError> {
        self.check(name)?;
        if self.settings.offline {
            return cache::find(&self.settings, name, encoder, "and HF_HUB_OFFLINE is set");
        }
        if name.is_commit()
            && let Ok(found) = cache::find(&self.settings, name, encoder, "")
        {
            return Ok(found);
        }
        match remote::fetch(&self.settings, name, encoder, said) {
            Ok(found) => Ok(found),
            Err(remote::Failure::Away(why)) => {
                let why = format!("and {} cannot be reached: {why}", self.settings.endpoint);
                let found = cache::find(&self.settings, name, encoder, &why)?;
                let note = format!("{why}; `{name}` is what it was when it was last fetched, commit {}", found.commit);
                Ok(Found { note: Some(note), ..found })
            }
            Err(remote::Failure::Said(error)) => Err(error),
            Err(remote::Failure::Content(what)) => {
                Err(HubError::Content { name: name.to_string(), what: format!("{what}; it is no such encoder") })
            }
        }
    }

    fn check(&self, name: &Name) -> Result<(), HubError> {
        if name.has_sound_revision() {
            return Ok(());
        }
        let what = format!("`revision` is `{}`; expected a branch, a tag or a commit", name.revision.escape_debug());
        Err(HubError::Content { name: name.repository.clone(), what })
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
