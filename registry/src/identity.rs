//! Identity check of a store: do database, blobs and folder belong together, and is the database complete?
//!
//! A store draws a random name when it is created. The name is recorded in the database (table `store`), in the
//! *marker* beside the blobs (`IDENTITY`, also in a bucket) and in the *witness*, a small file beside the database. The
//! database counts its committed transactions; the witness records a number that this count has reached. It is written
//! when the store is opened and closed, after the first commit of every cycle of the write-ahead log, and otherwise
//! within a few seconds of a commit. A database that lost its log, or an older copy, therefore counts less than the
//! witness and is detected. Without these checks an emptied database file would look like a new store that needs no
//! blobs.
//!
//! Two copies of a database can reach the blobs in a bucket, and each would collect the blobs that only the other
//! needs. So the marker also has the database's epoch, the number of its openings. Opening the store raises both, the
//! marker by compare-and-set. A database with a lower epoch than the marker is a copy, and a holder whose epoch is
//! below the marker's collects nothing. Between copies with equal epochs the lease decides ([`crate::lease`]).
//!
//! | database | marker | witness | the store is |
//! |---|---|---|---|
//! | absent | nothing | none | new, if its folder has no other files |
//! | absent | any, or blobs | any | refused: blobs without their database |
//! | a | nothing | none | unfinished, if it is empty; otherwise refused |
//! | a | nothing | a | refused: a database without its blobs |
//! | a | b | any | refused: parts of two stores |
//! | a | a | a, at most the count | whole |
//! | a | a | a, beyond the count | refused: the database lost transactions |
//! | a | a, of a later epoch | any | refused: another copy of the database uses the blobs |

use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use checkpoint::BlobError;
use serde::{Deserialize, Serialize};

use crate::blob::Backend;
use crate::blob::disk::{regular, write_whole};
use crate::catalog::Records;
use crate::folder;
use crate::store_id::{StoreId, Stored};

/// Reason why the parts of a store do not fit together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Mismatch {
    /// The database is missing or empty, or does not belong to a store.
    #[error("the database `{}` is missing, empty or from an older build, but {evidence}", database.display())]
    NoDatabase {
        /// Its expected path.
        database: PathBuf,
        /// Evidence that a database existed.
        evidence: String,
    },
    /// The blobs are missing.
    #[error("the blobs of the database `{}` are missing: `{marker}` does not exist", database.display())]
    NoBlobs {
        database: PathBuf,
        /// Expected place of the marker beside the blobs.
        marker: String,
    },
    /// The parts belong to two stores.
    #[error("`{}` belongs to store {one}, but `{second}` belongs to store {other}", first.display())]
    Mixed {
        /// A part.
        first: PathBuf,
        /// Store of the first part.
        one: StoreId,
        /// Another part.
        second: String,
        /// Store of the other part.
        other: StoreId,
    },
    /// Committed transactions are missing.
    #[error(
        "the database `{}` has lost transactions: it has {found}, but at least {known} were committed; its log \
         (`stride.db-wal`) is missing, or an older copy replaced it",
        database.display()
    )]
    WentBack {
        database: PathBuf,
        /// Number of transactions in it.
        found: u64,
        /// Number of transactions that it once had.
        known: u64,
    },
    /// A copy of the database has used the blobs since, or uses them now.
    #[error(
        "the database `{}` was opened {found} times, but `{marker}` records {known}: the database is an older copy, or \
         another copy of the store uses the same blobs",
        database.display()
    )]
    Copied {
        database: PathBuf,
        /// Number of its openings.
        found: u64,
        /// The marker beside the blobs.
        marker: String,
        /// Number of openings recorded in the marker.
        known: u64,
    },
    /// A marker cannot be read.
    #[error("cannot read `{path}`: {message}")]
    Unreadable {
        /// Path of the marker.
        path: String,
        /// The error.
        message: String,
    },
}

impl Mismatch {
    /// Returns the remedy for the user.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::NoDatabase { .. } => {
                "nothing was changed: put the database back or restore a backup (`registry restore BACKUP --to DIR`); to start \
                 a new store, choose another folder with `--store`"
            }
            Self::NoBlobs { .. } => {
                "nothing was changed: put the blobs back or restore a backup (`registry restore BACKUP --to DIR`); \
                 `registry adopt` continues without them, and pipelines compute missing values again"
            }
            Self::Mixed { .. } | Self::Unreadable { .. } => {
                "nothing was changed: put back the parts of one store, or restore a backup (`registry restore BACKUP --to DIR`)"
            }
            Self::Copied { .. } => {
                "nothing was changed: use the newest copy of the store. `registry adopt` gives the blobs to this copy; every \
                 other copy is refused from then on"
            }
            Self::WentBack { .. } => {
                "nothing was changed: put the newer database with its log back or restore a backup (`registry restore BACKUP --to \
                 DIR`); `registry adopt` continues with the remaining data, and the next `registry gc` removes blobs that \
                 only lost transactions named"
            }
        }
    }

    /// Returns true if the user may decide to continue anyway.
    pub(crate) fn may_be_adopted(&self) -> bool {
        matches!(self, Self::NoBlobs { .. } | Self::WentBack { .. } | Self::Copied { .. })
    }
}

/// Content of the marker beside the blobs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Marker {
    pub(crate) store: StoreId,
    /// The database's epoch when it last claimed the blobs.
    pub(crate) epoch: u64,
    /// The process that holds the blobs, if a lock in the store's folder cannot show it ([`crate::lease`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) held: Option<Held>,
}

/// A process that holds blobs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Held {
    /// Name of the process, for messages.
    pub(crate) by: String,
    /// Name of its lock; at most one process has that lock at a time.
    pub(crate) lock: String,
    /// A different text for each opening of a store.
    pub(crate) opening: String,
    /// Number of renewals since.
    pub(crate) renewals: u64,
}

impl Held {
    /// Returns the value with one more renewal.
    pub(crate) fn renewed(&self) -> Self {
        Self { renewals: self.renewals + 1, ..self.clone() }
    }
}

impl Marker {
    /// Reads the marker beside the blobs at `place`, if there is one.
    pub(crate) fn read(place: &dyn Backend) -> Result<Option<Self>, MarkerError> {
        let text = place.marker()?;
        let unreadable = |e: serde_json::Error| {
            MarkerError::Mismatch(Mismatch::Unreadable { path: place.marker_place(), message: e.to_string() })
        };
        text.map(|text| serde_json::from_str(&text)).transpose().map_err(unreadable)
    }

    /// Replaces `old` by this marker; returns `false` if the marker has changed since.
    pub(crate) fn write(&self, old: Option<&Self>, place: &dyn Backend) -> Result<bool, BlobError> {
        place.set_marker(old.map(Self::text).as_deref(), &self.text())
    }

    fn text(&self) -> String {
        serde_json::json!(self).to_string()
    }
}

/// Error of reading a marker.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MarkerError {
    #[error(transparent)]
    Blob(#[from] BlobError),
    #[error(transparent)]
    Mismatch(#[from] Mismatch),
}

/// The parts of a store other than its database.
#[derive(Debug)]
pub(crate) struct StoreParts {
    dir: PathBuf,
    /// Name of a database that is no file of the folder.
    database: Option<PathBuf>,
    marker: Option<Marker>,
    /// The place of the marker, even if it is missing.
    marker_place: String,
    any_blob: bool,
    witness: Option<WitnessRecord>,
    log: bool,
}

/// Decision about the folder.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// There is no store yet.
    New,
    /// The creation of the store was interrupted; missing names may be written.
    Unfinished(StoreId),
    /// All parts belong to this store.
    Whole(StoreId),
}

fn witness_path(dir: &Path) -> PathBuf {
    dir.join("witness")
}

/// Reads a file's text, or `None` if the file is missing.
fn read_if_there(path: &Path) -> io::Result<Option<String>> {
    match regular(OpenOptions::new().read(true), path).and_then(io::read_to_string) {
        Ok(text) => Ok(Some(text)),
        Err(e) if is_absent(&e) => Ok(None),
        Err(e) => Err(e),
    }
}

fn is_absent(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
}

fn unreadable(path: &Path, message: impl fmt::Display) -> Mismatch {
    Mismatch::Unreadable { path: path.display().to_string(), message: message.to_string() }
}

impl StoreParts {
    /// Reads the parts in `dir` and its blobs, and changes nothing. The folder need not exist.
    pub(crate) fn read(dir: &Path, blobs: &dyn Backend) -> Result<Self, MarkerError> {
        Ok(Self {
            dir: dir.to_owned(),
            database: None,
            marker: Marker::read(blobs)?,
            marker_place: blobs.marker_place(),
            any_blob: !blobs.is_empty()?,
            witness: WitnessRecord::read(dir)?,
            // The log is evidence only if the database is missing.
            log: !folder::has_database(dir) && folder::log_bytes(dir) > 0,
        })
    }

    /// Gives the database's name in messages, if it is no file of the folder.
    pub(crate) fn name_database(&mut self, database: PathBuf) {
        self.database = Some(database);
    }

    /// Returns the store's folder.
    pub(crate) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns the marker beside the blobs.
    pub(crate) fn marker(&self) -> Option<&Marker> {
        self.marker.as_ref()
    }

    /// Returns the epoch in the marker; 0 without one.
    pub(crate) fn marked_epoch(&self) -> u64 {
        self.marker.as_ref().map_or(0, |marker| marker.epoch)
    }

    /// Describes evidence that the folder is, or was, a store.
    pub(crate) fn evidence(&self) -> Option<String> {
        if self.any_blob {
            return Some(format!("there are blobs in `{}`", self.marker_place.trim_end_matches("/IDENTITY")));
        }
        if let Some(marker) = &self.marker {
            return Some(format!("`{}` belongs to store {}", self.marker_place, marker.store));
        }
        if let Some(witness) = &self.witness {
            return Some(format!("the witness records {} transactions", witness.commits));
        }
        self.log.then(|| "its log (`stride.db-wal`) exists".to_owned())
    }

    /// Returns the number of transactions that the witness records.
    pub(crate) fn witnessed(&self) -> u64 {
        self.witness.as_ref().map_or(0, |witness| witness.commits)
    }

    /// Checks that the parts belong together. `stored` is the identity in the database, or `None` if the database is
    /// absent.
    pub(crate) fn classify(&self, stored: Option<&Stored>) -> Result<Verdict, Mismatch> {
        let database = self.database.clone().unwrap_or_else(|| folder::database(&self.dir));
        let Some(stored) = stored else {
            return match self.evidence() {
                None => Ok(Verdict::New),
                Some(evidence) => Err(Mismatch::NoDatabase { database, evidence }),
            };
        };
        let mixed = |second: &str, other: &StoreId| Mismatch::Mixed {
            first: database.clone(),
            one: stored.id.clone(),
            second: second.to_owned(),
            other: other.clone(),
        };
        if let Some(witness) = &self.witness {
            if witness.store != stored.id {
                return Err(mixed(&witness_path(&self.dir).display().to_string(), &witness.store));
            }
            if witness.commits > stored.commits {
                return Err(Mismatch::WentBack { database, found: stored.commits, known: witness.commits });
            }
        }
        match &self.marker {
            Some(marker) if marker.store != stored.id => Err(mixed(&self.marker_place, &marker.store)),
            Some(marker) if marker.epoch > stored.epoch => {
                let (found, marker, known) = (stored.epoch, self.marker_place.clone(), marker.epoch);
                Err(Mismatch::Copied { database, found, marker, known })
            }
            Some(_) => Ok(Verdict::Whole(stored.id.clone())),
            // The marker is written right after the store's row, before the first opening raises the epoch.
            None if self.witness.is_none() && !self.any_blob && stored.epoch == 0 => {
                Ok(Verdict::Unfinished(stored.id.clone()))
            }
            None => Err(Mismatch::NoBlobs { database, marker: self.marker_place.clone() }),
        }
    }
}

/// Checks that the parts of an open store still belong to it. A process that holds a store for weeks must not treat an
/// emptied database as one that needs no blobs.
pub(crate) async fn check(
    id: &StoreId,
    database: &Path,
    blobs: Arc<dyn Backend>,
    records: &dyn Records,
) -> Result<(), String> {
    let place = blobs.marker_place();
    // Read before the database, because its epoch is raised first.
    let marker = tokio::task::spawn_blocking(move || Marker::read(&*blobs)).await.map_err(|e| e.to_string())?;
    let marker = match marker.map_err(|e| e.to_string())? {
        Some(marker) if marker.store == *id => marker,
        Some(marker) => return Err(format!("`{place}` belongs to store {}, not {id}", marker.store)),
        None => return Err(format!("the marker `{place}` of the blobs is missing")),
    };
    match records.stored().await.map_err(|e| format!("cannot read the database: {e}"))? {
        Some(stored) if stored.id != *id => Err(format!("the database belongs to store {}, not {id}", stored.id)),
        Some(stored) if marker.epoch > stored.epoch => {
            let found = stored.epoch;
            let known = marker.epoch;
            Err(Mismatch::Copied { database: database.to_owned(), found, marker: place, known }.to_string())
        }
        Some(_) => Ok(()),
        None => Err("the database has no store identity".into()),
    }
}

/// Content of the witness.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct WitnessRecord {
    store: StoreId,
    commits: u64,
}

impl WitnessRecord {
    fn read(dir: &Path) -> Result<Option<Self>, Mismatch> {
        let path = witness_path(dir);
        let text = read_if_there(&path).map_err(|e| unreadable(&path, e))?;
        text.map(|text| serde_json::from_str(&text)).transpose().map_err(|e| unreadable(&path, e))
    }
}

/// Writes the witness as the database grows.
#[derive(Debug)]
pub(crate) struct Witness {
    dir: PathBuf,
    store: StoreId,
    /// Number of transactions in the database; `written` is the number in the file.
    commits: u64,
    written: u64,
    at: Instant,
    /// Part of the log's header when the file was written. It changes when the log is restarted.
    cycle: Option<[u8; 12]>,
}

impl Witness {
    /// Longest time between writes while transactions are committed.
    pub(crate) const EVERY: Duration = Duration::from_secs(5);

    /// Writes the witness of a database that was just opened.
    pub(crate) fn begin(dir: &Path, stored: &Stored) -> io::Result<Self> {
        let dir = dir.to_owned();
        let store = stored.id.clone();
        let mut witness = Self { dir, store, commits: stored.commits, written: 0, at: Instant::now(), cycle: None };
        witness.write()?;
        Ok(witness)
    }

    /// Records a durable commit.
    pub(crate) fn committed(&mut self, commits: u64) {
        self.commits = commits;
        if self.at.elapsed() >= Self::EVERY || self.cycle != log_cycle(&self.dir) {
            self.catch_up();
        }
    }

    /// Returns true if the file lacks the newest commit.
    pub(crate) fn is_behind(&self) -> bool {
        self.written < self.commits
    }

    /// Writes the file if it lacks the newest commit.
    pub(crate) fn catch_up(&mut self) {
        if self.is_behind()
            && let Err(error) = self.write()
        {
            // The commits are safe; a later loss of them would be detected late or not at all.
            tracing::warn!(%error, "cannot write the database's witness");
            self.at = Instant::now();
        }
    }

    fn write(&mut self) -> io::Result<()> {
        let cycle = log_cycle(&self.dir);
        let record = WitnessRecord { store: self.store.clone(), commits: self.commits };
        let mut text = serde_json::to_string(&record)?;
        text.push('\n');
        write_whole(&witness_path(&self.dir), text.as_bytes())?;
        (self.written, self.at, self.cycle) = (self.commits, Instant::now(), cycle);
        Ok(())
    }
}

/// Reads the part of the log's header that changes whenever SQLite restarts the log: the checkpoint's number and two
/// salts (<https://www.sqlite.org/fileformat2.html#the_write_ahead_log>).
fn log_cycle(dir: &Path) -> Option<[u8; 12]> {
    let mut cycle = [0; 12];
    // The log does not exist before the first write.
    let log = File::open(folder::log(dir)).ok()?;
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

    /// Tests the table of the header, row by row.
    #[test]
    fn parts_are_opened_only_if_they_belong_together() {
        let found = |beside: Option<char>, any_blob, witness: Option<(char, u64)>| StoreParts {
            dir: "/s".into(),
            database: None,
            marker: beside.map(|store| Marker { store: id(store), epoch: 2, held: None }),
            marker_place: "/s/blobs/IDENTITY".into(),
            any_blob,
            witness: witness.map(|(store, commits)| WitnessRecord { store: id(store), commits }),
            log: false,
        };
        assert_eq!(found(None, false, None).classify(None), Ok(Verdict::New));
        for traces in [found(Some('a'), false, None), found(None, true, None), found(None, false, Some(('a', 3)))] {
            assert!(matches!(traces.classify(None), Err(Mismatch::NoDatabase { .. })), "{traces:?}");
        }
        assert_eq!(found(None, false, None).classify(Some(&stored(0))), Ok(Verdict::Unfinished(id('a'))));
        for lost in [found(None, false, Some(('a', 3))), found(None, true, None)] {
            assert!(matches!(lost.classify(Some(&stored(3))), Err(Mismatch::NoBlobs { .. })), "{lost:?}");
        }
        assert!(matches!(found(None, false, None).classify(Some(&stored(3))), Err(Mismatch::NoBlobs { .. })));
        for mixed in [found(Some('b'), true, Some(('a', 3))), found(Some('a'), true, Some(('b', 3)))] {
            assert!(matches!(mixed.classify(Some(&stored(3))), Err(Mismatch::Mixed { .. })), "{mixed:?}");
        }
        let whole = found(Some('a'), true, Some(('a', 3)));
        assert_eq!(whole.classify(Some(&stored(3))), Ok(Verdict::Whole(id('a'))));
        assert_eq!(whole.classify(Some(&stored(4))), Ok(Verdict::Whole(id('a'))));
        assert!(matches!(whole.classify(Some(&stored(2))), Err(Mismatch::WentBack { found: 2, known: 3, .. })));
        let copied = found(Some('a'), true, None);
        assert!(matches!(copied.classify(Some(&stored(1))), Err(Mismatch::Copied { found: 1, known: 2, .. })));
    }
}
