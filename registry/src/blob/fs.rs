//! Blobs in a folder: `sha256/ab/cdef...` holds the bytes whose digest begins with `ab`.
//!
//! A blob is written to `staging/`, synced, renamed to its name, and its folder synced: under a name there is never a part
//! of a blob, and once `write` returns the blob outlives a loss of power. What a killed process left in `staging/` is
//! removed by the next one that opens the store; it holds the store's lock, so nobody is writing there.

use std::fs::{self, File, FileTimes, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use checkpoint::BlobError;
use fail::fail_point;
use protocol::Digest;

use super::{Backend, Entry};

/// Free space that a blob must leave, so that the database can still be written to.
const RESERVE_BYTES: u64 = 16 << 20;

/// Blobs in a folder.
#[derive(Debug)]
pub struct Folder {
    blobs: PathBuf,
    staging: PathBuf,
    next: AtomicU64,
}

impl Folder {
    /// Opens `dir/blobs` and `dir/staging`, making them where they are missing, and clears the latter. Only for the holder
    /// of the store's lock.
    pub fn open(dir: &Path) -> io::Result<Self> {
        let folder = Self { blobs: dir.join("blobs/sha256"), staging: dir.join("staging"), next: AtomicU64::new(0) };
        fs::create_dir_all(&folder.blobs)?;
        fs::create_dir_all(&folder.staging)?;
        for entry in fs::read_dir(&folder.staging)? {
            fs::remove_file(entry?.path())?;
        }
        sync_dir(dir)?;
        sync_dir(&dir.join("blobs"))?;
        Ok(folder)
    }

    /// For reading only: makes and clears nothing.
    pub fn to_read(dir: &Path) -> Self {
        Self { blobs: dir.join("blobs/sha256"), staging: dir.join("staging"), next: AtomicU64::new(0) }
    }

    fn path(&self, digest: Digest) -> PathBuf {
        let hex = digest.hex();
        self.blobs.join(&hex[..2]).join(&hex[2..])
    }

    fn metadata(&self, digest: Digest) -> Result<Option<fs::Metadata>, BlobError> {
        let path = self.path(digest);
        match fs::metadata(&path) {
            Ok(metadata) => Ok(Some(metadata)),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(error("read", &path, &e)),
        }
    }

    fn stage(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut file = OpenOptions::new().write(true).create_new(true).open(path)?;
        fail_point!("blob::before_write");
        file.write_all(bytes)?;
        fail_point!("blob::after_write");
        fail_point!("blob::before_fsync");
        file.sync_all()?;
        fail_point!("blob::after_fsync");
        Ok(())
    }
}

impl Backend for Folder {
    fn read(&self, digest: Digest) -> Result<Vec<u8>, BlobError> {
        let path = self.path(digest);
        fs::read(&path).map_err(|e| match e.kind() {
            ErrorKind::NotFound => BlobError::NotFound(digest),
            _ => error("read", &path, &e),
        })
    }

    fn write(&self, digest: Digest, bytes: &[u8]) -> Result<(), BlobError> {
        let free = free_bytes(&self.staging).map_err(|e| error("ask for free space on", &self.staging, &e))?;
        if free < bytes.len() as u64 + RESERVE_BYTES {
            return Err(BlobError::Storage(full(&self.staging, bytes.len() as u64, free)));
        }
        let staged = self.staging.join(self.next.fetch_add(1, Ordering::Relaxed).to_string());
        let path = self.path(digest);
        self.stage(&staged, bytes).map_err(|e| {
            // The error at hand says more than one about the clean-up would; the next open clears what is left.
            let _ = fs::remove_file(&staged);
            error("write", &staged, &e)
        })?;
        let shard = path.parent().unwrap_or(&self.blobs);
        if !shard.is_dir() {
            // Another thread may make it at the same time.
            fs::create_dir_all(shard).map_err(|e| error("make", shard, &e))?;
        }
        // Always, not only by whoever made it: that one may not have come to it yet.
        sync_dir(&self.blobs).map_err(|e| error("sync", &self.blobs, &e))?;
        fail_point!("blob::before_rename");
        fs::rename(&staged, &path).map_err(|e| error("write", &path, &e))?;
        fail_point!("blob::after_rename");
        sync_dir(shard).map_err(|e| error("sync", shard, &e))
    }

    fn size(&self, digest: Digest) -> Result<Option<u64>, BlobError> {
        Ok(self.metadata(digest)?.map(|metadata| metadata.len()))
    }

    fn put_ms(&self, digest: Digest) -> Result<Option<i64>, BlobError> {
        Ok(self.metadata(digest)?.map(|metadata| modified_ms(&metadata)))
    }

    fn touch(&self, digest: Digest) -> Result<(), BlobError> {
        let path = self.path(digest);
        let touch = || -> io::Result<()> {
            let file = OpenOptions::new().append(true).open(&path)?;
            file.set_times(FileTimes::new().set_modified(SystemTime::now()))?;
            // Whoever wrote it may have been killed between the rename and the sync.
            file.sync_all()?;
            sync_dir(path.parent().unwrap_or(&self.blobs))
        };
        touch().map_err(|e| error("write", &path, &e))
    }

    fn remove(&self, digest: Digest) -> Result<(), BlobError> {
        let path = self.path(digest);
        match fs::remove_file(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(error("remove", &path, &e)),
            _ => Ok(()),
        }
    }

    fn list(&self) -> Result<Vec<Entry>, BlobError> {
        let failed = |e: io::Error| error("list", &self.blobs, &e);
        let mut entries = Vec::new();
        for shard in fs::read_dir(&self.blobs).map_err(failed)? {
            let shard = shard.map_err(failed)?;
            for blob in fs::read_dir(shard.path()).map_err(failed)? {
                let blob = blob.map_err(failed)?;
                let name = [shard.file_name(), blob.file_name()].map(|n| n.to_string_lossy().into_owned()).concat();
                let Ok(digest) = format!("sha256:{name}").parse() else { continue };
                let metadata = blob.metadata().map_err(failed)?;
                entries.push(Entry { digest, bytes: metadata.len(), put_ms: modified_ms(&metadata) });
            }
        }
        Ok(entries)
    }
}

fn modified_ms(metadata: &fs::Metadata) -> i64 {
    let since = metadata.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
    since.map_or(0, |d| i64::try_from(d.as_millis()).unwrap_or(i64::MAX))
}

/// Makes the names in a folder outlive a loss of power.
pub(crate) fn sync_dir(dir: &Path) -> io::Result<()> {
    File::open(dir)?.sync_all()
}

/// Bytes that this user may still write where `path` lies.
pub(crate) fn free_bytes(path: &Path) -> io::Result<u64> {
    let stat = nix::sys::statvfs::statvfs(path)?;
    #[expect(clippy::useless_conversion, reason = "the fields' width differs between targets")]
    Ok(u64::from(stat.blocks_available()).saturating_mul(u64::from(stat.fragment_size())))
}

fn full(path: &Path, needed: u64, free: u64) -> String {
    format!(
        "no space for {needed} bytes where `{}` lies: {free} bytes are free and {RESERVE_BYTES} are kept for the database; \
         `registry gc` removes what nothing needs, on a full disk too; then run the same command again",
        path.display()
    )
}

/// Whether an error means that the disk is full or a quota is used up.
pub(crate) fn is_full(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge)
}

/// Whether an error means that the user may not write there.
pub(crate) fn is_read_only(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem)
}

fn error(did: &str, path: &Path, e: &io::Error) -> BlobError {
    let path = path.display();
    if is_full(e) {
        BlobError::Storage(format!(
            "failed to {did} `{path}`: the disk is full or a quota is used up ({e}); `registry gc` removes what \
             nothing needs, on a full disk too; then run the same command again"
        ))
    } else if is_read_only(e) {
        BlobError::Storage(format!(
            "failed to {did} `{path}`: not writable ({e}); make it writable or choose another folder with `--store`"
        ))
    } else {
        BlobError::Unavailable(format!("failed to {did} `{path}`: {e}"))
    }
}
