//! Settings of the hub: cache, address and token.

use std::path::{Path, PathBuf};

/// Largest size of a token's file, in bytes.
const TOKEN_BYTES: u64 = 4 << 10;

/// Settings from the environment variables.
#[derive(Clone, PartialEq, Eq)]
pub struct Settings {
    /// The folder that contains `models--*`.
    pub cache: PathBuf,
    /// Base address of the hub.
    pub endpoint: String,
    /// Token, which is sent only to the hub.
    pub token: Option<String>,
    /// True if the hub must not be used.
    pub offline: bool,
}

impl std::fmt::Debug for Settings {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let token = self.token.as_ref().map(|_| "...");
        f.debug_struct("Settings")
            .field("cache", &self.cache)
            .field("endpoint", &self.endpoint)
            .field("token", &token)
            .field("offline", &self.offline)
            .finish()
    }
}

impl Settings {
    /// Reads settings from variables by name; an empty variable counts as not set.
    pub fn of(variable: &dyn Fn(&str) -> Option<String>) -> Self {
        let variable = |name: &str| variable(name).filter(|value| !value.is_empty());
        let is_on = |name: &str| {
            variable(name).is_some_and(|value| ["1", "on", "yes", "true"].contains(&value.to_lowercase().as_str()))
        };
        let user = || PathBuf::from(variable("HOME").unwrap_or_else(|| "/".into()));
        let home = variable("HF_HOME").map(PathBuf::from).unwrap_or_else(|| {
            let cache = variable("XDG_CACHE_HOME").map_or_else(|| user().join(".cache"), PathBuf::from);
            cache.join("huggingface")
        });
        let cache = variable("HF_HUB_CACHE").or_else(|| variable("HUGGINGFACE_HUB_CACHE"));
        let file = variable("HF_TOKEN_PATH").map_or_else(|| home.join("token"), PathBuf::from);
        let implicit = || if is_on("HF_HUB_DISABLE_IMPLICIT_TOKEN") { None } else { kept_token(&file) };
        let token = variable("HF_TOKEN").map(|token| token.trim().to_owned()).or_else(implicit);
        let endpoint = variable("HF_ENDPOINT").unwrap_or_else(|| "https://huggingface.co".into());
        Self {
            cache: cache.map_or_else(|| home.join("hub"), PathBuf::from),
            endpoint: endpoint.trim_end_matches('/').to_owned(),
            token,
            offline: is_on("HF_HUB_OFFLINE") || is_on("TRANSFORMERS_OFFLINE"),
        }
    }

    /// Reads settings from this process's environment.
    pub fn of_environment() -> Self {
        Self::of(&|name| std::env::var(name).ok())
    }
}

/// Reads the token that `hf auth login` stores, if there is one.
fn kept_token(file: &Path) -> Option<String> {
    // Public repositories need no token.
    let bytes = motion::DataPath::local(file).read(TOKEN_BYTES).ok()?;
    let token = String::from_utf8(bytes).ok()?.trim().to_owned();
    (!token.is_empty()).then_some(token)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(pairs: &[(&str, &str)]) -> Settings {
        Settings::of(&|name| pairs.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).to_owned()))
    }

    #[test]
    fn variables_mean_what_they_mean_elsewhere() {
        let plain = of(&[("HOME", "/u")]);
        assert_eq!(plain.cache, Path::new("/u/.cache/huggingface/hub"));
        assert_eq!((plain.endpoint.as_str(), plain.offline, plain.token), ("https://huggingface.co", false, None));
        assert_eq!(of(&[("XDG_CACHE_HOME", "/x"), ("HF_HOME", "")]).cache, Path::new("/x/huggingface/hub"));
        assert_eq!(of(&[("XDG_CACHE_HOME", "/x"), ("HF_HOME", "/h")]).cache, Path::new("/h/hub"));
        assert_eq!(of(&[("HF_HUB_CACHE", "/c"), ("HF_HOME", "/h")]).cache, Path::new("/c"));
        assert_eq!(of(&[("HF_ENDPOINT", "http://m:1/")]).endpoint, "http://m:1");
        assert!(of(&[("HF_HUB_OFFLINE", "TRUE")]).offline && of(&[("TRANSFORMERS_OFFLINE", "1")]).offline);
        assert!(!of(&[("HF_HUB_OFFLINE", "0")]).offline);
        let home = tempfile::tempdir().unwrap();
        std::fs::write(home.path().join("token"), "hf_kept\n").unwrap();
        let path = home.path().display().to_string();
        assert_eq!(of(&[("HF_HOME", &path)]).token.as_deref(), Some("hf_kept"));
        assert_eq!(of(&[("HF_HOME", &path), ("HF_TOKEN", "hf_mine")]).token.as_deref(), Some("hf_mine"));
        assert_eq!(of(&[("HF_HOME", &path), ("HF_HUB_DISABLE_IMPLICIT_TOKEN", "1")]).token, None);
        assert!(!format!("{:?}", of(&[("HF_TOKEN", "hf_mine")])).contains("hf_mine"));
    }
}
