//! The audit log of calls: caller, address, call and status, as lines of JSON in two files of the store's folder.
//!
//! ```text
//! audit.jsonl      the newest lines, at most [`FILE_BYTES`]
//! audit.old.jsonl  older lines, replaced when the newest file is full
//! ```
//!
//! Lines are appended and never changed. A server holds the store, so one process writes. The files are not part of the
//! database: a backup leaves them out, and a full disk loses only lines of the log.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{FileExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The size at which a file is rotated: some 100,000 lines.
pub const FILE_BYTES: u64 = 16 << 20;

/// One call, or several equal calls.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct AuditEntry {
    /// Time of the first call, in milliseconds since 1970.
    pub at_ms: i64,
    /// Time of the last call, if there are several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_ms: Option<i64>,
    /// The token's name, with its project; `-` without a valid token.
    pub who: String,
    /// The call, as written in the table of calls.
    pub call: String,
    /// The run, model or worker that the call names.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub object: String,
    /// The caller's address.
    pub from: String,
    /// The HTTP status of the answer.
    pub status: u16,
    /// Number of calls.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub count: u64,
}

fn one() -> u64 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_one(count: &u64) -> bool {
    *count == 1
}

/// The audit log of a store, for appending.
#[derive(Debug)]
pub struct AuditLog {
    dir: PathBuf,
    file_bytes: u64,
}

impl AuditLog {
    /// Returns the log of the store in `dir`.
    pub fn of(dir: &Path) -> Self {
        Self { dir: dir.to_owned(), file_bytes: FILE_BYTES }
    }

    /// Appends entries and returns when they are durable. Blocks.
    pub fn append(&self, entries: &[AuditEntry]) -> io::Result<()> {
        let mut text = String::new();
        for entry in entries {
            text.push_str(&serde_json::to_string(entry).map_err(io::Error::other)?);
            text.push('\n');
        }
        let newest = newest(&self.dir);
        if fs::metadata(&newest).is_ok_and(|file| file.len() + text.len() as u64 > self.file_bytes) {
            fs::rename(&newest, older(&self.dir))?;
        }
        let mut file = OpenOptions::new()
            .read(true)
            .append(true)
            .create(true)
            .mode(0o600)
            .custom_flags(nix::fcntl::OFlag::O_NOFOLLOW.bits())
            .open(newest)?;
        let length = file.metadata()?.len();
        let mut last = *b"\n";
        file.read_at(&mut last, length.saturating_sub(1))?;
        if last != *b"\n" {
            // A power loss cut the last line.
            text.insert(0, '\n');
        }
        file.write_all(text.as_bytes())?;
        file.sync_data()
    }
}

fn newest(dir: &Path) -> PathBuf {
    dir.join("audit.jsonl")
}

fn older(dir: &Path) -> PathBuf {
    dir.join("audit.old.jsonl")
}

/// Returns the newest `limit` entries of the store in `dir`, oldest first. Skips lines cut by a power loss. Blocks.
pub fn read(dir: &Path, limit: usize) -> io::Result<Vec<AuditEntry>> {
    let mut entries = Vec::new();
    for path in [older(dir), newest(dir)] {
        let mut text = String::new();
        match File::open(path) {
            Ok(file) => drop(file.take(4 * FILE_BYTES).read_to_string(&mut text)?),
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => return Err(error),
        }
        entries.extend(text.lines().filter_map(|line| serde_json::from_str::<AuditEntry>(line).ok()));
    }
    let surplus = entries.len().saturating_sub(limit);
    Ok(entries.split_off(surplus))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    fn entry(at_ms: i64) -> AuditEntry {
        AuditEntry {
            at_ms,
            until_ms: None,
            who: "alice".into(),
            call: "POST /v1/runs".into(),
            object: "p-1".into(),
            from: "127.0.0.1".into(),
            status: 200,
            count: 1,
        }
    }

    #[test]
    fn two_files_bound_the_log_and_keep_the_newest() {
        let dir = tempfile::tempdir().unwrap();
        let log = AuditLog { file_bytes: 2000, ..AuditLog::of(dir.path()) };
        assert!(read(dir.path(), 10).unwrap().is_empty());
        for at_ms in 0..500 {
            log.append(&[entry(at_ms)]).unwrap();
        }
        let sizes = [newest(dir.path()), older(dir.path())].map(|path| fs::metadata(path).unwrap().len());
        assert!(sizes.iter().all(|size| *size <= 2000), "{sizes:?}");
        let times: Vec<i64> = read(dir.path(), 1000).unwrap().iter().map(|entry| entry.at_ms).collect();
        assert!(times.len() > 15 && times.windows(2).all(|pair| pair[1] == pair[0] + 1), "{times:?}");
        assert_eq!(times.last(), Some(&499));
        assert_eq!(read(dir.path(), 3).unwrap(), [497, 498, 499].map(entry));
        // Cut the last line.
        let path = newest(dir.path());
        let text = fs::read(&path).unwrap();
        fs::write(&path, &text[..text.len() - 5]).unwrap();
        assert_eq!(read(dir.path(), 2).unwrap(), [497, 498].map(entry));
        log.append(&[entry(500)]).unwrap();
        assert_eq!(read(dir.path(), 2).unwrap(), [498, 500].map(entry));
    }
}
