//! Blobs in a folder: `blobs/sha256/ab/cdef...` holds the bytes whose digest starts with `ab`.
//!
//! A blob arrives in `staging/`, is synced, renamed to its name, and its folder is synced. A name therefore never shows
//! part of a blob, and a committed blob survives a power loss. An existing name is not overwritten; a damaged file
//! under it is first moved to `quarantine/`. The next process that opens the store removes files in `staging/` that a
//! killed process left, except resumable uploads. That process holds the store's lock, so no other one writes there.
//!
//! Foreign files are left alone and never opened: symbolic links are not followed, and a named pipe does not block.

use std::collections::BTreeSet;
use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use checkpoint::BlobError;
use nix::fcntl::{Flock, FlockArg};
use protocol::Digest;

use super::backend::{Backend, Entry, Staged, Stat};
use super::disk::{Disk, Os, regular, write_whole};
pub(super) use super::disk_error::error;
use super::staging::{Part, Staging};
use crate::clock;
use crate::failpoints::fail_point;

/// Backend that stores blobs in a folder.
#[derive(Debug)]
pub struct Folder(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    dir: PathBuf,
    blobs: PathBuf,
    staging: Staging,
    disk: Arc<dyn Disk>,
    /// Held while a name is checked and taken.
    naming: Mutex<()>,
}

impl Folder {
    /// Opens `dir/blobs` and `dir/staging`, creates them if missing, and clears the latter. Only for the holder of the
    /// store's lock.
    pub fn open(dir: &Path) -> io::Result<Self> {
        Self::open_on(dir, Arc::new(Os))
    }

    /// Opens a folder through another [`Disk`] than the operating system's.
    pub fn open_on(dir: &Path, disk: Arc<dyn Disk>) -> io::Result<Self> {
        let blobs = dir.join(checkpoint::BLOBS);
        fs::create_dir_all(&blobs)?;
        let staging = Staging::open(dir.join("staging"), Arc::clone(&disk))?;
        disk.sync_dir(dir)?;
        disk.sync_dir(&dir.join("blobs"))?;
        Ok(Self(Arc::new(Inner { dir: dir.to_owned(), blobs, staging, disk, naming: Mutex::default() })))
    }

    /// Opens the folder read-only: creates and clears nothing.
    pub fn to_read(dir: &Path) -> Self {
        let disk: Arc<dyn Disk> = Arc::new(Os);
        let staging = Staging::to_read(dir.join("staging"), Arc::clone(&disk));
        let blobs = dir.join(checkpoint::BLOBS);
        Self(Arc::new(Inner { dir: dir.to_owned(), blobs, staging, disk, naming: Mutex::default() }))
    }
}

impl Inner {
    fn path(&self, digest: Digest) -> PathBuf {
        checkpoint::blob_path(&self.dir, digest)
    }

    fn marker(&self) -> PathBuf {
        self.dir.join("blobs/IDENTITY")
    }

    /// Returns the metadata of a blob's file, or `None` if there is no regular file.
    fn metadata(&self, path: &Path) -> Result<Option<fs::Metadata>, BlobError> {
        let shard = path.parent().unwrap_or(&self.blobs);
        let found = fs::symlink_metadata(shard).and_then(|shard| {
            if shard.is_dir() { fs::symlink_metadata(path) } else { Err(ErrorKind::NotADirectory.into()) }
        });
        match found {
            Ok(metadata) => Ok(metadata.is_file().then_some(metadata)),
            Err(e) if is_absent(&e) => Ok(None),
            Err(e) => Err(error("read", path, &e)),
        }
    }

    fn put_aside(&self, path: &Path) -> Result<(), BlobError> {
        let folder = self.dir.join("quarantine");
        let shard = path.parent().filter(|parent| *parent != self.blobs).and_then(Path::file_name);
        let name = [shard, path.file_name()];
        let name: String = name.into_iter().flatten().map(|part| part.to_string_lossy()).collect();
        let aside = folder.join(format!("{name}.{}", clock::now_ms()));
        let moved = || -> io::Result<()> {
            self.disk.create_dir(&folder)?;
            self.disk.sync_dir(&self.dir)?;
            match self.disk.rename(path, &aside) {
                Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
                done => done?,
            }
            self.disk.sync_dir(&folder)?;
            tracing::warn!(
                "the content of `{}` does not match its name; it was moved to `{}`",
                path.display(),
                aside.display()
            );
            Ok(())
        };
        moved().map_err(|e| error("put aside", path, &e))
    }
}

impl Backend for Folder {
    fn stage(&self, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let part = self.0.staging.create(bytes)?;
        Ok(Box::new(StagedFile { part, folder: Arc::clone(&self.0) }))
    }

    fn read(&self, digest: Digest, from: u64) -> Result<Box<dyn Read + Send>, BlobError> {
        let path = self.0.path(digest);
        if self.0.metadata(&path)?.is_none() {
            return Err(BlobError::NotFound(digest));
        }
        let opened = || -> io::Result<fs::File> {
            let mut file = regular(OpenOptions::new().read(true), &path)?;
            file.seek(SeekFrom::Start(from))?;
            Ok(file)
        };
        match opened() {
            Ok(file) => Ok(Box::new(file)),
            Err(e) if e.kind() == ErrorKind::NotFound => Err(BlobError::NotFound(digest)),
            Err(e) => Err(error("read", &path, &e)),
        }
    }

    fn stat(&self, digest: Digest) -> Result<Option<Stat>, BlobError> {
        Ok(self.0.metadata(&self.0.path(digest))?.as_ref().map(stat))
    }

    fn touch(&self, digest: Digest) -> Result<Stat, BlobError> {
        let path = self.0.path(digest);
        let touch = || -> io::Result<()> {
            let mut file = self.0.disk.open(&path)?;
            file.set_modified(SystemTime::now())?;
            // Its writer may have been killed between the rename and the sync.
            file.sync()?;
            self.0.disk.sync_dir(path.parent().unwrap_or(&self.0.blobs))
        };
        touch().map_err(|e| error("write", &path, &e))?;
        self.stat(digest)?.ok_or(BlobError::NotFound(digest))
    }

    fn remove(&self, digest: Digest) -> Result<(), BlobError> {
        let path = self.0.path(digest);
        match self.0.disk.remove(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(error("remove", &path, &e)),
            _ => Ok(()),
        }
    }

    fn put_aside(&self, digest: Digest) -> Result<(), BlobError> {
        let _naming = self.0.naming.lock().unwrap_or_else(PoisonError::into_inner);
        self.0.put_aside(&self.0.path(digest))
    }

    fn list(&self) -> Result<Vec<Entry>, BlobError> {
        let failed = |e: io::Error| error("list", &self.0.blobs, &e);
        let mut entries = Vec::new();
        for_all(&self.0.blobs, |entry, digest| {
            if let Some(digest) = digest {
                // Removed since the listing.
                let Ok(metadata) = entry.metadata() else { return };
                entries.push(Entry { digest, bytes: metadata.len(), put_ms: modified_ms(&metadata) });
            }
        })
        .map_err(failed)?;
        Ok(entries)
    }

    fn is_empty(&self) -> Result<bool, BlobError> {
        let blobs = &self.0.blobs;
        let any = || -> io::Result<bool> {
            for shard in fs::read_dir(blobs)? {
                let shard = shard?.path();
                if shard.is_dir() && fs::read_dir(shard)?.next().is_some() {
                    return Ok(true);
                }
            }
            Ok(false)
        };
        match any() {
            Ok(any) => Ok(!any),
            Err(e) if is_absent(&e) => Ok(true),
            Err(e) => Err(error("list", blobs, &e)),
        }
    }

    fn strays(&self) -> Result<Vec<String>, BlobError> {
        let mut strays = self.0.staging.strays().map_err(|e| error("list", &self.0.staging.dir, &e))?;
        let listed = for_all(&self.0.blobs, |entry, digest| {
            if digest.is_none() {
                strays.push(entry.path());
            }
        });
        listed.map_err(|e| error("list", &self.0.blobs, &e))?;
        Ok(strays.iter().map(|path| path.display().to_string()).collect())
    }

    fn aside(&self) -> Result<Vec<String>, BlobError> {
        let folder = self.0.dir.join("quarantine");
        match fs::read_dir(&folder) {
            Ok(entries) => Ok(entries.flatten().map(|entry| entry.path().display().to_string()).collect()),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(Vec::new()),
            Err(e) => Err(error("list", &folder, &e)),
        }
    }

    fn stage_as(&self, name: &str, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let part = self.0.staging.create_as(name, bytes)?;
        Ok(Box::new(StagedFile { part, folder: Arc::clone(&self.0) }))
    }

    fn staged_as(&self, name: &str, read: &mut dyn FnMut(&[u8])) -> Result<Option<Box<dyn Staged>>, BlobError> {
        let part = self.0.staging.open_as(name, read)?;
        Ok(part.map(|part| -> Box<dyn Staged> { Box::new(StagedFile { part, folder: Arc::clone(&self.0) }) }))
    }

    fn unstage(&self, name: &str) -> Result<(), BlobError> {
        self.0.staging.remove(name)
    }

    fn unstage_but(&self, names: &BTreeSet<String>) -> Result<(), BlobError> {
        self.0.staging.remove_but(names)
    }

    fn marker_place(&self) -> String {
        self.0.marker().display().to_string()
    }

    fn marker(&self) -> Result<Option<String>, BlobError> {
        let path = self.0.marker();
        match regular(OpenOptions::new().read(true), &path).and_then(io::read_to_string) {
            Ok(text) => Ok(Some(text.trim_end().to_owned())),
            Err(e) if is_absent(&e) => Ok(None),
            Err(e) => Err(error("read", &path, &e)),
        }
    }

    fn set_marker(&self, old: Option<&str>, marker: &str) -> Result<bool, BlobError> {
        let path = self.0.marker();
        let blobs = self.0.dir.join("blobs");
        fs::create_dir_all(&blobs).map_err(|e| error("make", &blobs, &e))?;
        // Two processes may open stores on the same folder of blobs at once.
        let lock = blobs.join("marking");
        let failed = |e: io::Error| error("lock", &lock, &e);
        let file = OpenOptions::new().create(true).truncate(false).write(true).open(&lock).map_err(failed)?;
        let _alone = Flock::lock(file, FlockArg::LockExclusive).map_err(|(_, e)| failed(e.into()))?;
        if self.marker()?.as_deref() != old {
            return Ok(false);
        }
        write_whole(&path, format!("{marker}\n").as_bytes()).map_err(|e| error("write", &path, &e))?;
        Ok(true)
    }
}

fn is_absent(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
}

/// Calls `see` for every entry of the blob folder, with a digest if the entry is a blob.
fn for_all(blobs: &Path, mut see: impl FnMut(&fs::DirEntry, Option<Digest>)) -> io::Result<()> {
    let is_hex = |name: &str, len| name.len() == len && name.bytes().all(|b| b.is_ascii_hexdigit());
    for shard in fs::read_dir(blobs)? {
        let shard = shard?;
        let start = shard.file_name();
        let start = start.to_str().filter(|name| is_hex(name, 2));
        let (Some(start), true) = (start, shard.file_type()?.is_dir()) else {
            see(&shard, None);
            continue;
        };
        for blob in fs::read_dir(shard.path())? {
            let blob = blob?;
            let is_file = blob.file_type()?.is_file();
            let digest = blob.file_name().to_str().and_then(|end| format!("sha256:{start}{end}").parse().ok());
            see(&blob, digest.filter(|_| is_file));
        }
    }
    Ok(())
}

/// A blob being written.
#[derive(Debug)]
struct StagedFile {
    part: Part,
    folder: Arc<Inner>,
}

impl Staged for StagedFile {
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        self.part.write(bytes)
    }

    fn commit(mut self: Box<Self>, digest: Digest) -> Result<bool, BlobError> {
        fail_point!("blob::after_write");
        fail_point!("blob::before_fsync");
        self.part.file.sync().map_err(|e| error("write", &self.part.path, &e))?;
        fail_point!("blob::after_fsync");
        let folder = Arc::clone(&self.folder);
        let path = folder.path(digest);
        let shard = path.parent().unwrap_or(&folder.blobs);
        let mut made = folder.disk.create_dir(shard);
        if made.as_ref().is_err_and(|e| e.kind() == ErrorKind::AlreadyExists) {
            // A file that is not a folder has the shard's name.
            folder.put_aside(shard)?;
            made = folder.disk.create_dir(shard);
        }
        // Always synced: the thread that created the shard may not have synced it yet.
        let made = made.and_then(|()| folder.disk.sync_dir(&folder.blobs));
        made.map_err(|e| error("make", shard, &e))?;
        {
            let _naming = folder.naming.lock().unwrap_or_else(PoisonError::into_inner);
            match fs::symlink_metadata(&path) {
                Ok(metadata) if metadata.is_file() => return Ok(false),
                Ok(_) => folder.put_aside(&path)?,
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                Err(e) => return Err(error("read", &path, &e)),
            }
            fail_point!("blob::before_rename");
            self.part.rename(&path).map_err(|e| error("write", &path, &e))?;
            fail_point!("blob::after_rename");
        }
        folder.disk.sync_dir(shard).map_err(|e| error("sync", shard, &e))?;
        Ok(true)
    }
}

/// Includes the inode and the change time in the stamp, so that a change is noticed even if the modification time was
/// reset.
fn stat(metadata: &fs::Metadata) -> Stat {
    let stamp = format!(
        "{}-{}.{:09}-{}.{:09}-{}",
        metadata.len(),
        metadata.mtime(),
        metadata.mtime_nsec(),
        metadata.ctime(),
        metadata.ctime_nsec(),
        metadata.ino()
    );
    Stat { bytes: metadata.len(), put_ms: modified_ms(metadata), stamp }
}

fn modified_ms(metadata: &fs::Metadata) -> i64 {
    let since = metadata.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
    since.map_or(0, |d| i64::try_from(d.as_millis()).unwrap_or(i64::MAX))
}
