//! Small file systems for single tests.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A file system in memory, unmounted on drop.
#[derive(Debug)]
pub struct Mounted(PathBuf);

impl Mounted {
    /// Mounts a file system at `path`, with options such as `size=40m`. Skips the test where mounting is not allowed.
    pub fn tmpfs(path: &Path, options: &str) -> Option<Self> {
        fs::create_dir_all(path).expect("created");
        let done = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(path).output();
        if done.is_ok_and(|output| output.status.success()) {
            Some(Self(path.to_owned()))
        } else {
            fixtures::skip("this test mounts a small file system and needs root");
            None
        }
    }

    /// Changes the mount options.
    pub fn remount(&self, options: &str) {
        let done = Command::new("mount").args(["-o", &format!("remount,{options}")]).arg(&self.0).status();
        assert!(done.expect("mount runs").success(), "remount {options}");
    }
}

impl Drop for Mounted {
    fn drop(&mut self) {
        drop(Command::new("umount").arg("-l").arg(&self.0).status());
    }
}
