//! A disk with power losses: a loss removes unsynced data.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;

use registry::blob::disk::{Disk, DiskFile, Os};

/// Passes every call to the operating system and records what a real disk might not have written yet.
#[derive(Debug, Clone, Default)]
pub struct Power(Arc<Mutex<Unsynced>>);

#[derive(Debug, Default)]
struct Unsynced {
    /// Synced length of each file, by number.
    lengths: BTreeMap<u64, u64>,
    /// Numbers of files by their current path.
    files: BTreeMap<PathBuf, u64>,
    /// New names whose folder was not synced since.
    names: Vec<PathBuf>,
    next: u64,
    deaf: bool,
}

impl Power {
    /// Ignores syncs, as if the process had been killed before each of them.
    pub fn ignore_syncs(&self, ignore: bool) {
        self.0.lock().unwrap().deaf = ignore;
    }

    /// Removes all unsynced data.
    pub fn lose(&self) {
        let mut unsynced = self.0.lock().unwrap();
        for path in std::mem::take(&mut unsynced.names) {
            let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        }
        for (path, file) in std::mem::take(&mut unsynced.files) {
            let Ok(file_on_disk) = fs::OpenOptions::new().write(true).open(&path) else { continue };
            let length = unsynced.lengths[&file];
            if file_on_disk.metadata().unwrap().len() > length {
                file_on_disk.set_len(length).unwrap();
            }
        }
        unsynced.lengths.clear();
    }

    fn file(&self, path: &Path, inner: Box<dyn DiskFile>, length: u64) -> Box<dyn DiskFile> {
        let mut unsynced = self.0.lock().unwrap();
        let number = unsynced.files.get(path).copied().unwrap_or_else(|| {
            unsynced.next += 1;
            let number = unsynced.next;
            unsynced.files.insert(path.to_owned(), number);
            unsynced.lengths.insert(number, length);
            number
        });
        Box::new(PoweredFile { power: self.clone(), number, written: length, inner })
    }
}

impl Disk for Power {
    fn create(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        let file = Os.create(path)?;
        self.0.lock().unwrap().names.push(path.to_owned());
        Ok(self.file(path, file, 0))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        let file = Os.open(path)?;
        let length = fs::metadata(path)?.len();
        let mut opened = self.file(path, file, length);
        opened.flush()?;
        Ok(opened)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        Os.rename(from, to)?;
        let mut unsynced = self.0.lock().unwrap();
        unsynced.names.retain(|name| name != from);
        unsynced.names.push(to.to_owned());
        if let Some(file) = unsynced.files.remove(from) {
            unsynced.files.insert(to.to_owned(), file);
        }
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        Os.remove(path)?;
        let mut unsynced = self.0.lock().unwrap();
        unsynced.names.retain(|name| name != path);
        unsynced.files.remove(path);
        Ok(())
    }

    fn create_dir(&self, path: &Path) -> io::Result<()> {
        let is_new = !path.exists();
        Os.create_dir(path)?;
        if is_new {
            self.0.lock().unwrap().names.push(path.to_owned());
        }
        Ok(())
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        let mut unsynced = self.0.lock().unwrap();
        if !unsynced.deaf {
            unsynced.names.retain(|name| name.parent() != Some(path));
        }
        Ok(())
    }
}

#[derive(Debug)]
struct PoweredFile {
    power: Power,
    number: u64,
    written: u64,
    inner: Box<dyn DiskFile>,
}

impl Write for PoweredFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.written += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl DiskFile for PoweredFile {
    fn sync(&mut self) -> io::Result<()> {
        let mut unsynced = self.power.0.lock().unwrap();
        if !unsynced.deaf {
            unsynced.lengths.insert(self.number, self.written);
        }
        Ok(())
    }

    fn set_modified(&mut self, at: SystemTime) -> io::Result<()> {
        self.inner.set_modified(at)
    }
}
