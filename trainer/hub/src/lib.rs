//! Published text encoders by their names on the Hugging Face hub.
//!
//! [`Hub::folder`] gives a folder with what an encoder needs of a repository: from the cache that all programs of the hub share, else fetched into it. The cache is
//! that of `huggingface_hub`: `models--ORG--NAME/snapshots/COMMIT/FILE` leads to `models--ORG--NAME/blobs/ETAG`, and `refs/REVISION` holds the commit that a branch or
//! a tag had when it was last asked for. `HF_HOME`, `HF_HUB_CACHE`, `HF_HUB_OFFLINE`, `HF_TOKEN`, `HF_TOKEN_PATH` and `HF_ENDPOINT` mean what they mean there.
//!
//! Not the crate `hf-hub`: its 1.0 brings a second TLS provider, which builds with CMake, and does not know `HF_HUB_OFFLINE`.
//! What is needed of it is a listing and a download. Files come whole or not at all: they are written beside their place, held against the length and, where
//! the hub says it, the SHA-256, and then renamed. A download that is cut begins anew.

mod cache;
mod error;
mod found;
mod name;
mod remote;
mod settings;
mod wanted;

pub use error::HubError;
pub use found::Found;
pub use name::Name;
pub use settings::Settings;
pub use wanted::Encoder;

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
