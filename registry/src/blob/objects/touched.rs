//! When blobs in an object store were last put, by this machine's clock.
//!
//! An object cannot be touched, and copying gigabytes onto themselves to make them young costs time and money. So the time is
//! kept beside the database, which only this store's holder writes either: a file of lines `DIGEST MILLISECONDS` that is
//! appended to and synced, before the object is sent. A line that does not read was cut short by a loss of power, when nobody
//! had been told yet. A blob without a line is as old as the server says.

use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use protocol::Digest;

use crate::blob::disk::{regular, sync_dir};
use crate::clock;

/// How many lines more than blobs the file may have before it is written anew.
const SPARE_LINES: usize = 10_000;

/// Times by digest, and the file that keeps them.
#[derive(Debug)]
pub(super) struct Touched {
    times: HashMap<Digest, i64>,
    path: PathBuf,
    /// `None` where the store is only read.
    file: Option<File>,
    lines: usize,
}

impl Touched {
    /// For reading only.
    pub(super) fn read(path: &Path) -> io::Result<Self> {
        let text = match regular(OpenOptions::new().read(true), path).and_then(io::read_to_string) {
            Err(e) if e.kind() == ErrorKind::NotFound => String::new(),
            text => text?,
        };
        let line = |line: &str| {
            let (digest, ms) = line.split_once(' ')?;
            Some((digest.parse().ok()?, ms.parse().ok()?))
        };
        Ok(Self { times: text.lines().filter_map(line).collect(), path: path.to_owned(), file: None, lines: 0 })
    }

    /// For the store's holder.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let mut touched = Self::read(path)?;
        touched.rewrite()?;
        Ok(touched)
    }

    /// When a blob was last put, if that is known.
    pub(super) fn at(&self, digest: Digest) -> Option<i64> {
        self.times.get(&digest).copied()
    }

    /// Notes that a blob is put now; returns once that would survive a loss of power.
    pub(super) fn note(&mut self, digest: Digest) -> io::Result<()> {
        let now = clock::now_ms();
        self.times.insert(digest, now);
        if self.lines > self.times.len() + SPARE_LINES {
            return self.rewrite();
        }
        let Some(file) = &mut self.file else { return Err(ErrorKind::ReadOnlyFilesystem.into()) };
        file.write_all(format!("{digest} {now}\n").as_bytes())?;
        self.lines += 1;
        file.sync_data()
    }

    /// Forgets a blob that has gone. Its line goes when the file is next written anew.
    pub(super) fn forget(&mut self, digest: Digest) {
        self.times.remove(&digest);
    }

    fn rewrite(&mut self) -> io::Result<()> {
        let fresh = self.path.with_extension("new");
        match std::fs::remove_file(&fresh) {
            Err(e) if e.kind() != ErrorKind::NotFound => return Err(e),
            _ => {}
        }
        let mut file = OpenOptions::new().write(true).create_new(true).open(&fresh)?;
        let text: String = self.times.iter().map(|(digest, ms)| format!("{digest} {ms}\n")).collect();
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&fresh, &self.path)?;
        sync_dir(self.path.parent().unwrap_or(&self.path))?;
        (self.file, self.lines) = (Some(file), self.times.len());
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn times_outlive_the_process_and_a_cut_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("touched");
        let (one, other) = (Digest::of(b"one"), Digest::of(b"other"));
        let mut touched = Touched::open(&path).unwrap();
        touched.note(one).unwrap();
        touched.note(other).unwrap();
        let at = touched.at(one).unwrap();
        drop(touched);
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"sha256:12").unwrap();
        let mut touched = Touched::open(&path).unwrap();
        assert_eq!(touched.at(one), Some(at));
        touched.forget(other);
        drop(touched);
        assert!(Touched::read(&path).unwrap().at(other).is_some(), "until it is written anew");
        assert!(Touched::read(&path).unwrap().note(one).is_err(), "opened for reading");
    }
}
