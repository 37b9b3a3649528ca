//! Times of the last put of blobs in an object store, by this machine's clock.
//!
//! The time of an object cannot be set, and copying gigabytes onto themselves to renew it costs time and money. So the
//! times are kept beside the database, where only the store's holder writes: a file of lines `DIGEST MILLISECONDS`,
//! appended and synced before the object is sent. An unreadable line was cut by a power loss before its put was
//! acknowledged. Without a line the server's time counts.

use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use protocol::Digest;

use crate::blob::disk::{regular, sync_dir};
use crate::clock;

/// Surplus of lines over blobs at which the file is rewritten.
const SPARE_LINES: usize = 10_000;

/// Times by digest, and the file that keeps them.
#[derive(Debug)]
pub(super) struct Touched {
    times: HashMap<Digest, i64>,
    path: PathBuf,
    /// `None` in a store that is open for reading only.
    file: Option<File>,
    lines: usize,
}

impl Touched {
    /// Reads the file without opening it for writing.
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

    /// Opens the file for writing. Only for the store's holder.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let mut touched = Self::read(path)?;
        touched.rewrite()?;
        Ok(touched)
    }

    /// Returns the time of a blob's last put, if it is recorded.
    pub(super) fn at(&self, digest: Digest) -> Option<i64> {
        self.times.get(&digest).copied()
    }

    /// Records a put of a blob now and returns when the record is durable.
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

    /// Forgets a removed blob. Its line disappears with the next rewrite.
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
