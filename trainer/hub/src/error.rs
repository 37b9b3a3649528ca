//! Errors of finding an encoder.

use std::path::PathBuf;

/// No folder of the encoder can be returned.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The encoder is not in the cache, and the hub must not or cannot be reached.
    #[error("`{name}` is not in the cache {}, {why}", cache.display())]
    NotHere {
        /// Name as in the pipeline, with its revision.
        name: String,
        /// Folder of the cache.
        cache: PathBuf,
        /// Reason for not using the hub.
        why: String,
    },
    /// The hub refuses the request.
    #[error("{endpoint} says of `{name}`: {what}")]
    Refused {
        /// Name as in the pipeline, with its revision.
        name: String,
        /// Address of the hub.
        endpoint: String,
        /// Message of the hub, and the remedy.
        what: String,
    },
    /// The repository lacks files that the encoder needs, or has other content.
    #[error("`{name}`: {what}")]
    Content {
        /// Name as in the pipeline, with its revision.
        name: String,
        /// Defect of the repository.
        what: String,
    },
    /// The cache cannot be written.
    #[error("{}: {source}", file.display())]
    Io {
        /// Path of the file.
        file: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
}

impl HubError {
    /// Advice to the user.
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
