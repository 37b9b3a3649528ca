//! Requests to the hub, and download into the cache.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use protocol::limits;
use reqwest::blocking::{Client, Response};
use reqwest::header::{ETAG, HeaderMap};
use reqwest::redirect::Policy;
use reqwest::{StatusCode, Url};
use serde::Deserialize;

pub(crate) use crate::wanted::Failure;

use crate::cache::{is_sound, root, snapshot};
use crate::error::HubError;
use crate::found::Found;
use crate::name::{Name, is_commit};
use crate::settings::Settings;
use crate::transfer::{Arrived, Interrupted, Wanted, chain, client, discard, file_sha256, transfer};
use crate::wanted::{Encoder, Repository, get_all};

/// Largest size of the hub's answer about a repository, in bytes.
const LISTING_BYTES: u64 = 16 << 20;
/// Largest number of files of a repository.
const FILES: usize = 20_000;
/// Pause after the first failed attempt of a download.
const PAUSE: Duration = Duration::from_secs(1);
/// Smallest download that is logged, in bytes.
const TOLD_BYTES: u64 = 1 << 20;

/// The hub's answer about a revision.
#[derive(Deserialize)]
struct Listing {
    sha: String,
    #[serde(default)]
    siblings: Vec<Sibling>,
}

#[derive(Deserialize)]
struct Sibling {
    rfilename: String,
}

struct Remote<'a> {
    settings: &'a Settings,
    name: &'a Name,
    /// Client that follows no redirects: the first answer has the file's identity and address.
    asks: Client,
    /// Client that follows redirects to the file. The token is not sent to another host.
    fetches: Client,
    commit: String,
    names: BTreeSet<String>,
    said: &'a mut dyn FnMut(&str),
}

/// Fetches the files that are not in the cache.
pub(crate) fn fetch(
    settings: &Settings,
    name: &Name,
    encoder: Encoder,
    said: &mut dyn FnMut(&str),
) -> Result<Found, Failure> {
    let asks = client(|builder| builder.redirect(Policy::none())).map_err(Failure::Away)?;
    let fetches = client(|builder| builder.redirect(Policy::limited(5))).map_err(Failure::Away)?;
    let mut remote = Remote { settings, name, asks, fetches, commit: String::new(), names: BTreeSet::new(), said };
    remote.list()?;
    get_all(&mut remote, encoder)?;
    let commit = remote.commit;
    if !name.is_commit() {
        write_whole(&root(settings, name).join("refs").join(&name.revision), commit.as_bytes())?;
    }
    Ok(Found { folder: snapshot(settings, name, &commit), commit, note: None })
}

fn io(file: &Path) -> impl FnOnce(std::io::Error) -> Failure + '_ {
    |source| Failure::Said(HubError::Io { file: file.into(), source })
}

/// Writes a temporary file beside the target, then renames it.
fn write_whole(file: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let folder = file.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).map_err(io(folder))?;
    let mut kept = tempfile::NamedTempFile::new_in(folder).map_err(io(folder))?;
    kept.write_all(bytes).map_err(io(file))?;
    kept.persist(file).map_err(|e| io(file)(e.error))?;
    Ok(())
}

/// Name of a file in the cache, and its SHA-256 if the name is that.
struct Identity {
    etag: String,
    sha256: Option<String>,
}

fn identity(headers: &HeaderMap) -> Option<Identity> {
    let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    let etag = text("x-linked-etag").or_else(|| text(ETAG.as_str()))?;
    let etag = etag.trim_start_matches("W/").trim_matches('"').to_owned();
    let plain = etag.bytes().all(|c| c.is_ascii_alphanumeric() || c == b'-');
    let is_digest = etag.len() == 64 && etag.bytes().all(|c| c.is_ascii_hexdigit());
    (plain && (8..=128).contains(&etag.len()))
        .then(|| Identity { sha256: is_digest.then(|| etag.to_lowercase()), etag })
}

impl Remote<'_> {
    fn refused(&self, what: String) -> Failure {
        let endpoint = self.settings.endpoint.clone();
        Failure::Said(HubError::Refused { name: self.name.to_string(), endpoint, what })
    }

    fn url(&self, parts: &[&str]) -> Result<Url, Failure> {
        let endpoint = &self.settings.endpoint;
        let wrong = |why: String| Failure::Away(format!("`{endpoint}` is not a valid address ({why})"));
        let mut url = Url::parse(endpoint).map_err(|e| wrong(e.to_string()))?;
        if !matches!(url.scheme(), "http" | "https") {
            return Err(wrong("expected https".into()));
        }
        url.path_segments_mut().map_err(|()| wrong("it cannot have a path".into()))?.pop_if_empty().extend(parts);
        Ok(url)
    }

    /// Sends a request with the token, and converts failures to errors.
    fn send(&self, client: &Client, method: reqwest::Method, url: Url) -> Result<Response, Failure> {
        let request = client.request(method, url);
        let request = match &self.settings.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        };
        let answer = request.send().map_err(|e| Failure::Away(chain(&e)))?;
        match answer.status() {
            status if status.is_success() || status.is_redirection() => Ok(answer),
            status if status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS => {
                Err(Failure::Away(format!("the server answered {status}")))
            }
            status => Err(self.refusal(status)),
        }
    }

    fn refusal(&self, status: StatusCode) -> Failure {
        self.refused(match status {
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => {
                "the repository does not exist, or is private or gated; set HF_TOKEN if you have access".into()
            }
            StatusCode::NOT_FOUND => "no such repository or revision".into(),
            status => format!("{status}"),
        })
    }

    /// Resolves the revision to a commit, and lists its files.
    fn list(&mut self) -> Result<(), Failure> {
        let repository = self.name.repository.clone();
        let (organisation, name) = repository.split_once('/').unwrap_or(("", &repository));
        let url = self.url(&["api", "models", organisation, name, "revision", &self.name.revision])?;
        // The hub redirects from the old name of a renamed repository.
        let answer = self.send(&self.fetches, reqwest::Method::GET, url)?;
        let mut bytes = Vec::new();
        answer.take(LISTING_BYTES + 1).read_to_end(&mut bytes).map_err(|e| Failure::Away(e.to_string()))?;
        let listing: Option<Listing> = serde_json::from_slice(&bytes).ok();
        let listing = listing.filter(|listing| is_commit(&listing.sha) && listing.siblings.len() <= FILES);
        let listing = listing
            .ok_or_else(|| self.refused("the answer is not a list of files; check that the address is a hub".into()))?;
        self.commit = listing.sha;
        self.names = listing.siblings.into_iter().map(|one| one.rfilename).filter(|name| is_sound(name)).collect();
        Ok(())
    }

    /// Fetches a file to its blob, or directly to its place if the hub sends no identity.
    fn download(&mut self, name: &str, place: &Path) -> Result<(), Failure> {
        let repository = self.name.repository.clone();
        let parts: Vec<&str> =
            repository.split('/').chain(["resolve", self.commit.as_str()]).chain(name.split('/')).collect();
        let url = self.url(&parts)?;
        let identity = identity(self.send(&self.asks, reqwest::Method::HEAD, url.clone())?.headers());
        let root = root(self.settings, self.name);
        let blob = identity.as_ref().map_or_else(|| place.to_owned(), |known| root.join("blobs").join(&known.etag));
        if !blob.is_file() {
            let sha256 = identity.as_ref().and_then(|known| known.sha256.as_deref());
            self.keep(name, url, &blob, sha256)?;
        }
        if blob == place {
            return Ok(());
        }
        let folder = place.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(folder).map_err(io(folder))?;
        // Relative path from `snapshots/COMMIT/a/b` to `blobs/ETAG`.
        let up = "../".repeat(2 + name.matches('/').count());
        let target = PathBuf::from(up).join("blobs").join(blob.file_name().unwrap_or_default());
        match std::os::unix::fs::symlink(target, place) {
            // Another process made the link first.
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Ok(()),
            made => made.map_err(io(place)),
        }
    }

    /// Fetches a file to `blob`, once it is complete and verified. One process at a time fetches it.
    fn keep(&mut self, name: &str, url: Url, blob: &Path, sha256: Option<&str>) -> Result<(), Failure> {
        let folder = blob.parent().unwrap_or(Path::new("."));
        fs::create_dir_all(folder).map_err(io(folder))?;
        let _held = self.lock(blob)?;
        if blob.is_file() {
            return Ok(());
        }
        let mut part = blob.as_os_str().to_owned();
        part.push(".incomplete");
        let part = PathBuf::from(part);
        let wanted = Wanted {
            url,
            token: self.settings.token.as_deref(),
            most: limits::WEIGHTS_BYTES,
            fixed: sha256.is_some(),
            pause: PAUSE,
        };
        let mut announced = false;
        let repository = self.name;
        let said = &mut *self.said;
        let mut arrived = |arrived: Arrived| {
            if let Some(bytes) = arrived.of.filter(|bytes| !announced && *bytes >= TOLD_BYTES) {
                said(&format!("fetching {name} of {repository} ({} MB)", bytes >> 20));
                announced = true;
            }
        };
        transfer(&self.fetches, &wanted, &part, &mut arrived).map_err(|why| self.interrupted(name, why))?;
        if let Some(expected) = sha256 {
            let found = file_sha256(&part).map_err(io(&part))?;
            if found != expected {
                discard(&part);
                return Err(self.refused(format!("the download of `{name}` has the wrong digest")));
            }
        }
        fs::rename(&part, blob).map_err(io(blob))?;
        discard(&part);
        File::open(blob).and_then(|kept| readable(&kept)).map_err(io(blob))
    }

    /// Takes the lock of a file in the cache, which other programs of the hub take too.
    fn lock(&self, blob: &Path) -> Result<File, Failure> {
        let root = root(self.settings, self.name);
        let folder = self.settings.cache.join(".locks").join(root.file_name().unwrap_or_default());
        fs::create_dir_all(&folder).map_err(io(&folder))?;
        let name = format!("{}.lock", blob.file_name().unwrap_or_default().to_string_lossy());
        let file = File::create(folder.join(name)).map_err(io(&folder))?;
        match file.lock() {
            // Some network file systems have no locks. Two processes may then fetch one file, which the digest detects.
            Err(error) if error.kind() == std::io::ErrorKind::Unsupported => Ok(file),
            locked => locked.map(|()| file).map_err(io(&folder)),
        }
    }

    fn interrupted(&self, name: &str, why: Interrupted) -> Failure {
        match why {
            Interrupted::Away(why) => Failure::Away(format!("the download of `{name}`: {why}")),
            Interrupted::Refused(status) => self.refusal(status),
            Interrupted::TooLarge => {
                let most = limits::WEIGHTS_BYTES;
                self.refused(format!("`{name}` has more than {most} bytes, the largest supported size"))
            }
            Interrupted::Io(file, source) => Failure::Said(HubError::Io { file, source }),
        }
    }
}

/// Temporary files are readable only by their owner; files in the cache are for all users who can read the cache.
fn readable(file: &File) -> std::io::Result<()> {
    file.set_permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644))
}

impl Repository for Remote<'_> {
    fn names(&self) -> &BTreeSet<String> {
        &self.names
    }

    fn get(&mut self, name: &str) -> Result<PathBuf, Failure> {
        let place = snapshot(self.settings, self.name, &self.commit).join(name);
        if !place.is_file() {
            self.download(name, &place)?;
        }
        Ok(place)
    }
}
