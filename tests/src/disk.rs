//! A separate disk for a store that a test may fill or pause: a file system in a file, mounted through a loop device.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A mounted file system; resumed, unmounted and deleted when dropped.
#[derive(Debug)]
pub struct Disk {
    dir: tempfile::TempDir,
    frozen: bool,
}

/// Larger than any store of the harness; the image is sparse, so only written blocks use space.
const BYTES: u64 = 4 << 30;
/// Size of the smallest block that [`Disk::fill`] tries; the space left is less than one page of a database.
const HOLE: u64 = 4096;

fn tool(name: &str, arguments: &[&str], path: &Path) -> Result<(), String> {
    let done = Command::new(name).args(arguments).arg(path).output().map_err(|e| format!("{name}: {e}"))?;
    if done.status.success() {
        return Ok(());
    }
    Err(format!("{name} {}: {}", path.display(), String::from_utf8_lossy(&done.stderr).trim()))
}

impl Disk {
    /// Creates and mounts a disk. Skips the test where that is impossible.
    pub fn new() -> Option<Self> {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let disk = Self { dir, frozen: false };
        match disk.mount() {
            Ok(()) => Some(disk),
            Err(error) => {
                fixtures::skip(&format!(
                    "a disk that fills up or pauses needs root, `mkfs.ext4` and a loop device: {error}"
                ));
                None
            }
        }
    }

    fn mount(&self) -> Result<(), String> {
        let (image, root) = (self.dir.path().join("image"), self.root());
        let file = fs::File::create(&image).and_then(|file| file.set_len(BYTES));
        file.and_then(|()| fs::create_dir(&root)).map_err(|e| format!("{}: {e}", image.display()))?;
        // Reserve no blocks for root, which runs the harness.
        tool("mkfs.ext4", &["-q", "-m", "0"], &image)?;
        let image = image.display().to_string();
        tool("mount", &["-o", "loop", &image], &root)?;
        fs::create_dir(self.path()).map_err(|e| format!("{}: {e}", self.path().display()))
    }

    fn root(&self) -> PathBuf {
        self.dir.path().join("root")
    }

    /// An empty folder on it.
    pub fn path(&self) -> PathBuf {
        self.root().join("store")
    }

    /// Fills all free space.
    pub fn fill(&self) {
        let mut bytes = BYTES;
        let mut number = 0;
        while bytes >= HOLE {
            let size = bytes.to_string();
            let ballast = self.root().join(format!("ballast-{number}"));
            if tool("fallocate", &["-l", &size], &ballast).is_ok() {
                number += 1;
            } else {
                let _nothing_was_made = fs::remove_file(ballast);
                bytes /= 2;
            }
        }
    }

    /// Frees the space again.
    pub fn empty(&self) {
        let files = fs::read_dir(self.root()).expect("the disk is mounted").flatten();
        for file in files.filter(|file| file.file_name().to_string_lossy().starts_with("ballast-")) {
            fs::remove_file(file.path()).unwrap_or_else(|e| panic!("{}: {e}", file.path().display()));
        }
    }

    /// Blocks every write from now on. A process that waits for a write handles no signal, not even `SIGKILL`.
    pub fn pause(&mut self) {
        tool("fsfreeze", &["-f"], &self.root()).unwrap_or_else(|e| panic!("{e}"));
        self.frozen = true;
    }

    /// Unblocks writes.
    pub fn resume(&mut self) {
        if self.frozen {
            tool("fsfreeze", &["-u"], &self.root()).unwrap_or_else(|e| panic!("{e}"));
            self.frozen = false;
        }
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        self.resume();
        let _busy = tool("umount", &["-l"], &self.root());
    }
}
