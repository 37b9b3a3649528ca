//! A disk of its own for a store, that a test may fill or pause: a file system in a file, mounted by way of a loop device.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A mounted file system; thawed, unmounted and gone when dropped.
#[derive(Debug)]
pub struct Disk {
    dir: tempfile::TempDir,
    frozen: bool,
}

/// Larger than any store of the harness; the image is sparse, so that only what is written takes room.
const BYTES: u64 = 4 << 30;
/// The smallest hole that [`Disk::fill`] leaves: less than one page of a database.
const HOLE: u64 = 4096;

fn tool(name: &str, arguments: &[&str], path: &Path) -> Result<(), String> {
    let done = Command::new(name).args(arguments).arg(path).output().map_err(|e| format!("{name}: {e}"))?;
    if done.status.success() {
        return Ok(());
    }
    Err(format!("{name} {}: {}", path.display(), String::from_utf8_lossy(&done.stderr).trim()))
}

impl Disk {
    /// `None`, loudly, where file systems cannot be made or mounted.
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
        // No part is kept for root, who runs the harness.
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

    /// Takes all the room that there is.
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

    /// Gives it back.
    pub fn empty(&self) {
        let files = fs::read_dir(self.root()).expect("the disk is mounted").flatten();
        for file in files.filter(|file| file.file_name().to_string_lossy().starts_with("ballast-")) {
            fs::remove_file(file.path()).unwrap_or_else(|e| panic!("{}: {e}", file.path().display()));
        }
    }

    /// Every write waits from now on, and so does the process that asked for it: such a process takes no signal, not even `SIGKILL`.
    pub fn pause(&mut self) {
        tool("fsfreeze", &["-f"], &self.root()).unwrap_or_else(|e| panic!("{e}"));
        self.frozen = true;
    }

    /// Writes go on.
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
