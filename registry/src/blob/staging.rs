//! Staging files of arriving blobs. Numbered files belong to this process. Files with a name of 64 hexadecimal digits
//! are uploads that another process may continue.

use std::collections::BTreeSet;
use std::fs::{self, OpenOptions};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use checkpoint::BlobError;

use super::disk::{Disk, DiskFile, free_bytes, regular};
use super::disk_error::error;
use crate::failpoints::fail_point;

/// Free space that a blob must leave for the database.
const RESERVE_BYTES: u64 = 16 << 20;

/// Suffix of our files; other files in the folder are foreign.
const SUFFIX: &str = ".part";

/// A folder of arriving blobs.
#[derive(Debug)]
pub(super) struct Staging {
    pub(super) dir: PathBuf,
    disk: Arc<dyn Disk>,
    next: AtomicU64,
}

impl Staging {
    /// Opens the folder and removes the files of a killed process. Only for the holder of the store's lock.
    pub(super) fn open(dir: PathBuf, disk: Arc<dyn Disk>) -> io::Result<Self> {
        fs::create_dir_all(&dir)?;
        for entry in fs::read_dir(&dir)? {
            let entry = entry?;
            if is_numbered(&entry) {
                disk.remove(&entry.path())?;
            } else if uploads_name(&entry).is_none() {
                tracing::warn!("`{}` does not belong to the store and is left alone", entry.path().display());
            }
        }
        Ok(Self { dir, disk, next: AtomicU64::new(0) })
    }

    /// Opens the folder for listing only.
    pub(super) fn to_read(dir: PathBuf, disk: Arc<dyn Disk>) -> Self {
        Self { dir, disk, next: AtomicU64::new(0) }
    }

    /// Creates a file for a blob of `bytes` bytes.
    pub(super) fn create(&self, bytes: u64) -> Result<Part, BlobError> {
        self.check_space(bytes)?;
        fail_point!("blob::before_write");
        loop {
            let path = self.path(&self.next.fetch_add(1, Ordering::Relaxed).to_string());
            match self.disk.create(&path) {
                Ok(file) => return Ok(self.part(path, file, false)),
                // A foreign folder has this name.
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(error("write", &path, &e)),
            }
        }
    }

    /// Creates the file of an upload and replaces an earlier one.
    pub(super) fn create_as(&self, name: &str, bytes: u64) -> Result<Part, BlobError> {
        self.check_space(bytes)?;
        fail_point!("blob::before_write");
        self.remove(name)?;
        let path = self.path(name);
        let file = self.disk.create(&path).map_err(|e| error("write", &path, &e))?;
        Ok(self.part(path, file, true))
    }

    /// Opens the file of an earlier upload after passing its bytes to `read`.
    pub(super) fn open_as(&self, name: &str, read: &mut dyn FnMut(&[u8])) -> Result<Option<Part>, BlobError> {
        let path = self.path(name);
        let failed = |e: io::Error| error("read", &path, &e);
        let mut arrived = match regular(OpenOptions::new().read(true), &path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(failed)?,
        };
        let mut part = vec![0; 1 << 20];
        loop {
            match arrived.read(&mut part).map_err(failed)? {
                0 => break,
                bytes => read(&part[..bytes]),
            }
        }
        let file = self.disk.open(&path).map_err(failed)?;
        Ok(Some(self.part(path, file, true)))
    }

    /// Removes the file of an upload if it exists.
    pub(super) fn remove(&self, name: &str) -> Result<(), BlobError> {
        let path = self.path(name);
        match self.disk.remove(&path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(error("remove", &path, &e)),
            _ => Ok(()),
        }
    }

    /// Removes the files of all uploads except those of `names`.
    pub(super) fn remove_but(&self, names: &BTreeSet<String>) -> Result<(), BlobError> {
        let failed = |e: io::Error| error("list", &self.dir, &e);
        for entry in fs::read_dir(&self.dir).map_err(failed)? {
            if let Some(name) = uploads_name(&entry.map_err(failed)?).filter(|name| !names.contains(name)) {
                self.remove(&name)?;
            }
        }
        Ok(())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.join(format!("{name}{SUFFIX}"))
    }

    fn part(&self, path: PathBuf, file: Box<dyn DiskFile>, stays: bool) -> Part {
        Part { path, file, disk: Arc::clone(&self.disk), stays }
    }

    fn check_space(&self, bytes: u64) -> Result<(), BlobError> {
        let free = free_bytes(&self.dir).map_err(|e| error("read the free space of", &self.dir, &e))?;
        if free < bytes.saturating_add(RESERVE_BYTES) {
            return Err(BlobError::Storage(full(&self.dir, bytes, free)));
        }
        Ok(())
    }

    /// Lists the foreign files in this folder.
    pub(super) fn strays(&self) -> io::Result<Vec<PathBuf>> {
        let entries = match fs::read_dir(&self.dir) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?.collect::<io::Result<Vec<_>>>()?,
        };
        let is_strange = |entry: &&fs::DirEntry| !is_numbered(entry) && uploads_name(entry).is_none();
        Ok(entries.iter().filter(is_strange).map(fs::DirEntry::path).collect())
    }
}

/// Returns the name of a file here without its suffix.
fn stem(entry: &fs::DirEntry) -> Option<String> {
    let name = entry.file_name();
    let stem = name.to_str()?.strip_suffix(SUFFIX)?;
    entry.file_type().is_ok_and(|kind| kind.is_file()).then(|| stem.to_owned())
}

fn is_numbered(entry: &fs::DirEntry) -> bool {
    stem(entry).is_some_and(|stem| stem.parse::<u64>().is_ok())
}

/// Returns the upload's name if the file belongs to one.
fn uploads_name(entry: &fs::DirEntry) -> Option<String> {
    stem(entry).filter(|stem| is_uploads(stem))
}

fn is_uploads(stem: &str) -> bool {
    stem.len() == 64 && stem.bytes().all(|b| b.is_ascii_hexdigit())
}

/// A blob being written. Dropping it deletes the file, unless the file was renamed or belongs to a resumable upload.
#[derive(Debug)]
pub(super) struct Part {
    pub(super) path: PathBuf,
    pub(super) file: Box<dyn DiskFile>,
    disk: Arc<dyn Disk>,
    stays: bool,
}

impl Part {
    pub(super) fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        self.file.write_all(bytes).map_err(|e| error("write", &self.path, &e))
    }

    pub(super) fn rename(&mut self, to: &Path) -> io::Result<()> {
        self.disk.rename(&self.path, to)?;
        self.stays = true;
        Ok(())
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        if !self.stays {
            // The next process that opens the store removes the file if this fails.
            let _ = self.disk.remove(&self.path);
        }
    }
}

fn full(path: &Path, needed: u64, free: u64) -> String {
    format!(
        "no space for {needed} bytes in `{}`: {free} bytes are free and {RESERVE_BYTES} are reserved for the database; \
         `registry gc` removes unneeded blobs, even on a full disk; then run the same command again",
        path.display()
    )
}
