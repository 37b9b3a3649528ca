//! The folder of an unfinished set, beside the folder that it becomes.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{self, File, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use protocol::digest::Hasher;

use crate::dataset::error::{FetchError, io_error};
use crate::dataset::list::Listed;
use crate::transfer::file_sha256;

/// Name of the mark that the licence was accepted.
const ACCEPTED: &str = "licence-accepted";

/// An unfinished set, held by this process.
#[derive(Debug)]
pub(crate) struct Staging {
    root: PathBuf,
    /// Holds the lock as long as it lives.
    _lock: File,
}

/// Reason for refusing the bytes of a file.
pub(crate) enum Wrong {
    Content(String),
    Io(io::Error),
}

impl Staging {
    /// Path of the unfinished set that becomes `folder`.
    pub(crate) fn root(folder: &Path) -> PathBuf {
        let mut name = folder.file_name().map_or_else(OsString::new, OsString::from);
        name.push(".part");
        folder.with_file_name(name)
    }

    /// Opens the unfinished set, or begins one.
    pub(crate) fn open(folder: &Path) -> Result<Self, FetchError> {
        let root = Self::root(folder);
        let files = root.join("files");
        fs::create_dir_all(&files).map_err(io_error(&files, 0))?;
        let path = root.join("lock");
        let lock = File::create(&path).map_err(io_error(&path, 0))?;
        match lock.try_lock() {
            Ok(()) => Ok(Self { root, _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(FetchError::Busy { folder: folder.into() }),
            Err(TryLockError::Error(error)) => Err(io_error(&path, 0)(error)),
        }
    }

    /// Returns true if the licence was accepted for the unfinished set of `folder`.
    pub(crate) fn is_accepted(folder: &Path) -> bool {
        Self::root(folder).join(ACCEPTED).is_file()
    }

    /// Records that the licence was accepted.
    pub(crate) fn accept(&self) -> Result<(), FetchError> {
        let path = self.root.join(ACCEPTED);
        fs::write(&path, "").map_err(io_error(&path, 0))
    }

    /// Place of the complete archive.
    pub(crate) fn archive(&self) -> PathBuf {
        self.root.join("archive.tar.gz")
    }

    /// Place of the archive while it arrives.
    pub(crate) fn archive_part(&self) -> PathBuf {
        self.root.join("archive.tar.gz.part")
    }

    /// Folder of the checked files.
    pub(crate) fn files(&self) -> PathBuf {
        self.root.join("files")
    }

    /// Removes the checked files from `missing`, and other files from the folder.
    pub(crate) fn check(
        &self,
        missing: &mut BTreeMap<&str, &Listed>,
        checked: &mut dyn FnMut(usize),
    ) -> Result<(), FetchError> {
        let folder = self.files();
        let mut count = 0;
        for entry in fs::read_dir(&folder).map_err(io_error(&folder, 0))? {
            let path = entry.map_err(io_error(&folder, 0))?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let matches = match missing.get(name.as_str()) {
                Some(listed) => is_listed(&path, listed).map_err(io_error(&path, 0))?,
                None => false,
            };
            if matches {
                missing.remove(name.as_str());
            } else {
                fs::remove_file(&path).map_err(io_error(&path, 0))?;
            }
            count += 1;
            checked(count);
        }
        Ok(())
    }

    /// Writes a file whose bytes are as listed. Another file leaves nothing.
    pub(crate) fn keep(&self, name: &str, listed: &Listed, mut bytes: impl Read) -> Result<(), Wrong> {
        let folder = self.files();
        let mut file = tempfile::NamedTempFile::new_in(&folder).map_err(Wrong::Io)?;
        let mut hasher = Hasher::default();
        let mut piece = vec![0; 256 << 10];
        let mut written = 0_u64;
        loop {
            let count = match bytes.read(&mut piece) {
                Ok(0) => break,
                Ok(count) => count,
                Err(error) => return Err(Wrong::Content(format!("`{name}` cannot be read: {error}"))),
            };
            written += count as u64;
            if written > listed.bytes {
                return Err(Wrong::Content(format!("`{name}` has more than {} bytes", listed.bytes)));
            }
            hasher.update(&piece[..count]);
            file.write_all(&piece[..count]).map_err(Wrong::Io)?;
        }
        if written != listed.bytes {
            return Err(Wrong::Content(format!("`{name}` has {written} bytes; expected {}", listed.bytes)));
        }
        if hasher.finish().hex() != listed.sha256 {
            return Err(Wrong::Content(format!("`{name}` has another SHA-256 than the published file")));
        }
        let file = file.persist(folder.join(name)).map_err(|error| Wrong::Io(error.error))?;
        // Temporary files are readable only by their owner.
        file.set_permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644)).map_err(Wrong::Io)
    }

    /// Makes the files durable, and renames their folder to `folder`, which is empty or missing.
    pub(crate) fn finish(self, folder: &Path) -> Result<(), FetchError> {
        let files = self.files();
        for entry in fs::read_dir(&files).map_err(io_error(&files, 0))? {
            let path = entry.map_err(io_error(&files, 0))?.path();
            sync(&path)?;
        }
        sync(&files)?;
        fs::rename(&files, folder).map_err(io_error(folder, 0))?;
        sync(folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new(".")))?;
        fs::remove_dir_all(&self.root).map_err(io_error(&self.root, 0))
    }
}

fn sync(path: &Path) -> Result<(), FetchError> {
    File::open(path).and_then(|file| file.sync_all()).map_err(io_error(path, 0))
}

/// Returns true if a file has the size and the digest of the list.
pub(crate) fn is_listed(path: &Path, listed: &Listed) -> io::Result<bool> {
    let found = fs::symlink_metadata(path)?;
    Ok(found.is_file() && found.len() == listed.bytes && file_sha256(path)? == listed.sha256)
}
