//! Whether a database, its blobs and its folder belong together, and whether the database is all that it was.
//!
//! A store draws a random name when it is made. The name stands in the database (table `store`), beside the blobs
//! (`blobs/IDENTITY`) and in the *witness*, a small file beside the database. The database counts its committed
//! transactions; the witness holds a number that this count had reached. It is written when the store is opened and closed,
//! after the first commit of every cycle of the database's write-ahead log, and else every few seconds at most. So a
//! database whose log was lost, or an older copy in its place, counts less than the witness, and is told from the one that
//! was there. Without this an emptied database file would be a new store in which nothing needs any blob.
//!
//! | database | beside the blobs | witness | the folder is |
//! |---|---|---|---|
//! | absent | nothing | none | to become a new store, if nothing else lies in it |
//! | absent | name or blobs | any | refused: blobs without their database |
//! | a | nothing | none | a store whose making was cut short, if it holds nothing yet; else refused |
//! | a | nothing | a | refused: a database without its blobs |
//! | a | b | any | refused: parts of two stores |
//! | a | a | a, at most the count | whole |
//! | a | a | a, beyond the count | refused: the database has gone back |

use std::fmt;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read as _, Write as _};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::db;

/// The random name of a store: 32 hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct StoreId(String);

impl StoreId {
    /// Another one each time.
    pub(crate) fn random() -> io::Result<Self> {
        let mut bytes = [0_u8; 16];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        Ok(Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    /// The digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for StoreId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for StoreId {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let hex = |c: char| c.is_ascii_digit() || ('a'..='f').contains(&c);
        if text.len() == 32 && text.chars().all(hex) {
            return Ok(Self(text.to_owned()));
        }
        Err(format!("`{text}` does not name a store: expected 32 hexadecimal digits"))
    }
}

impl TryFrom<String> for StoreId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<StoreId> for String {
    fn from(id: StoreId) -> Self {
        id.0
    }
}

/// Why the parts of a store are not opened together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Mismatch {
    /// The database is missing or empty, or was never one of a store.
    #[error("the database `{}` is missing, empty or of a build before this one, but {evidence}", database.display())]
    NoDatabase {
        /// Where it was looked for.
        database: PathBuf,
        /// What shows that there was one.
        evidence: String,
    },
    /// The blobs are missing.
    #[error("the blobs of the database `{}` are missing: `{}` does not exist", database.display(), marker.display())]
    NoBlobs {
        /// The database.
        database: PathBuf,
        /// The marker that stands beside the blobs.
        marker: PathBuf,
    },
    /// Parts of two stores.
    #[error("`{}` is of store {one} and `{}` of store {other}", first.display(), second.display())]
    Mixed {
        /// A part.
        first: PathBuf,
        /// Whose it is.
        one: StoreId,
        /// Another part.
        second: PathBuf,
        /// Whose that is.
        other: StoreId,
    },
    /// Committed transactions are gone.
    #[error(
        "the database `{}` has gone back: {found} transactions are in it and at least {known} were committed; its log \
         (`stride.db-wal`) was lost, or an older copy was put in its place",
        database.display()
    )]
    WentBack {
        /// The database.
        database: PathBuf,
        /// Transactions in it.
        found: u64,
        /// Transactions that it once had.
        known: u64,
    },
    /// A marker does not read.
    #[error("`{}` does not read: {message}", path.display())]
    Unreadable {
        /// The marker.
        path: PathBuf,
        /// What is wrong with it.
        message: String,
    },
}

impl Mismatch {
    /// What the user can do.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::NoDatabase { .. } => {
                "nothing was changed: put the database back or restore a backup (`registry restore BACKUP --to DIR`); to begin \
                 anew choose another folder with `--store`"
            }
            Self::NoBlobs { .. } => {
                "nothing was changed: put the blobs back or restore a backup (`registry restore BACKUP --to DIR`); \
                 `registry adopt` goes on without them, and what pipelines need of them is computed again"
            }
            Self::Mixed { .. } | Self::Unreadable { .. } => {
                "nothing was changed: put back what belongs together, or restore a backup (`registry restore BACKUP --to DIR`)"
            }
            Self::WentBack { .. } => {
                "nothing was changed: put the newer database with its log back or restore a backup (`registry restore BACKUP --to \
                 DIR`); `registry adopt` goes on with what is left, and blobs that only the lost transactions named go with \
                 the next `registry gc`"
            }
        }
    }

    /// Whether a user may decide to go on all the same.
    pub(crate) fn may_be_adopted(&self) -> bool {
        matches!(self, Self::NoBlobs { .. } | Self::WentBack { .. })
    }
}

/// The store's row in its database.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Stored {
    pub(crate) id: StoreId,
    pub(crate) epoch: u64,
    pub(crate) commits: u64,
}

/// What the folder shows without the database.
#[derive(Debug)]
pub(crate) struct Found {
    dir: PathBuf,
    beside_blobs: Option<StoreId>,
    any_blob: bool,
    witness: Option<Testimony>,
    log: bool,
}

/// What to do with the folder.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Nothing is there.
    New,
    /// The store was being made: its name may be written where it is missing.
    Unfinished(StoreId),
    /// All parts are of this store.
    Whole(StoreId),
}

/// Where the name stands beside the blobs of a folder.
pub(crate) fn marker_path(dir: &Path) -> PathBuf {
    dir.join("blobs/IDENTITY")
}

fn witness_path(dir: &Path) -> PathBuf {
    dir.join("witness")
}

/// A file's text if the file is there.
fn read_if_there(path: &Path) -> io::Result<Option<String>> {
    match fs::read_to_string(path) {
        Ok(text) => Ok(Some(text)),
        Err(e) if is_absent(&e) => Ok(None),
        Err(e) => Err(e),
    }
}

fn is_absent(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
}

fn unreadable(path: &Path, message: impl fmt::Display) -> Mismatch {
    Mismatch::Unreadable { path: path.to_owned(), message: message.to_string() }
}

/// The name beside the blobs in `dir`, if one stands there.
pub(crate) fn beside_blobs(dir: &Path) -> Result<Option<StoreId>, Mismatch> {
    let path = marker_path(dir);
    let text = read_if_there(&path).map_err(|e| unreadable(&path, e))?;
    text.map(|text| text.trim_end().parse()).transpose().map_err(|e: String| unreadable(&path, e))
}

/// Writes the name beside the blobs.
pub(crate) fn mark_blobs(dir: &Path, id: &StoreId) -> io::Result<()> {
    write_whole(&marker_path(dir), format!("{id}\n").as_bytes())
}

/// Replaces a small file: after a loss of power it holds the old bytes or the new ones.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let fresh = path.with_extension("new");
    let mut file = File::create(&fresh)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(&fresh, path)?;
    path.parent().map_or(Ok(()), |dir| File::open(dir)?.sync_all())
}

fn any_blob(dir: &Path) -> io::Result<bool> {
    let entries = match fs::read_dir(dir.join("blobs/sha256")) {
        Ok(entries) => entries,
        Err(e) if is_absent(&e) => return Ok(false),
        Err(e) => return Err(e),
    };
    for shard in entries {
        let shard = shard?.path();
        if shard.is_dir() && fs::read_dir(shard)?.next().is_some() {
            return Ok(true);
        }
    }
    Ok(false)
}

impl Found {
    /// Looks at `dir`, changing nothing. It need not exist.
    pub(crate) fn look(dir: &Path) -> Result<Self, Mismatch> {
        let blobs = dir.join("blobs");
        Ok(Self {
            dir: dir.to_owned(),
            beside_blobs: beside_blobs(dir)?,
            any_blob: any_blob(dir).map_err(|e| unreadable(&blobs, e))?,
            witness: Testimony::read(dir)?,
            // Beside a database that is there the log is a part of it.
            log: !db::is_there(dir) && db::log_bytes(dir) > 0,
        })
    }

    /// What shows that the folder is, or was, a store.
    pub(crate) fn evidence(&self) -> Option<String> {
        if self.any_blob {
            return Some(format!("there are blobs in `{}`", self.dir.join("blobs").display()));
        }
        if let Some(id) = &self.beside_blobs {
            return Some(format!("`{}` is of store {id}", marker_path(&self.dir).display()));
        }
        if let Some(witness) = &self.witness {
            return Some(format!("it had {} transactions once", witness.commits));
        }
        self.log.then(|| "its log (`stride.db-wal`) is there".to_owned())
    }

    /// Transactions that the database once had, as far as the witness knows.
    pub(crate) fn witnessed(&self) -> u64 {
        self.witness.as_ref().map_or(0, |witness| witness.commits)
    }

    /// Whether the parts belong together. `stored` is what the database says, `None` if it is absent.
    pub(crate) fn judge(&self, stored: Option<&Stored>) -> Result<Verdict, Mismatch> {
        let database = db::path(&self.dir);
        let Some(stored) = stored else {
            return match self.evidence() {
                None => Ok(Verdict::New),
                Some(evidence) => Err(Mismatch::NoDatabase { database, evidence }),
            };
        };
        let mixed = |second: PathBuf, other: &StoreId| Mismatch::Mixed {
            first: database.clone(),
            one: stored.id.clone(),
            second,
            other: other.clone(),
        };
        if let Some(witness) = &self.witness {
            if witness.store != stored.id {
                return Err(mixed(witness_path(&self.dir), &witness.store));
            }
            if witness.commits > stored.commits {
                return Err(Mismatch::WentBack { database, found: stored.commits, known: witness.commits });
            }
        }
        match &self.beside_blobs {
            Some(id) if *id == stored.id => Ok(Verdict::Whole(id.clone())),
            Some(id) => Err(mixed(marker_path(&self.dir), id)),
            // The marker is written right after the store's row and before the first opening raises the epoch.
            None if self.witness.is_none() && !self.any_blob && stored.epoch == 0 => {
                Ok(Verdict::Unfinished(stored.id.clone()))
            }
            None => Err(Mismatch::NoBlobs { database, marker: marker_path(&self.dir) }),
        }
    }
}

/// Whether the parts of an open store are still its own: a process that holds a store for weeks must not take an emptied
/// database for one that needs no blobs.
pub(crate) async fn check(id: &StoreId, dir: &Path, readers: &sqlx::SqlitePool) -> Result<(), String> {
    if !db::is_there(dir) {
        return Err(format!("the database `{}` is missing or empty", db::path(dir).display()));
    }
    match beside_blobs(dir).map_err(|e| e.to_string())? {
        Some(beside) if beside == *id => {}
        Some(beside) => return Err(format!("`{}` is of store {beside}, not {id}", marker_path(dir).display())),
        None => return Err(format!("`{}`, which says whose the blobs are, is missing", marker_path(dir).display())),
    }
    let mut conn = readers.acquire().await.map_err(|e| format!("the database does not open: {e}"))?;
    match db::stored_now(&mut conn).await.map_err(|e| format!("the database does not read: {e}"))? {
        Some(stored) if stored.id == *id => Ok(()),
        Some(stored) => Err(format!("the database is of store {}, not {id}", stored.id)),
        None => Err("the database names no store".into()),
    }
}

/// What the witness says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Testimony {
    store: StoreId,
    commits: u64,
}

impl Testimony {
    fn read(dir: &Path) -> Result<Option<Self>, Mismatch> {
        let path = witness_path(dir);
        let text = read_if_there(&path).map_err(|e| unreadable(&path, e))?;
        text.map(|text| serde_json::from_str(&text)).transpose().map_err(|e| unreadable(&path, e))
    }
}

/// Writes the witness as the database goes on.
#[derive(Debug)]
pub(crate) struct Witness {
    dir: PathBuf,
    store: StoreId,
    /// Transactions in the database, and those that the file knows of.
    commits: u64,
    written: u64,
    at: Instant,
    /// What the log's header said when the file was written: it changes when the log begins anew.
    cycle: Option<[u8; 12]>,
}

impl Witness {
    /// How far behind the file may be while nothing else makes it be written.
    pub(crate) const EVERY: Duration = Duration::from_secs(5);

    /// Writes it for a database that was just opened.
    pub(crate) fn begin(dir: &Path, stored: &Stored) -> io::Result<Self> {
        let (dir, store) = (dir.to_owned(), stored.id.clone());
        let mut witness = Self { dir, store, commits: stored.commits, written: 0, at: Instant::now(), cycle: None };
        witness.write()?;
        Ok(witness)
    }

    /// Takes note of a commit that is on disk.
    pub(crate) fn committed(&mut self, commits: u64) {
        self.commits = commits;
        if self.at.elapsed() >= Self::EVERY || self.cycle != log_cycle(&self.dir) {
            self.catch_up();
        }
    }

    /// Whether the file does not know of the newest commit.
    pub(crate) fn is_behind(&self) -> bool {
        self.written < self.commits
    }

    /// Writes the file if it is behind.
    pub(crate) fn catch_up(&mut self) {
        if self.is_behind()
            && let Err(error) = self.write()
        {
            // What is committed is safe; only a loss of it would be noticed later or not at all.
            tracing::warn!(%error, "the database's witness was not written");
            self.at = Instant::now();
        }
    }

    fn write(&mut self) -> io::Result<()> {
        let cycle = log_cycle(&self.dir);
        let testimony = Testimony { store: self.store.clone(), commits: self.commits };
        let mut text = serde_json::to_string(&testimony)?;
        text.push('\n');
        write_whole(&witness_path(&self.dir), text.as_bytes())?;
        (self.written, self.at, self.cycle) = (self.commits, Instant::now(), cycle);
        Ok(())
    }
}

/// The part of the log's header that changes whenever SQLite begins the log anew: the checkpoint's number and two salts
/// (<https://www.sqlite.org/fileformat2.html#the_write_ahead_log>).
fn log_cycle(dir: &Path) -> Option<[u8; 12]> {
    let mut cycle = [0; 12];
    // There is no log before the first write.
    let log = File::open(db::log_path(dir)).ok()?;
    log.read_exact_at(&mut cycle, 12).ok()?;
    Some(cycle)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    fn id(digit: char) -> StoreId {
        digit.to_string().repeat(32).parse().unwrap()
    }

    fn stored(commits: u64) -> Stored {
        Stored { id: id('a'), epoch: commits, commits }
    }

    /// The table of the header, row by row.
    #[test]
    fn parts_are_opened_only_if_they_belong_together() {
        let found = |beside: Option<char>, any_blob, witness: Option<(char, u64)>| Found {
            dir: "/s".into(),
            beside_blobs: beside.map(id),
            any_blob,
            witness: witness.map(|(store, commits)| Testimony { store: id(store), commits }),
            log: false,
        };
        assert_eq!(found(None, false, None).judge(None), Ok(Verdict::New));
        for traces in [found(Some('a'), false, None), found(None, true, None), found(None, false, Some(('a', 3)))] {
            assert!(matches!(traces.judge(None), Err(Mismatch::NoDatabase { .. })), "{traces:?}");
        }
        assert_eq!(found(None, false, None).judge(Some(&stored(0))), Ok(Verdict::Unfinished(id('a'))));
        for lost in [found(None, false, Some(('a', 3))), found(None, true, None)] {
            assert!(matches!(lost.judge(Some(&stored(3))), Err(Mismatch::NoBlobs { .. })), "{lost:?}");
        }
        assert!(matches!(found(None, false, None).judge(Some(&stored(3))), Err(Mismatch::NoBlobs { .. })));
        for mixed in [found(Some('b'), true, Some(('a', 3))), found(Some('a'), true, Some(('b', 3)))] {
            assert!(matches!(mixed.judge(Some(&stored(3))), Err(Mismatch::Mixed { .. })), "{mixed:?}");
        }
        let whole = found(Some('a'), true, Some(('a', 3)));
        assert_eq!(whole.judge(Some(&stored(3))), Ok(Verdict::Whole(id('a'))));
        assert_eq!(whole.judge(Some(&stored(4))), Ok(Verdict::Whole(id('a'))));
        assert!(matches!(whole.judge(Some(&stored(2))), Err(Mismatch::WentBack { found: 2, known: 3, .. })));
    }

    #[test]
    fn names_of_stores_differ_and_read_back() {
        let (one, other) = (StoreId::random().unwrap(), StoreId::random().unwrap());
        assert_ne!(one, other);
        assert_eq!(one.to_string().parse(), Ok(one));
        assert!("../../a".parse::<StoreId>().is_err());
    }
}
