//! Why an encoder is not to be had.

use std::path::PathBuf;

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
