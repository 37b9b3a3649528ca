//! Where blobs lie while they arrive: numbered files that have no meaning yet.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use checkpoint::BlobError;
use fail::fail_point;

use super::disk::{Disk, DiskFile};
use super::fs::{error, free_bytes, full};

/// Free space that a blob must leave, so that the database can still be written to.
pub(super) const RESERVE_BYTES: u64 = 16 << 20;

/// Ends the names of our files; anything else in the folder is somebody else's.
const SUFFIX: &str = ".part";

/// A folder of arriving blobs.
#[derive(Debug)]
pub(super) struct Staging {
    pub(super) dir: PathBuf,
    disk: Arc<dyn Disk>,
    next: AtomicU64,
}

impl Staging {
    /// Opens the folder and removes what a killed process left there. Only for the holder of the store's lock.
    pub(super) fn open(dir: PathBuf, disk: Arc<dyn Disk>) -> io::Result<Self> {
        fs::create_dir_all(&dir)?;
        for entry in fs::read_dir(&dir)? {
            let entry = entry?;
            if is_ours(&entry) {
                disk.remove(&entry.path())?;
            } else {
                tracing::warn!("`{}` is not the store's and is left alone", entry.path().display());
            }
        }
        Ok(Self { dir, disk, next: AtomicU64::new(0) })
    }

    /// For listing only.
    pub(super) fn to_read(dir: PathBuf, disk: Arc<dyn Disk>) -> Self {
        Self { dir, disk, next: AtomicU64::new(0) }
    }

    /// A file for a blob of `bytes` bytes.
    pub(super) fn create(&self, bytes: u64) -> Result<Part, BlobError> {
        let free = free_bytes(&self.dir).map_err(|e| error("ask for free space on", &self.dir, &e))?;
        if free < bytes.saturating_add(RESERVE_BYTES) {
            return Err(BlobError::Storage(full(&self.dir, bytes, free)));
        }
        fail_point!("blob::before_write");
        loop {
            let path = self.dir.join(format!("{}{SUFFIX}", self.next.fetch_add(1, Ordering::Relaxed)));
            match self.disk.create(&path) {
                Ok(file) => return Ok(Part { path, file, disk: Arc::clone(&self.disk), moved: false }),
                // Somebody else's folder of that name.
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(error("write", &path, &e)),
            }
        }
    }

    /// What lies here and is not ours.
    pub(super) fn strays(&self) -> io::Result<Vec<PathBuf>> {
        let entries = match fs::read_dir(&self.dir) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?.collect::<io::Result<Vec<_>>>()?,
        };
        Ok(entries.iter().filter(|entry| !is_ours(entry)).map(fs::DirEntry::path).collect())
    }
}

fn is_ours(entry: &fs::DirEntry) -> bool {
    let name = entry.file_name();
    let number = name.to_str().and_then(|name| name.strip_suffix(SUFFIX));
    number.is_some_and(|number| number.parse::<u64>().is_ok()) && entry.file_type().is_ok_and(|kind| kind.is_file())
}

/// A blob on its way; its file goes with it unless it was moved to its name.
#[derive(Debug)]
pub(super) struct Part {
    pub(super) path: PathBuf,
    pub(super) file: Box<dyn DiskFile>,
    disk: Arc<dyn Disk>,
    moved: bool,
}

impl Part {
    pub(super) fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        self.file.write_all(bytes).map_err(|e| error("write", &self.path, &e))
    }

    pub(super) fn rename(&mut self, to: &Path) -> io::Result<()> {
        self.disk.rename(&self.path, to)?;
        self.moved = true;
        Ok(())
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        if !self.moved {
            // The next open clears what is left.
            let _ = self.disk.remove(&self.path);
        }
    }
}
