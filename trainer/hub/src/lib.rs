//! Downloads from public hosts: text encoders of the Hugging Face hub, and published sets of motion ([`dataset`]).
//!
//! [`Hub::folder`] returns a folder with the files of a repository that an encoder needs, from the cache or fetched
//! into it. The cache is that of `huggingface_hub`, which all programs share: `models--ORG--NAME/snapshots/COMMIT/FILE`
//! links to `models--ORG--NAME/blobs/ETAG`, and `refs/REVISION` holds the last resolved commit of a branch or tag.
//! `HF_HOME`, `HF_HUB_CACHE`, `HF_HUB_OFFLINE`, `HF_TOKEN`, `HF_TOKEN_PATH` and `HF_ENDPOINT` have the same meaning as
//! there.
//!
//! The crate `hf-hub` is not used: its 1.0 adds a second TLS provider, which builds with CMake, and it ignores
//! `HF_HUB_OFFLINE`. Only a listing and a download are needed. Files arrive whole or not at all: they are written
//! beside their place, checked against the length and, if the hub sends it, the SHA-256, and then renamed. An
//! interrupted transfer continues where the server allows it.

mod cache;
pub mod dataset;
mod error;
mod found;
mod name;
mod remote;
mod settings;
mod transfer;
mod wanted;

pub use error::HubError;
pub use found::Found;
pub use name::Name;
pub use settings::Settings;
pub use wanted::Encoder;

/// The hub with the settings of this process.
#[derive(Debug)]
pub struct Hub {
    settings: Settings,
}

impl Hub {
    /// Creates it with these settings.
    pub fn new(settings: Settings) -> Self {
        Self { settings }
    }

    /// Finds an encoder in the cache without fetching.
    ///
    /// # Errors
    /// If it is missing or incomplete.
    pub fn cached(&self, name: &Name, encoder: Encoder) -> Result<Found, HubError> {
        self.check(name)?;
        cache::find(&self.settings, name, encoder, "this command does not fetch")
    }

    /// Finds an encoder in the cache, or fetches it. A branch or a tag is resolved on the hub each time, and its
    /// current commit is fetched. If the hub cannot be reached, the last resolved commit is used. Blocks; do not call
    /// it on a thread that drives an async runtime.
    ///
    /// # Errors
    /// If it is in neither, or is not such an encoder.
    pub fn folder(&self, name: &Name, encoder: Encoder, said: &mut dyn FnMut(&str)) -> Result<Found, HubError> {
        self.check(name)?;
        if self.settings.offline {
            return cache::find(&self.settings, name, encoder, "HF_HUB_OFFLINE is set");
        }
        if name.is_commit()
            && let Ok(found) = cache::find(&self.settings, name, encoder, "")
        {
            return Ok(found);
        }
        match remote::fetch(&self.settings, name, encoder, said) {
            Ok(found) => Ok(found),
            Err(remote::Failure::Away(why)) => {
                let why = format!("{} cannot be reached: {why}", self.settings.endpoint);
                let found = cache::find(&self.settings, name, encoder, &why)?;
                let note = format!("{why}; using the cached copy of `{name}`, commit {}", found.commit);
                Ok(Found { note: Some(note), ..found })
            }
            Err(remote::Failure::Said(error)) => Err(error),
            Err(remote::Failure::Content(what)) => {
                Err(HubError::Content { name: name.to_string(), what: format!("{what}; it is not such an encoder") })
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
