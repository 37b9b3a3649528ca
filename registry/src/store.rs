//! The store as a whole: a folder with a database, blobs and a lock.
//!
//! ```text
//! .stride/
//!   stride.db        SQLite, WAL
//!   witness          how many transactions the database has had, at least
//!   blobs/IDENTITY   which store the blobs belong to
//!   blobs/sha256/    bytes by digest
//!   blobs/PLACE      where else these two are, if they are elsewhere
//!   reserve          given up on a full disk, so that there is space to collect in
//!   staging/         blobs on their way; emptied when the store is opened
//!   lock             the operating system's lock, and who holds it
//! ```
//!
//! One process holds a store. A second one is told who, and asks that one over HTTP.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use checkpoint::BlobError;
use protocol::stage::Keep;
use protocol::{Alias, Digest, Group, ModelName, RunId, TaskId};

use crate::blob::disk::free_bytes;
use crate::blob::place::{Looked, Place};
use crate::blob::{Backend, BlobStore};
use crate::calls::Calls;
use crate::catalog::{Catalog, Done, Order, PromoteOrder, Records, RollbackOrder, Which};
use crate::forget::Forgotten;
use crate::identity::{self, Found, Held, Marker, MarkerError, Verdict, Witness};
use crate::lease::{self, Lease, LeaseTerms};
use crate::lock::{self, Holder, SharedLock, StoreLock, Taken, network_filesystem};
use crate::open_error::OpenError;
use crate::proofs::Proofs;
use crate::reserve::{self, OPEN_NEEDS_BYTES};
use crate::scoped::ScopedRecords;
use crate::server_key::{self, ServerKey};
use crate::sqlite::{Opened, Session, SqliteCatalog, SqliteRecords, Writer};
use crate::store_id::{StoreId, Stored};
use crate::versions::{Expect, Pick, Promotion};
use crate::{WriteError, clock, folder, sqlite};

/// What a store can be asked, from what is committed. A [`Store`] is one; a process that only reads opens one by itself, whether
/// or not somebody holds the store. It starts nothing and writes nothing. Clones share it.
#[derive(Debug, Clone)]
pub struct ReadStore(Arc<Reading>);

#[derive(Debug)]
struct Reading {
    dir: PathBuf,
    id: StoreId,
    opened_ms: i64,
    blobs: BlobStore,
    calls: Calls,
    records: Arc<dyn Records>,
    /// Keeps writers out of a database that is read without its log.
    _closed: Option<Arc<SharedLock>>,
}

/// A store, held by this process. Clones share it; the last one to go lets it go.
#[derive(Debug, Clone)]
pub struct Store(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    read: ReadStore,
    /// Before `lock`: the writer ends first, and then nobody holds the blobs.
    catalog: Box<dyn Catalog>,
    _lease: Option<Lease>,
    lock: Arc<StoreLock>,
    proofs: Arc<Proofs>,
}

impl std::ops::Deref for Store {
    type Target = ReadStore;

    fn deref(&self) -> &ReadStore {
        &self.0.read
    }
}

impl std::ops::Deref for ReadStore {
    type Target = dyn Records;

    fn deref(&self) -> &Self::Target {
        &*self.0.records
    }
}

impl ReadStore {
    /// Opens the store in `dir` for reading only.
    pub async fn open(dir: &Path) -> Result<Self, OpenError> {
        there(dir).await?;
        let io = |path: &Path, e: io::Error| OpenError::io(path, &e);
        let dir = dir.canonicalize().map_err(|e| io(dir, e))?;
        if let Some(kind) = network_filesystem(&dir).map_err(|e| io(&dir, e))? {
            return Err(OpenError::NetworkFilesystem { dir, kind });
        }
        // Without a log the database file is all there is. As long as writers are kept out it does not change, and is read
        // as a file: reading through a log would have to make one. With a log, SQLite keeps readers and the writer apart.
        let shared = SharedLock::try_take(&dir.join("lock")).map_err(|e| io(&dir.join("lock"), e))?;
        let closed = shared.filter(|_| folder::log_bytes(&dir) == 0);
        // Before the database: the witness and the marker never know of more than what is committed.
        let seen = Seen::of(&dir, &Asked::Remembered, false).await?;
        let id = sqlite::check_to_read(&dir, &seen.found, closed.is_some()).await?;
        let blobs = BlobStore::beside(seen.blobs, &seen.looked.verified());
        let records = Arc::new(SqliteRecords::new(sqlite::open_readers(&dir, closed.is_some())));
        let opened_ms = clock::now_ms();
        Ok(Self(Arc::new(Reading {
            dir,
            id,
            opened_ms,
            blobs,
            calls: Calls::default(),
            records,
            _closed: closed.map(Arc::new),
        })))
    }

    /// The store as `group` sees it: its own runs and models, and no name of any other.
    #[must_use]
    pub fn seen_by(&self, group: &Group) -> Self {
        let Reading { dir, id, opened_ms, blobs, calls, records, _closed } = &*self.0;
        Self(Arc::new(Reading {
            dir: dir.clone(),
            id: id.clone(),
            opened_ms: *opened_ms,
            blobs: blobs.clone(),
            calls: calls.clone(),
            records: Arc::new(ScopedRecords::new(Arc::clone(records), group.clone())),
            _closed: _closed.clone(),
        }))
    }

    /// Who holds the store in `dir` now, if somebody does. There need be no store.
    pub fn holder_of(dir: &Path) -> Result<Option<Holder>, OpenError> {
        let path = dir.join("lock");
        lock::holder(&path).map_err(|e| OpenError::io(&path, &e))
    }

    /// Ends its connections to the database, which would otherwise end some time after the last clone is gone.
    pub async fn close(self) {
        self.0.records.close().await;
    }

    /// The store's name, which no other store has.
    pub fn id(&self) -> &StoreId {
        &self.0.id
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.0.dir
    }

    /// The blobs. Their calls block.
    pub fn blobs(&self) -> &BlobStore {
        &self.0.blobs
    }

    /// Makes a call that asks the place where the blobs lie, beside the threads that answer others.
    pub async fn ask_blobs<T: Send + 'static>(&self, call: impl FnOnce() -> T + Send + 'static) -> T {
        self.0.calls.run(call).await
    }

    pub(crate) fn calls(&self) -> &Calls {
        &self.0.calls
    }

    /// When this process opened it, in milliseconds since 1970.
    pub(crate) fn opened_ms(&self) -> i64 {
        self.0.opened_ms
    }

    /// Says what is wrong if the database or the blobs are not those that were opened: somebody has removed, emptied or replaced
    /// them since.
    pub(crate) async fn check_identity(&self) -> Result<(), String> {
        identity::check(self.id(), self.dir(), self.blobs().place(), &**self).await
    }
}

impl Store {
    /// Opens the store in `dir`, making it if there is none. `holder` says to others what this process is.
    pub async fn open(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        Self::open_with(dir, None, holder).await
    }

    /// The same; `blobs` is where the blobs of a new store are to lie, and where those of one that is there must be.
    pub async fn open_with(dir: &Path, blobs: Option<&Place>, holder: Holder) -> Result<Self, OpenError> {
        let io = |path: &Path, e: io::Error| OpenError::io(path, &e);
        if !folder::has_database(dir) && Seen::of(dir, &Asked::Remembered, false).await?.found.evidence().is_none() {
            refuse_other_files(dir)?;
        }
        DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|e| io(dir, e))?;
        Self::take(dir, Asked::named(blobs), holder, Purpose::Work).await
    }

    /// Opens the store in `dir`, making it if there is none, with its blobs at a place that no name leads to: for tests.
    pub async fn open_over(
        dir: &Path,
        blobs: Arc<dyn Backend>,
        holder: Holder,
        terms: LeaseTerms,
    ) -> Result<Self, OpenError> {
        let io = |path: &Path, e: io::Error| OpenError::io(path, &e);
        DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|e| io(dir, e))?;
        Self::take_by(dir, Asked::Given(blobs), holder, Purpose::Work, terms).await
    }

    /// Opens a store that is there.
    pub async fn open_existing(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        there(dir).await?;
        Self::take(dir, Asked::Remembered, holder, Purpose::Work).await
    }

    /// Opens a store whose blobs are missing or were moved to `blobs`, or whose database has gone back, and makes what is left one
    /// store again. What was lost stays lost: blobs that only lost rows named go with the next collection.
    pub async fn adopt(dir: &Path, blobs: Option<&Place>, holder: Holder) -> Result<Self, OpenError> {
        there(dir).await?;
        Self::take(dir, Asked::named(blobs), holder, Purpose::Adopt).await
    }

    /// Opens a store that is there to collect what nothing needs: on a full disk as well, which is when it has to be done.
    pub async fn open_to_collect(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        there(dir).await?;
        Self::take(dir, Asked::Remembered, holder, Purpose::Collect).await
    }

    async fn take(dir: &Path, place: Asked, holder: Holder, purpose: Purpose) -> Result<Self, OpenError> {
        Self::take_by(dir, place, holder, purpose, LeaseTerms::default()).await
    }

    async fn take_by(
        dir: &Path,
        place: Asked,
        holder: Holder,
        purpose: Purpose,
        terms: LeaseTerms,
    ) -> Result<Self, OpenError> {
        let io = |path: &Path, e: io::Error| OpenError::io(path, &e);
        let dir = dir.canonicalize().map_err(|e| io(dir, e))?;
        close_to_others(&dir).map_err(|e| io(&dir, e))?;
        if let Some(kind) = network_filesystem(&dir).map_err(|e| io(&dir, e))? {
            return Err(OpenError::NetworkFilesystem { dir, kind });
        }
        let path = dir.join("lock");
        let lock = match StoreLock::take(&path, holder).await.map_err(|e| io(&path, e))? {
            Taken::Ours(lock) => Arc::new(lock),
            Taken::Busy(holder) => return Err(OpenError::Busy { dir, holder }),
        };
        let free = free_bytes(&dir).map_err(|e| io(&dir, e))?;
        if purpose == Purpose::Collect {
            reserve::release_if_full(&dir);
        } else if free < OPEN_NEEDS_BYTES {
            let message = format!("{free} bytes are free, {OPEN_NEEDS_BYTES} are needed");
            return Err(OpenError::Full { path: dir, message });
        }
        // Under the lock: nobody is making the store at the same time.
        let adopt = purpose == Purpose::Adopt;
        let mut seen = Seen::of(&dir, &place, adopt).await?;
        let is_shared = seen.looked.is_shared(&dir);
        if is_shared && seen.found.marker().is_some_and(|marker| marker.held.is_some()) {
            wait_until_free(&dir, &seen, terms).await?;
            seen = Seen::of(&dir, &place, adopt).await?;
        }
        if seen.to_remember && !folder::has_database(&dir) && seen.found.evidence().is_none() {
            // Before the database is there: one that is there knows where its blobs are.
            seen.place.remember(&dir).map_err(|e| io(&dir, e))?;
        }
        let Opened { mut conn, store: id, verdict } = sqlite::open_writer(&dir, &seen.found, adopt).await?;
        if seen.to_remember && adopt {
            seen.place.remember(&dir).map_err(|e| io(&dir, e))?;
        }
        let (looked, opening) = (seen.looked, dir.clone());
        let opened = tokio::task::spawn_blocking(move || looked.open()).await;
        let blobs = opened.map_err(|e| io(&opening, io::Error::other(e)))?.map_err(|e| io(&opening, e))?;
        let mut marker = seen.found.marker().cloned();
        if let Verdict::New | Verdict::Unfinished(_) = verdict {
            marker = Some(mark(&dir, &blobs, marker, &Stored { id: id.clone(), epoch: 0, commits: 0 }, None).await?);
        }
        let stored = sqlite::raise_epoch(&dir, &mut conn).await?;
        let held = is_shared.then(|| lease::held(&dir, &lock.holder())).transpose().map_err(|e| io(&dir, e))?;
        let begun = Instant::now();
        let marker = mark(&dir, &blobs, marker, &stored, held).await?;
        let lease = is_shared.then(|| Lease::begin(blobs.place(), marker, begun, terms));
        let lease = lease.transpose().map_err(|e| io(&dir, e))?;
        if let Some(lease) = &lease {
            let check = lease.checked();
            blobs.permit_removals_by(move || check.may_remove());
        }
        let witness = Witness::begin(&dir, &stored).map_err(|e| io(&dir, e))?;
        reserve::keep(&dir);
        let session = Session { conn, epoch: stored.epoch, witness };
        let proofs = Arc::new(Proofs::new(lease.as_ref().map(Lease::checked)));
        let writer = Writer::start(session, Arc::clone(&proofs), Arc::clone(&lock)).map_err(|e| io(&dir, e))?;
        let records = Arc::new(SqliteRecords::new(sqlite::open_readers(&dir, false)));
        let catalog = Box::new(SqliteCatalog { writer, records: Arc::clone(&records) });
        let opened_ms = clock::now_ms();
        let read =
            ReadStore(Arc::new(Reading { dir, id, opened_ms, blobs, calls: Calls::default(), records, _closed: None }));
        Ok(Self(Arc::new(Inner { read, catalog, _lease: lease, lock, proofs })))
    }

    /// What is kept besides the blobs.
    pub fn catalog(&self) -> &dyn Catalog {
        &*self.0.catalog
    }

    /// The key of this store's server, made when it is first asked for. Read from the disk each time.
    pub fn server_key(&self) -> io::Result<ServerKey> {
        server_key::read_or_make(self.dir())
    }

    /// Tells other processes where this one answers requests.
    pub fn set_address(&self, address: impl Into<String>) -> io::Result<()> {
        self.0.lock.set_address(address.into())
    }

    /// What others are told about this process.
    pub fn holder(&self) -> Holder {
        self.0.lock.holder()
    }

    /// Moves an alias to a version: compares it with `expect` if given, judges the gates, moves, logs.
    #[expect(clippy::too_many_arguments, reason = "what a promotion is made of")]
    pub async fn promote(
        &self,
        model: &ModelName,
        pick: Pick,
        alias: &Alias,
        expect: Option<Expect>,
        require: Vec<String>,
        reason: &str,
        actor: &str,
    ) -> Result<Promotion, WriteError> {
        let order = PromoteOrder {
            model: model.clone(),
            alias: alias.clone(),
            to: Which::Pick(pick),
            expect,
            require,
            reason: reason.to_owned(),
            actor: actor.to_owned(),
        };
        promoted(self.order(Order::Promote(order)).await?)
    }

    /// Moves an alias back to `to`, or to the version before its last promotion. This is a log entry itself.
    pub async fn rollback(
        &self,
        model: &ModelName,
        alias: &Alias,
        to: Option<u64>,
        expect: Option<Expect>,
        reason: &str,
        actor: &str,
    ) -> Result<Promotion, WriteError> {
        let (model, alias, reason, actor) = (model.clone(), alias.clone(), reason.to_owned(), actor.to_owned());
        promoted(self.order(Order::Rollback(RollbackOrder { model, alias, to, expect, reason, actor })).await?)
    }

    /// Forgets a task's checkpoints but those that `keep` names; returns the manifests that were forgotten. Their blobs go
    /// with the next [`Self::gc`].
    pub async fn prune_checkpoints(&self, task: &TaskId, keep: Keep) -> Result<Vec<Digest>, WriteError> {
        match self.order(Order::PruneCheckpoints { task: task.clone(), keep }).await? {
            Done::Pruned(manifests) => Ok(manifests),
            done => Err(unexpected(&done)),
        }
    }

    /// Keeps an artifact whatever else points at it.
    pub async fn pin(&self, digest: Digest, reason: &str) -> Result<(), WriteError> {
        self.order_proven(&[digest], || Order::Pin { digest, reason: Some(reason.to_owned()) }).await.map(|_| ())
    }

    /// Ends a pin.
    pub async fn unpin(&self, digest: Digest) -> Result<(), WriteError> {
        self.order(Order::Pin { digest, reason: None }).await.map(|_| ())
    }

    /// Forgets a run that has ended. Its blobs go with the next [`Self::gc`].
    pub async fn forget(&self, run: &RunId) -> Result<Forgotten, WriteError> {
        match self.order(Order::Forget(run.clone())).await? {
            Done::Forgotten(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Forgets what a run that ended before a time has left behind and nobody needs: trials of sweeps that are not the best, and
    /// checkpoints and shards of stages that came to no value. The run stays. Blobs go with the next [`Self::gc`].
    pub async fn forget_leftovers(&self, run: &RunId, before_ms: i64) -> Result<Forgotten, WriteError> {
        match self.order(Order::ForgetLeftovers { run: run.clone(), before_ms }).await? {
            Done::Forgotten(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// What is proven, and what rows come to name while a collection is under way.
    pub(crate) fn proofs(&self) -> &Arc<Proofs> {
        &self.0.proofs
    }

    /// Forgets the rows that a collection takes with it; returns the tasks whose shards went.
    pub(crate) async fn begin_collection(&self) -> Result<Vec<TaskId>, WriteError> {
        match self.order(Order::BeginCollection).await? {
            Done::Begun(forgotten) => Ok(forgotten),
            done => Err(unexpected(&done)),
        }
    }

    /// Takes away what is known of blobs that no row has come to name; returns those.
    pub(crate) async fn condemn(&self, blobs: Vec<Digest>) -> Result<Vec<Digest>, WriteError> {
        match self.order(Order::Condemn(blobs)).await? {
            Done::Condemned(taken) => Ok(taken),
            done => Err(unexpected(&done)),
        }
    }

    pub(crate) async fn order(&self, order: Order) -> Result<Done, WriteError> {
        self.0.catalog.commit(order).await
    }
}

/// Takes the folder from everybody but its user; one who cannot reach it reaches nothing in it. A folder of somebody else, or
/// of a group that was let in by hand, stays as it is.
fn close_to_others(dir: &Path) -> io::Result<()> {
    let metadata = fs::metadata(dir)?;
    let mode = metadata.permissions().mode();
    if mode & 0o007 != 0 && metadata.uid() == nix::unistd::geteuid().as_raw() {
        fs::set_permissions(dir, fs::Permissions::from_mode(mode & !0o077))?;
    }
    Ok(())
}

/// What a store is opened for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Purpose {
    Work,
    Collect,
    Adopt,
}

/// Where the blobs are said to lie.
#[derive(Debug, Clone)]
enum Asked {
    /// Where the folder says.
    Remembered,
    /// Where the caller says.
    Named(Place),
    /// Here.
    Given(Arc<dyn Backend>),
}

impl Asked {
    fn named(place: Option<&Place>) -> Self {
        place.map_or(Self::Remembered, |place| Self::Named(place.clone()))
    }
}

/// A store as it can be seen without its database.
struct Seen {
    place: Place,
    /// Whether the folder does not say so yet.
    to_remember: bool,
    looked: Looked,
    blobs: Arc<dyn Backend>,
    found: Found,
}

impl Seen {
    /// Looks, changing nothing. `asked` is where the blobs are said to be; elsewhere is an error unless they `moved` there or
    /// the store is still to be made.
    async fn of(dir: &Path, asked: &Asked, moved: bool) -> Result<Self, OpenError> {
        let (dir, asked) = (dir.to_owned(), asked.clone());
        let path = dir.clone();
        let looking = tokio::task::spawn_blocking(move || Self::look(&dir, asked, moved));
        looking.await.map_err(|e| OpenError::io(&path, &io::Error::other(e)))?
    }

    fn look(dir: &Path, asked: Asked, moved: bool) -> Result<Self, OpenError> {
        let io = |e: io::Error| OpenError::io(&dir.join("blobs/PLACE"), &e);
        let here = Place::Folder(std::path::absolute(dir).map_err(io)?);
        let remembered = Place::remembered(dir).map_err(io)?;
        let is_new = remembered.is_none() && !folder::has_database(dir);
        let current = remembered.unwrap_or(here);
        let (asked, given) = match asked {
            Asked::Remembered => (current.clone(), None),
            Asked::Named(place) => (place, None),
            Asked::Given(blobs) => (current.clone(), Some(blobs)),
        };
        let to_remember = asked != current;
        if to_remember && !moved && !is_new {
            return Err(OpenError::Elsewhere { dir: dir.to_owned(), place: current, asked });
        }
        let place = asked;
        let blobs_error = |e: BlobError| OpenError::Blobs { dir: dir.to_owned(), message: e.to_string() };
        let looked = match given {
            Some(blobs) => Looked::Given(blobs, dir.to_owned()),
            None => place.look(dir).map_err(blobs_error)?,
        };
        let blobs = looked.to_read().map_err(io)?;
        let found = Found::look(dir, &*blobs).map_err(|e| match e {
            MarkerError::Blob(e) => blobs_error(e),
            MarkerError::Mismatch(mismatch) => OpenError::Mismatch { dir: dir.to_owned(), mismatch },
        })?;
        if to_remember && moved && found.marker().is_none() {
            let marker = blobs.marker_place();
            let message =
                format!("`{marker}` does not exist; copy the blobs of the store there first, and this with them");
            return Err(OpenError::Blobs { dir: dir.to_owned(), message });
        }
        Ok(Self { place, to_remember, looked, blobs, found })
    }
}

/// Refuses a folder that is not, and never was, a store.
async fn there(dir: &Path) -> Result<(), OpenError> {
    if folder::has_database(dir) {
        return Ok(());
    }
    match Seen::of(dir, &Asked::Remembered, false).await?.found.evidence() {
        Some(_) => Ok(()),
        None => Err(OpenError::NotAStore(dir.to_owned())),
    }
}

/// Waits until no other process holds the blobs of a store that is about to be opened.
async fn wait_until_free(dir: &Path, seen: &Seen, terms: LeaseTerms) -> Result<(), OpenError> {
    let own = lease::lock_of(dir).map_err(|e| OpenError::io(dir, &e))?;
    let (place, marker) = (Arc::clone(&seen.blobs), seen.blobs.marker_place());
    let waiting = tokio::task::spawn_blocking(move || lease::wait_until_free(&*place, &own, terms));
    let failed = |message: String| OpenError::Blobs { dir: dir.to_owned(), message };
    let waited = waiting.await.map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))?;
    waited.map_err(|by| OpenError::Held { dir: dir.to_owned(), by, marker })
}

/// Puts the marker of a store that was opened beside its blobs, in the place of the `old` one.
async fn mark(
    dir: &Path,
    blobs: &BlobStore,
    old: Option<Marker>,
    stored: &Stored,
    held: Option<Held>,
) -> Result<Marker, OpenError> {
    let marker = Marker { store: stored.id.clone(), epoch: stored.epoch, held };
    let (place, written) = (blobs.place(), marker.clone());
    let writing = tokio::task::spawn_blocking(move || written.write(old.as_ref(), &*place));
    let failed = |message: String| OpenError::Blobs { dir: dir.to_owned(), message };
    if writing.await.map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))? {
        return Ok(marker);
    }
    let place = blobs.place().marker_place();
    Err(failed(format!(
        "another process has just taken these blobs for its store: `{place}` has changed; each store needs a place of its own"
    )))
}

/// Names that a store's folder may have before its database is there.
const OF_A_STORE: [&str; 7] = ["lock", "blobs", "staging", "witness", "witness.new", "reserve", server_key::FILE];

/// A store is not made in a folder that holds something else.
fn refuse_other_files(dir: &Path) -> Result<(), OpenError> {
    let entries = match fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(OpenError::io(dir, &e)),
    };
    let mut other = Vec::new();
    for entry in entries {
        let name = entry.map_err(|e| OpenError::io(dir, &e))?.file_name();
        let name = name.to_string_lossy();
        // Beside the database lie its log and, while it is made, a journal.
        if !OF_A_STORE.contains(&&*name) && !name.starts_with(folder::DATABASE) {
            other.push(format!("`{name}`"));
        }
    }
    other.sort();
    match other.len() {
        0 => Ok(()),
        1..=3 => Err(OpenError::NotEmpty { dir: dir.to_owned(), found: other.join(", ") }),
        more => {
            let found = format!("{} and {} more", other[..3].join(", "), more - 3);
            Err(OpenError::NotEmpty { dir: dir.to_owned(), found })
        }
    }
}

fn promoted(done: Done) -> Result<Promotion, WriteError> {
    match done {
        Done::Promoted(promotion) => Ok(*promotion),
        done => Err(unexpected(&done)),
    }
}

fn unexpected(done: &Done) -> WriteError {
    WriteError::Internal(format!("the writer answered {done:?} to another order"))
}
