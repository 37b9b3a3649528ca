//! Errors of finding an encoder.

use std::path::PathBuf;

/// No folder of the encoder can be returned.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The encoder is not in the cache, and the hub must not or cannot be reached.
    #[error("`{name}` is not in the cache {}; {why}", cache.display())]
    NotHere {
        /// Name as in the pipeline, with its revision.
        name: String,
        /// Folder of the cache.
        cache: PathBuf,
        /// Reason for not using the hub.
        why: String,
    },
    /// The hub refuses the request.
    #[error("{endpoint} refuses `{name}`: {what}")]
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
                    "to fetch it into the cache, run `hf download {bare}` or the same command without HF_HUB_OFFLINE \
                     on a machine with a network; or copy the folder here and set `path` to it"
                )
            }
            Self::Refused { .. } => {
                "check the name and `revision`; a private or gated repository needs HF_TOKEN".into()
            }
            Self::Content { .. } => {
                "use a repository in the layout of transformers or sentence-transformers, or a folder".into()
            }
            Self::Io { .. } => "set HF_HOME to a writable folder".into(),
        }
    }
}
