//! Backup of a store into another folder, as of one moment, and restore.
//!
//! ```text
//! BACKUP/
//!   backup.json         store, time and content, each file with its digest; written last
//!   stride-TIME.db      the database, copied by SQLite as of one moment
//!   blobs/IDENTITY      the store that the blobs belong to
//!   blobs/sha256/       every blob that this database needs
//! ```
//!
//! Any process that can read the store's folder can make a backup. Another process may hold the store and continue to
//! write; only garbage collection waits. Each blob is copied and hashed. Blobs in a bucket are downloaded, so a backup
//! contains them too. A second backup into the same folder adds only new blobs; the previous one stays whole until the
//! new `backup.json` is in place. After an interruption, run the same command again.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write as _};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use checkpoint::{BLOBS, BlobError, blob_path};
use protocol::Digest;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blob::Backend;
use crate::blob::disk::{regular, write_whole};
use crate::blob::fs::Folder;
use crate::blob::place::Place;
use crate::identity::Marker;
use crate::lease::{self, LeaseTerms};
use crate::lock::CollectionLock;
use crate::retention::{self, Rows};
use crate::sql::sqlite;
use crate::{BlobStore, QueryError, ReadStore, StoreId, clock, folder};

const MANIFEST: &str = "backup.json";
const FORMAT: u32 = 1;

/// Summary of a backup or a restored store.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Summary {
    /// Identity of the store.
    pub store: StoreId,
    /// Time of the backup, in milliseconds since 1970.
    pub at_ms: i64,
    /// Number of blobs.
    pub blobs: u64,
    /// Total bytes of the blobs.
    pub bytes: u64,
}

/// Error of a backup or a restore.
#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    /// The folder cannot hold a backup or a store.
    #[error("{0}")]
    Folder(String),
    /// The source is damaged or incomplete.
    #[error("{0}")]
    Damaged(String),
    /// A file system call failed.
    #[error("{did} `{}`: {cause}", path.display())]
    Disk {
        /// The operation that failed.
        did: &'static str,
        /// Path of the failed operation.
        path: PathBuf,
        /// Cause from the operating system.
        cause: io::Error,
    },
    /// A query of the database failed.
    #[error(transparent)]
    Query(#[from] QueryError),
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct Manifest {
    format: u32,
    store: StoreId,
    at_ms: i64,
    /// File name of the database in the backup.
    database: String,
    database_bytes: u64,
    database_digest: Digest,
    /// Blobs with their lengths in bytes.
    blobs: BTreeMap<Digest, u64>,
}

impl Manifest {
    fn read(dir: &Path) -> Result<Option<Self>, BackupError> {
        let path = dir.join(MANIFEST);
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            Err(cause) => return Err(BackupError::Disk { did: "cannot read", path, cause }),
        };
        let manifest: Self = serde_json::from_str(&text)
            .map_err(|e| BackupError::Damaged(format!("cannot parse `{}`: {e}", path.display())))?;
        if manifest.format != FORMAT {
            let found = manifest.format;
            return Err(BackupError::Folder(format!(
                "`{}` has format {found}; this build reads {FORMAT}",
                path.display()
            )));
        }
        Ok(Some(manifest))
    }

    fn summary(&self) -> Summary {
        let blobs = self.blobs.len() as u64;
        let bytes = self.blobs.values().sum();
        Summary { store: self.store.clone(), at_ms: self.at_ms, blobs, bytes }
    }
}

fn disk(did: &'static str, path: &Path) -> impl FnOnce(io::Error) -> BackupError {
    let path = path.to_owned();
    move |cause| BackupError::Disk { did, path, cause }
}

fn make_dir(path: &Path) -> Result<(), BackupError> {
    DirBuilder::new().recursive(true).mode(0o700).create(path).map_err(disk("cannot make", path))
}

fn sync(path: &Path) -> Result<(), BackupError> {
    File::open(path).and_then(|file| file.sync_all()).map_err(disk("cannot sync", path))
}

fn names(dir: &Path) -> Result<Vec<String>, BackupError> {
    let entries = match fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(disk("cannot list", dir)(e)),
    };
    entries
        .map(|entry| Ok(entry.map_err(disk("cannot list", dir))?.file_name().to_string_lossy().into_owned()))
        .collect()
}

fn hashed(path: &Path) -> io::Result<(Digest, u64)> {
    Digest::of_all(&mut File::open(path)?)
}

fn expect(path: &Path, digest: Digest) -> Result<u64, BackupError> {
    let (found, bytes) = hashed(path).map_err(disk("cannot read", path))?;
    if found == digest {
        return Ok(bytes);
    }
    Err(BackupError::Damaged(format!("`{}` is damaged: its bytes hash to {found}, not to {digest}", path.display())))
}

impl ReadStore {
    /// Makes or renews a backup in `to`. The folder must be empty, missing, or hold an older backup of this store.
    pub async fn backup(&self, to: &Path) -> Result<Summary, BackupError> {
        let path = CollectionLock::path(self.dir());
        let _nothing_goes = CollectionLock::keep_away(self.dir()).await.map_err(disk("cannot lock", &path))?;
        self.check_identity().await.map_err(BackupError::Damaged)?;
        let absolute = std::path::absolute(to).map_err(disk("cannot find", to))?;
        // The nearest existing ancestor, with links resolved; the rest of the path does not exist yet.
        let there = absolute.ancestors().find_map(|path| path.canonicalize().ok()).unwrap_or_default();
        if there.starts_with(self.dir()) || self.dir().starts_with(&absolute) {
            return Err(BackupError::Folder(format!(
                "`{}` and the store's folder must not contain each other",
                to.display()
            )));
        }
        prepare(self, to)?;
        let to = to.canonicalize().map_err(disk("cannot find", to))?;
        let at_ms = clock::now_ms();
        let database = format!("stride-{at_ms}.db");
        let copy = to.join(&database);
        let rows = Rows::from(self.copy_to(&copy).await?);
        sync(&copy)?;
        let blobs = self.blobs().clone();
        let from = self.dir().to_owned();
        let store = self.id().clone();
        let ended = |e: tokio::task::JoinError| BackupError::Damaged(format!("copying stopped early: {e}"));
        let needed = retention::needed(self, &rows).await?;
        let work = move || {
            let blobs = copy_blobs(&blobs, &from, &to, needed)?;
            let (database_digest, database_bytes) = hashed(&copy).map_err(disk("cannot read", &copy))?;
            let manifest = Manifest { format: FORMAT, store, at_ms, database, database_bytes, database_digest, blobs };
            let text = serde_json::to_string_pretty(&manifest).unwrap_or_default();
            let path = to.join(MANIFEST);
            write_whole(&path, text.as_bytes()).map_err(disk("cannot write", &path))?;
            remove_what_is_over(&to, &manifest)?;
            Ok(manifest.summary())
        };
        tokio::task::spawn_blocking(work).await.map_err(ended)?
    }
}

/// Prepares the folder for a backup of this store.
fn prepare(store: &ReadStore, to: &Path) -> Result<(), BackupError> {
    let names = names(to)?;
    let folder = Folder::to_read(to);
    let marker = Marker::read(&folder).map_err(|e| BackupError::Damaged(e.to_string()))?;
    let is_ours = marker.as_ref().is_some_and(|marker| marker.store == *store.id());
    let is_store = names.iter().any(|name| name == folder::DATABASE || name == "lock");
    if !names.is_empty() && (!is_ours || is_store) {
        return Err(BackupError::Folder(format!(
            "`{}` is neither empty nor an older backup of this store",
            to.display()
        )));
    }
    make_dir(&to.join(BLOBS))?;
    claim(&folder, marker, store.id())
}

/// Marks the blobs at `place` as this store's. Fails if another process has just written a marker.
fn claim(place: &dyn Backend, old: Option<Marker>, store: &StoreId) -> Result<(), BackupError> {
    if old.is_some() {
        return Ok(());
    }
    let written = Marker { store: store.clone(), epoch: 0, held: None }.write(None, place);
    if written.map_err(|e| BackupError::Damaged(e.to_string()))? {
        return Ok(());
    }
    Err(BackupError::Folder(format!("`{}` has just been written by another process", place.marker_place())))
}

fn copy_blobs(
    blobs: &BlobStore,
    from: &Path,
    to: &Path,
    needed: Vec<Digest>,
) -> Result<BTreeMap<Digest, u64>, BackupError> {
    let mut copied = BTreeMap::new();
    let mut shards = BTreeSet::new();
    for digest in needed {
        let target = blob_path(to, digest);
        if target.exists()
            && let Ok(bytes) = expect(&target, digest)
        {
            copied.insert(digest, bytes);
            continue;
        }
        let shard = target.parent().unwrap_or(to).to_owned();
        if shards.insert(shard.clone()) {
            make_dir(&shard)?;
        }
        copied.insert(digest, copy_blob(blobs, &blob_path(from, digest), &target, digest)?);
    }
    shards.iter().try_for_each(|shard| sync(shard))?;
    sync(&to.join(BLOBS))?;
    sync(to)?;
    Ok(copied)
}

/// Copies a blob through a temporary file; the final name appears only when the copy is complete. The file system may
/// share the bytes copy-on-write, but files are never hard-linked: damage to the store must not reach a backup.
fn copy_blob(blobs: &BlobStore, source: &Path, target: &Path, digest: Digest) -> Result<u64, BackupError> {
    let part = target.with_extension("part");
    let _ = fs::remove_file(&part);
    let copied = regular(OpenOptions::new().read(true), source)
        .and_then(|mut file| io::copy(&mut file, &mut File::create(&part)?));
    if copied.is_err() {
        let damaged = |e: BlobError| BackupError::Damaged(e.to_string());
        let mut reader = blobs.read(digest).map_err(damaged)?;
        let mut file = File::create(&part).map_err(disk("cannot write", &part))?;
        while let Some(bytes) = reader.next_part().map_err(damaged)? {
            file.write_all(&bytes).map_err(disk("cannot write", &part))?;
        }
    }
    let bytes = expect(&part, digest)?;
    sync(&part)?;
    fs::rename(&part, target).map_err(disk("cannot write", target))?;
    Ok(bytes)
}

/// Removes files that only an older backup in the same folder needed.
fn remove_what_is_over(to: &Path, manifest: &Manifest) -> Result<(), BackupError> {
    let remove = |path: &Path| fs::remove_file(path).map_err(disk("cannot remove", path));
    for name in names(to)? {
        if name.starts_with("stride-") && name != manifest.database {
            remove(&to.join(name))?;
        }
    }
    let blobs = to.join(BLOBS);
    for shard in names(&blobs)? {
        for name in names(&blobs.join(&shard))? {
            let digest = format!("sha256:{shard}{name}").parse::<Digest>();
            if !digest.is_ok_and(|digest| manifest.blobs.contains_key(&digest)) {
                remove(&blobs.join(&shard).join(name))?;
            }
        }
    }
    Ok(())
}

/// Restores a backup into `to`, which must be missing or empty. `place` optionally gives another place for the blobs,
/// which must be empty or hold blobs of the same store. The store appears under its name only after all of it was
/// verified.
pub async fn restore(backup: &Path, to: &Path, place: Option<&Place>) -> Result<Summary, BackupError> {
    let Some(manifest) = Manifest::read(backup)? else {
        return Err(BackupError::Folder(format!(
            "there is no finished backup in `{}`: `{MANIFEST}` is missing",
            backup.display()
        )));
    };
    if !names(to)?.is_empty() {
        return Err(BackupError::Folder(format!(
            "`{}` is not empty; restore into an empty or missing folder",
            to.display()
        )));
    }
    let to = std::path::absolute(to).map_err(disk("cannot find", to))?;
    let (Some(parent), Some(name)) = (to.parent(), to.file_name()) else {
        return Err(BackupError::Folder(format!("`{}` cannot be a store's folder", to.display())));
    };
    make_dir(parent)?;
    let fresh = parent.join(format!(".{}.restoring", name.to_string_lossy()));
    match fs::remove_dir_all(&fresh) {
        Err(e) if e.kind() != ErrorKind::NotFound => return Err(disk("cannot remove", &fresh)(e)),
        _ => {}
    }
    let made = verified(backup, &fresh, &manifest, place).await;
    if let Err(e) = made {
        // The first error matters more than a failed clean-up; the next try cleans up again.
        let _ = fs::remove_dir_all(&fresh);
        return Err(e);
    }
    fs::rename(&fresh, &to).map_err(disk("cannot make", &to))?;
    sync(parent)?;
    Ok(manifest.summary())
}

/// Makes a store from a backup in `fresh` and checks it as `fsck` does.
async fn verified(backup: &Path, fresh: &Path, manifest: &Manifest, place: Option<&Place>) -> Result<(), BackupError> {
    let from = backup.to_owned();
    let to = fresh.to_owned();
    let parts = manifest.clone();
    let place = place.cloned();
    let ended = |e: tokio::task::JoinError| BackupError::Damaged(format!("copying stopped early: {e}"));
    let copied = tokio::task::spawn_blocking(move || copy_back(&from, &to, &parts, place)).await.map_err(ended)?;
    // Every other copy of the database is refused from then on.
    sqlite::reach_epoch(fresh, copied?).await.map_err(QueryError::from)?;
    let unsound =
        |problem: String| BackupError::Damaged(format!("the backup is damaged and was not restored: {problem}"));
    let read = ReadStore::open(fresh).await.map_err(|e| unsound(e.to_string()))?;
    let problems = read.fsck().await?.problems;
    read.close().await;
    match problems.first() {
        None => Ok(()),
        Some(first) => Err(unsound(format!("{} problems; the first: {first}", problems.len()))),
    }
}

/// Copies a backup to `fresh` and its blobs to `place`. Returns the epoch in the marker there.
fn copy_back(backup: &Path, fresh: &Path, manifest: &Manifest, place: Option<Place>) -> Result<u64, BackupError> {
    make_dir(&fresh.join("blobs"))?;
    let from = backup.join(&manifest.database);
    let to = fresh.join(folder::DATABASE);
    // Copied, not linked: a store must not share files with its backup.
    fs::copy(&from, &to).map_err(disk("cannot copy", &from))?;
    expect(&to, manifest.database_digest)?;
    sync(&to)?;

    let unusable = |e: BlobError| BackupError::Folder(e.to_string());
    if let Some(place) = &place {
        place.remember(fresh).map_err(disk("cannot write to", fresh))?;
    }
    let location = place.unwrap_or_else(|| Place::Folder(fresh.to_owned())).locate(fresh).map_err(unusable)?;
    let place_blobs = location.to_read().map_err(disk("cannot read", fresh))?;
    let marker = Marker::read(&*place_blobs).map_err(|e| BackupError::Folder(e.to_string()))?;
    let is_foreign = match &marker {
        Some(marker) => marker.store != manifest.store,
        None => !place_blobs.is_empty().map_err(unusable)?,
    };
    if is_foreign {
        let why = format!("there are blobs of another store: see `{}`", place_blobs.marker_place());
        return Err(BackupError::Folder(why));
    }
    let own = lease::lock_of(fresh).map_err(disk("cannot read", fresh))?;
    let free = lease::wait_until_free(&*place_blobs, &own, LeaseTerms::default());
    free.map_err(|e| BackupError::Folder(e.to_string()))?.map_err(|by| {
        BackupError::Folder(format!("{by} holds the blobs (`{}`); stop that process first", place_blobs.marker_place()))
    })?;
    let marker = Marker::read(&*place_blobs).map_err(|e| BackupError::Folder(e.to_string()))?;
    let epoch = marker.as_ref().map_or(0, |marker| marker.epoch);
    claim(&*place_blobs, marker, &manifest.store)?;
    let blobs = location.open().map_err(disk("cannot open the blobs of", fresh))?;
    for digest in manifest.blobs.keys() {
        put_back(&blobs, &blob_path(backup, *digest), *digest)?;
    }
    File::create(fresh.join("lock")).map_err(disk("cannot write to", fresh))?;
    sync(fresh)?;
    Ok(epoch)
}

/// Stores a backup's blob unless the store has it already.
fn put_back(blobs: &BlobStore, from: &Path, digest: Digest) -> Result<(), BackupError> {
    let stored = |e: BlobError| match e {
        e @ BlobError::Corrupt { .. } => BackupError::Damaged(format!("`{}` is damaged: {e}", from.display())),
        e => BackupError::Folder(e.to_string()),
    };
    if blobs.reuse(digest).map_err(stored)? {
        return Ok(());
    }
    let mut file = File::open(from).map_err(disk("cannot read", from))?;
    let bytes = file.metadata().map_err(disk("cannot read", from))?.len();
    let mut upload = blobs.begin(bytes).map_err(stored)?;
    let mut part = vec![0; 1 << 20];
    loop {
        let read = file.read(&mut part).map_err(disk("cannot read", from))?;
        if read == 0 {
            return blobs.commit(upload, digest).map_err(stored);
        }
        upload.write(&part[..read]).map_err(stored)?;
    }
}
