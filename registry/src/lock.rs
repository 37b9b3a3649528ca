//! Locks of a store. The lock is the operating system's (`flock`), so it ends with its process, even after a crash. The
//! file only names the holder and means nothing without the lock.

use std::fmt;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::blob::disk::regular;

/// A process that holds a store.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holder {
    /// Process id; 0 if unknown.
    pub pid: u32,
    /// Description for messages, such as `trainer run configs/quickstart.yaml`.
    pub what: String,
    /// Address of its server, such as `http://127.0.0.1:7070`, once it has one.
    pub address: Option<String>,
}

impl Holder {
    /// Describes this process.
    pub fn this_process(what: impl Into<String>) -> Self {
        Self { pid: std::process::id(), what: what.into(), address: None }
    }
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.pid {
            0 => f.write_str(&self.what)?,
            pid => write!(f, "`{}` (process {pid})", self.what)?,
        }
        match &self.address {
            Some(address) => write!(f, " at {address}"),
            None => Ok(()),
        }
    }
}

/// The lock of a store, held until it is dropped.
#[derive(Debug)]
pub(crate) struct StoreLock {
    file: File,
    holder: Mutex<Holder>,
}

/// Result of taking the lock.
pub(crate) enum Taken {
    Ours(StoreLock),
    Busy(Holder),
}

/// Time for which an opening waits for commands that read the store; each of them is short.
const READERS_END: Duration = Duration::from_secs(10);
const BETWEEN: Duration = Duration::from_millis(20);

/// Lock of processes that read a store without a holder.
#[derive(Debug)]
pub(crate) struct SharedLock(#[expect(dead_code, reason = "the lock lasts as long as the file is open")] File);

impl SharedLock {
    /// Takes the lock; `None` if the store has a holder. A store without the file is free and not locked: it is being
    /// created, or was copied without the file.
    pub(crate) fn try_take(path: &Path) -> io::Result<Option<Self>> {
        let file = match regular(OpenOptions::new().read(true), path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(e),
        };
        match file.try_lock_shared() {
            Ok(()) => Ok(Some(Self(file))),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(e)) => Err(e),
        }
    }
}

/// Returns the holder of the store with its lock at `path`, if there is one.
pub(crate) fn holder(path: &Path) -> io::Result<Option<Holder>> {
    let file = match regular(OpenOptions::new().read(true), path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e),
    };
    match file.try_lock_shared() {
        Ok(()) => Ok(None),
        Err(TryLockError::WouldBlock) => read(file).map(Some),
        Err(TryLockError::Error(e)) => Err(e),
    }
}

/// Lock between a collection, which takes it alone, and copies, which share it.
#[derive(Debug)]
pub(crate) struct CollectionLock(#[expect(dead_code, reason = "the lock lasts as long as the file is open")] File);

impl CollectionLock {
    pub(crate) fn path(dir: &Path) -> PathBuf {
        dir.join("collecting")
    }

    /// Waits for copies to end and blocks new ones.
    pub(crate) async fn collect(dir: &Path) -> io::Result<Self> {
        Self::wait(dir, File::try_lock).await
    }

    /// Waits for a collection to end and blocks new ones.
    pub(crate) async fn keep_away(dir: &Path) -> io::Result<Self> {
        Self::wait(dir, File::try_lock_shared).await
    }

    async fn wait(dir: &Path, lock: fn(&File) -> Result<(), TryLockError>) -> io::Result<Self> {
        let path = Self::path(dir);
        let file = match regular(OpenOptions::new().read(true), &path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                regular(OpenOptions::new().write(true).create(true).truncate(false), &path)?
            }
            opened => opened?,
        };
        loop {
            match lock(&file) {
                Ok(()) => return Ok(Self(file)),
                Err(TryLockError::Error(e)) => return Err(e),
                Err(TryLockError::WouldBlock) => tokio::time::sleep(BETWEEN).await,
            }
        }
    }
}

impl StoreLock {
    /// Takes the lock after waiting for read-only commands to end.
    pub(crate) async fn take(path: &Path, holder: Holder) -> io::Result<Taken> {
        let until = Instant::now() + READERS_END;
        loop {
            let file = regular(OpenOptions::new().read(true).write(true).create(true).truncate(false), path)?;
            match file.try_lock() {
                Ok(()) => {
                    let lock = Self { file, holder: Mutex::new(holder.clone()) };
                    lock.write(&holder)?;
                    return Ok(Taken::Ours(lock));
                }
                Err(TryLockError::Error(e)) => return Err(e),
                Err(TryLockError::WouldBlock) => {}
            }
            // A lock that can be shared is held only by readers.
            if SharedLock::try_take(path)?.is_none() {
                return Ok(Taken::Busy(read(file)?));
            }
            if Instant::now() >= until {
                let what = "commands that read it".to_owned();
                return Ok(Taken::Busy(Holder { pid: 0, what, address: None }));
            }
            tokio::time::sleep(BETWEEN).await;
        }
    }

    pub(crate) fn holder(&self) -> Holder {
        self.holder.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }

    pub(crate) fn set_address(&self, address: String) -> io::Result<()> {
        let mut holder = self.holder.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        holder.address = Some(address);
        self.write(&holder)
    }

    /// Writes a whole line before truncating, so that a concurrent reader sees either the old or the new line.
    fn write(&self, holder: &Holder) -> io::Result<()> {
        let mut text = serde_json::to_string(holder)?;
        text.push('\n');
        self.file.write_all_at(text.as_bytes(), 0)?;
        self.file.set_len(text.len() as u64)
    }
}

fn read(mut file: File) -> io::Result<Holder> {
    let mut text = String::new();
    file.read_to_string(&mut text)?;
    let line = text.lines().next().unwrap_or_default();
    // The holder may not have written its name yet.
    Ok(serde_json::from_str(line).unwrap_or(Holder { pid: 0, what: "another process".into(), address: None }))
}

/// Returns the network file system of `path`, if SQLite's locks do not work on it.
#[cfg(target_os = "linux")]
pub(crate) fn network_filesystem(path: &Path) -> io::Result<Option<&'static str>> {
    let kind = nix::sys::statfs::statfs(path)?.filesystem_type().0;
    // The width of the field differs between targets; the magic numbers have 32 bits.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "magic numbers have 32 bits")]
    Ok(network_kind(kind as u32))
}

/// Other systems report no number for the kind, so nothing is refused.
#[cfg(not(target_os = "linux"))]
pub(crate) fn network_filesystem(_: &Path) -> io::Result<Option<&'static str>> {
    Ok(None)
}

#[cfg(any(target_os = "linux", test))]
fn network_kind(magic: u32) -> Option<&'static str> {
    // Numbers from statfs(2) and the kernel's `magic.h`.
    Some(match magic {
        0x6969 => "NFS",
        0xFF53_4D42 | 0xFE53_4D42 | 0x517B => "SMB",
        0x5346_414F | 0x6B41_4653 => "AFS",
        0x00C3_6400 => "CephFS",
        0x0BD0_0BD0 => "Lustre",
        0x4750_4653 => "GPFS",
        0x1983_0326 => "BeeGFS",
        _ => return None,
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn network_kinds_are_told_from_local_ones() {
        assert_eq!(network_kind(0x6969), Some("NFS"));
        assert_eq!(network_kind(0xEF53), None, "ext4");
        assert_eq!(network_kind(0x0102_1994), None, "tmpfs");
    }

    #[tokio::test]
    async fn the_second_learns_who_was_first_and_the_lock_ends_with_its_holder() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let Taken::Ours(first) = StoreLock::take(&path, Holder::this_process("first, with a long name")).await.unwrap()
        else {
            panic!("the first takes it")
        };
        first.set_address("http://127.0.0.1:1".into()).unwrap();
        let Taken::Busy(holder) = StoreLock::take(&path, Holder::this_process("second")).await.unwrap() else {
            panic!("the second does not")
        };
        assert_eq!(holder, first.holder());
        assert!(holder.to_string().ends_with("at http://127.0.0.1:1"), "{holder}");
        drop(first);
        assert!(matches!(StoreLock::take(&path, Holder::this_process("third")).await.unwrap(), Taken::Ours(_)));
    }

    #[tokio::test]
    async fn a_planted_link_is_not_followed_and_what_it_names_stays() {
        let dir = tempfile::tempdir().unwrap();
        let victim = dir.path().join("victim");
        std::fs::write(&victim, "what somebody else keeps, longer than a lock's line is, so that a cut would show\n")
            .unwrap();
        let before = std::fs::read(&victim).unwrap();
        for name in ["lock", "collecting"] {
            std::os::unix::fs::symlink(&victim, dir.path().join(name)).unwrap();
        }
        let path = dir.path().join("lock");
        let error = StoreLock::take(&path, Holder::this_process("a test")).await.err().expect("refused");
        assert!(error.to_string().contains("symbolic link"), "{error}");
        assert!(SharedLock::try_take(&path).is_err() && holder(&path).is_err());
        assert!(CollectionLock::collect(dir.path()).await.is_err());
        assert_eq!(std::fs::read(&victim).unwrap(), before);
    }

    #[tokio::test]
    async fn readers_share_what_nobody_holds_and_are_waited_for() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        assert!(SharedLock::try_take(&path).unwrap().is_none(), "there is no store yet");
        let Taken::Ours(held) = StoreLock::take(&path, Holder::this_process("writer")).await.unwrap() else {
            panic!("nobody holds it")
        };
        assert!(SharedLock::try_take(&path).unwrap().is_none(), "it is held");
        drop(held);
        let readers = (SharedLock::try_take(&path).unwrap().unwrap(), SharedLock::try_take(&path).unwrap().unwrap());
        let opening = tokio::spawn(async move {
            matches!(StoreLock::take(&path, Holder::this_process("writer")).await.unwrap(), Taken::Ours(_))
        });
        tokio::task::yield_now().await;
        assert!(!opening.is_finished());
        drop(readers);
        assert!(opening.await.unwrap());
    }
}
