//! Location of a store's blobs: its own folder, another folder, or an object store.
//!
//! The location is chosen when the store is created and recorded in the file `blobs/PLACE` of its folder; without the
//! file the blobs are in that folder. The marker beside the blobs names the store they belong to (`crate::identity`). A
//! lost or changed file therefore leads to an error and never to another store's blobs.

use std::fmt;
use std::fs::OpenOptions;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use checkpoint::BlobError;

use super::disk::{regular, write_whole};
use super::fs::Folder;
use super::objects::{Objects, Remote, check_url};
use super::{Backend, BlobStore};

/// A location of blobs, as a user writes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// A folder of this machine, as an absolute path.
    Folder(PathBuf),
    /// A bucket and a prefix in it, as a URL.
    Objects(String),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(path) => write!(f, "{}", path.display()),
            Self::Objects(url) => f.write_str(url),
        }
    }
}

impl FromStr for Place {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let path = match text.split_once("://") {
            None => text,
            Some(("file", path)) if path.starts_with('/') => path,
            Some(("file", _)) => return Err(format!("`{text}` is not a place for blobs: expected file:///FOLDER")),
            Some(_) => {
                check_url(text).map_err(|e| format!("`{text}` is not a place for blobs: {e}, or a folder"))?;
                return Ok(Self::Objects(text.trim_end_matches('/').to_owned()));
            }
        };
        let path = std::path::absolute(path).map_err(|e| format!("`{text}` is not a place for blobs: {e}"))?;
        Ok(Self::Folder(path.components().collect()))
    }
}

fn file(dir: &Path) -> PathBuf {
    dir.join("blobs/PLACE")
}

impl Place {
    /// Returns the recorded location of the blobs of the store in `dir`; `None` means its folder.
    pub fn remembered(dir: &Path) -> io::Result<Option<Self>> {
        let invalid = |e: String| io::Error::new(ErrorKind::InvalidData, e);
        match regular(OpenOptions::new().read(true), &file(dir)).and_then(io::read_to_string) {
            Ok(text) => text.trim_end().parse().map(Some).map_err(invalid),
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Records this location for [`Self::remembered`].
    pub(crate) fn remember(&self, dir: &Path) -> io::Result<()> {
        std::fs::create_dir_all(dir.join("blobs"))?;
        write_whole(&file(dir), format!("{self}\n").as_bytes())
    }

    /// Connects to the location for the store in `dir` and changes nothing.
    pub(crate) fn locate(&self, dir: &Path) -> Result<Location, BlobError> {
        Ok(match self {
            Self::Folder(root) => Location::Folder(root.clone()),
            Self::Objects(url) => Location::Objects(Arc::new(Remote::connect(url)?), dir.to_owned()),
        })
    }
}

/// A location that is not opened yet.
#[derive(Debug)]
pub(crate) enum Location {
    Folder(PathBuf),
    Objects(Arc<Remote>, PathBuf),
    /// A backend of the caller's that has no URL.
    Given(Arc<dyn Backend>, PathBuf),
}

impl Location {
    /// Opens the blobs read-only.
    pub(crate) fn to_read(&self) -> io::Result<Arc<dyn Backend>> {
        Ok(match self {
            Self::Folder(root) => Arc::new(Folder::to_read(root)),
            Self::Objects(remote, dir) => Arc::new(Objects::to_read(Arc::clone(remote), dir)),
            Self::Given(blobs, _) => Arc::clone(blobs),
        })
    }

    /// Returns true if other store folders may use the same location, so that this folder's lock does not protect it.
    pub(crate) fn is_shared(&self, dir: &Path) -> bool {
        match self {
            Self::Folder(root) => root != dir,
            Self::Objects(..) | Self::Given(..) => true,
        }
    }

    /// Returns the file that records verified blobs.
    pub(crate) fn verified(&self) -> PathBuf {
        match self {
            Self::Folder(dir) | Self::Objects(_, dir) | Self::Given(_, dir) => dir.join("blobs/verified"),
        }
    }

    /// Opens the blobs for writing. Only for the holder of the store's lock.
    pub(crate) fn open(&self) -> io::Result<BlobStore> {
        match self {
            Self::Folder(root) => BlobStore::open_folder(root),
            Self::Objects(remote, dir) => {
                let objects = Objects::open(Arc::clone(remote), dir)?;
                Ok(BlobStore::remembering(Arc::new(objects), &self.verified()))
            }
            Self::Given(blobs, _) => Ok(BlobStore::remembering(Arc::clone(blobs), &self.verified())),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn places_are_remembered_as_they_were_named() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(Place::remembered(dir.path()).unwrap(), None);
        for (text, place) in [
            ("s3://bucket/a/b/", Place::Objects("s3://bucket/a/b".into())),
            ("file:///mnt/blobs/", Place::Folder("/mnt/blobs".into())),
            ("/mnt/./blobs", Place::Folder("/mnt/blobs".into())),
        ] {
            assert_eq!(text.parse::<Place>().unwrap(), place);
            place.remember(dir.path()).unwrap();
            assert_eq!(Place::remembered(dir.path()).unwrap(), Some(place));
        }
        assert!("here".parse::<Place>().is_ok_and(|place| matches!(place, Place::Folder(path) if path.is_absolute())));
        for wrong in ["ftp://b/p", "file://host/p", "s3://"] {
            assert!(wrong.parse::<Place>().is_err(), "{wrong}");
        }
    }
}
