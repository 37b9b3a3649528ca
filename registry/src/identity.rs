//! Whether a database, its blobs and its folder belong together, and whether the database is all that it was.
//!
//! A store draws a random name when it is made. The name stands in the database (table `store`), in the *marker* beside the
//! blobs (`IDENTITY`, wherever they lie) and in the *witness*, a small file beside the database. The database counts its committed
//! transactions; the witness holds a number that this count had reached. It is written when the store is opened and closed,
//! after the first commit of every cycle of the database's write-ahead log, and else every few seconds at most. So a
//! database whose log was lost, or an older copy in its place, counts less than the witness, and is told from the one that
//! was there. Without this an emptied database file would be a new store in which nothing needs any blob.
//!
//! Blobs in a bucket can be reached by two copies of a database, each of which would collect what only the other needs. So
//! the marker also holds the database's epoch, the number of its openings; opening the store raises both, the marker by
//! a compare-and-set. A database that was opened less often than the marker says is a copy, and a holder whose epoch the marker
//! has left behind collects nothing. Of two copies that were opened equally often the lease decides ([`crate::lease`]).
//!
//! | database | marker | witness | the store is |
//! |---|---|---|---|
//! | absent | nothing | none | to become a new store, if nothing else lies in it |
//! | absent | any, or blobs | any | refused: blobs without their database |
//! | a | nothing | none | a store whose making was cut short, if it holds nothing yet; else refused |
//! | a | nothing | a | refused: a database without its blobs |
//! | a | b | any | refused: parts of two stores |
//! | a | a | a, at most the count | whole |
//! | a | a | a, beyond the count | refused: the database has gone back |
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
    #[error("the blobs of the database `{}` are missing: `{marker}` does not exist", database.display())]
    NoBlobs {
        database: PathBuf,
        /// Where the marker should be that stands beside the blobs.
        marker: String,
    },
    /// Parts of two stores.
    #[error("`{}` is of store {one} and `{second}` of store {other}", first.display())]
    Mixed {
        /// A part.
        first: PathBuf,
        /// Whose it is.
        one: StoreId,
        /// Another part.
        second: String,
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
        database: PathBuf,
        /// Transactions in it.
        found: u64,
        /// Transactions that it once had.
        known: u64,
    },
    /// A copy of the database has used the blobs meanwhile, or uses them now.
    #[error(
        "the database `{}` was opened {found} times, and `{marker}` knows of {known}: the database is an older copy, or \
         another copy of the store uses the same blobs",
        database.display()
    )]
    Copied {
        database: PathBuf,
        /// How often it was opened.
        found: u64,
        /// The marker beside the blobs.
        marker: String,
        /// How often a database of this store was opened by its word.
        known: u64,
    },
    /// A marker does not read.
    #[error("`{path}` does not read: {message}")]
    Unreadable {
        /// The marker.
        path: String,
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
            Self::Copied { .. } => {
                "nothing was changed: use the newest copy of the store. `registry adopt` makes this one the store that has the \
                 blobs, and every other copy is refused from then on"
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
        matches!(self, Self::NoBlobs { .. } | Self::WentBack { .. } | Self::Copied { .. })
    }
}

/// What stands beside the blobs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Marker {
    pub(crate) store: StoreId,
    /// How often the store's database had been opened when it last took the blobs for its own.
    pub(crate) epoch: u64,
    /// Which process holds them, where a lock in the store's folder cannot say so ([`crate::lease`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) held: Option<Held>,
}

/// Which process holds blobs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Held {
    /// Who, for people.
    pub(crate) by: String,
    /// The lock that it has; nobody else has that at the same time.
    pub(crate) lock: String,
    /// Another text each time that a store is opened.
    pub(crate) opening: String,
    /// How often it has said so since.
    pub(crate) renewals: u64,
}

impl Held {
    /// Once more.
    pub(crate) fn renewed(&self) -> Self {
        Self { renewals: self.renewals + 1, ..self.clone() }
    }
}

impl Marker {
    /// Of the blobs at `place`, if there is one.
    pub(crate) fn read(place: &dyn Backend) -> Result<Option<Self>, MarkerError> {
        let text = place.marker()?;
        let unreadable = |e: serde_json::Error| {
            MarkerError::Mismatch(Mismatch::Unreadable { path: place.marker_place(), message: e.to_string() })
        };
        text.map(|text| serde_json::from_str(&text)).transpose().map_err(unreadable)
    }

    /// Puts it in the place of `old`; `false` if another one is there by now.
    pub(crate) fn write(&self, old: Option<&Self>, place: &dyn Backend) -> Result<bool, BlobError> {
        place.set_marker(old.map(Self::text).as_deref(), &self.text())
    }

    fn text(&self) -> String {
        serde_json::json!(self).to_string()
    }
}

/// Why there is no word of a marker.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MarkerError {
    #[error(transparent)]
    Blob(#[from] BlobError),
    #[error(transparent)]
    Mismatch(#[from] Mismatch),
}

/// What can be seen of a store without its database.
#[derive(Debug)]
pub(crate) struct Found {
    dir: PathBuf,
    marker: Option<Marker>,
    /// Where the marker is, or would be.
    marker_place: String,
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

fn witness_path(dir: &Path) -> PathBuf {
    dir.join("witness")
}

/// A file's text if the file is there.
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

impl Found {
    /// Looks at `dir` and its blobs, changing nothing. The folder need not exist.
    pub(crate) fn look(dir: &Path, blobs: &dyn Backend) -> Result<Self, MarkerError> {
        Ok(Self {
            dir: dir.to_owned(),
            marker: Marker::read(blobs)?,
            marker_place: blobs.marker_place(),
            any_blob: !blobs.is_empty()?,
            witness: Testimony::read(dir)?,
            // Beside a database that is there the log is a part of it.
            log: !folder::has_database(dir) && folder::log_bytes(dir) > 0,
        })
    }

    /// The marker beside the blobs.
    pub(crate) fn marker(&self) -> Option<&Marker> {
        self.marker.as_ref()
    }

    /// The epoch that the marker knows of.
    pub(crate) fn marked_epoch(&self) -> u64 {
        self.marker.as_ref().map_or(0, |marker| marker.epoch)
    }

    /// What shows that the folder is, or was, a store.
    pub(crate) fn evidence(&self) -> Option<String> {
        if self.any_blob {
            return Some(format!("there are blobs in `{}`", self.marker_place.trim_end_matches("/IDENTITY")));
        }
        if let Some(marker) = &self.marker {
            return Some(format!("`{}` is of store {}", self.marker_place, marker.store));
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
        let database = folder::database(&self.dir);
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
            // The marker is written right after the store's row and before the first opening raises the epoch.
            None if self.witness.is_none() && !self.any_blob && stored.epoch == 0 => {
                Ok(Verdict::Unfinished(stored.id.clone()))
            }
            None => Err(Mismatch::NoBlobs { database, marker: self.marker_place.clone() }),
        }
    }
}

/// Whether the parts of an open store are still its own: a process that holds a store for weeks must not take an emptied
/// database for one that needs no blobs.
pub(crate) async fn check(
    id: &StoreId,
    dir: &Path,
    blobs: Arc<dyn Backend>,
    records: &dyn Records,
) -> Result<(), String> {
    if !folder::has_database(dir) {
        return Err(format!("the database `{}` is missing or empty", folder::database(dir).display()));
    }
    let place = blobs.marker_place();
    // Before the database: its epoch is raised first.
    let marker = tokio::task::spawn_blocking(move || Marker::read(&*blobs)).await.map_err(|e| e.to_string())?;
    let marker = match marker.map_err(|e| e.to_string())? {
        Some(marker) if marker.store == *id => marker,
        Some(marker) => return Err(format!("`{place}` is of store {}, not {id}", marker.store)),
        None => return Err(format!("`{place}`, which says whose the blobs are, is missing")),
    };
    match records.stored().await.map_err(|e| format!("the database does not read: {e}"))? {
        Some(stored) if stored.id != *id => Err(format!("the database is of store {}, not {id}", stored.id)),
        Some(stored) if marker.epoch > stored.epoch => {
            let (found, known) = (stored.epoch, marker.epoch);
            Err(Mismatch::Copied { database: folder::database(dir), found, marker: place, known }.to_string())
        }
        Some(_) => Ok(()),
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

    /// The table of the header, row by row.
    #[test]
    fn parts_are_opened_only_if_they_belong_together() {
        let found = |beside: Option<char>, any_blob, witness: Option<(char, u64)>| Found {
            dir: "/s".into(),
            marker: beside.map(|store| Marker { store: id(store), epoch: 2, held: None }),
            marker_place: "/s/blobs/IDENTITY".into(),
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
        let copied = found(Some('a'), true, None);
        assert!(matches!(copied.judge(Some(&stored(1))), Err(Mismatch::Copied { found: 1, known: 2, .. })));
    }
}
