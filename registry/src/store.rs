//! The store: a folder with a database, blobs and a lock. The database may be in PostgreSQL instead.
//!
//! ```text
//! .stride/
//!   stride.db        SQLite, WAL
//!   CATALOG          address of the database, if it is in PostgreSQL
//!   witness          lower bound of the number of transactions in the database
//!   blobs/IDENTITY   the store that the blobs belong to
//!   blobs/sha256/    bytes by digest
//!   blobs/PLACE      location of these two, if they are elsewhere
//!   reserve          space released on a full disk for a collection
//!   staging/         arriving blobs; cleared when the store is opened
//!   lock             the operating system's lock, with the holder's name
//! ```
//!
//! One process holds a store. With PostgreSQL several folders may belong to a store, and one process leads
//! ([`Leadership`]). A second one gets the holder's name and sends its requests there over HTTP.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use checkpoint::BlobError;
use protocol::stage::Keep;
use protocol::{Alias, Digest, Group, ModelName, RunId, TaskId};

use crate::blob::disk::{free_bytes, write_whole};
use crate::blob::place::{Location, Place};
use crate::blob::{Backend, BlobStore};
use crate::calls::Calls;
use crate::catalog::{Catalog, Done, Order, PostgresAddress, PromoteOrder, Records, RollbackOrder, Which};
use crate::forget::Forgotten;
use crate::identity::{self, Held, Marker, MarkerError, StoreParts, Verdict, Witness};
use crate::lease::{self, Lease, LeaseTerms};
use crate::lock::{self, Holder, SharedLock, StoreLock, Taken, network_filesystem};
use crate::open_error::OpenError;
use crate::proofs::Proofs;
use crate::reserve::{self, OPEN_NEEDS_BYTES};
use crate::scoped::ScopedRecords;
use crate::server_key::{self, ServerKey};
use crate::sql::{self, LeaderTerms, Leadership, Link, Opened, Session, SqlCatalog, SqlRecords, Writer};
use crate::store_id::{StoreId, Stored};
use crate::versions::{Expect, Pick, Promotion};
use crate::{WriteError, clock, folder};

/// Read access to the committed data of a store. A [`Store`] contains one. A read-only process opens its own, even
/// while another process holds the store; it starts and writes nothing. Clones share it.
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
    /// Address of the database, unless it is a file of the folder.
    address: Option<PostgresAddress>,
    /// Blocks writers while a database without a log is read.
    _closed: Option<Arc<SharedLock>>,
}

/// A store held by this process. Clones share it; dropping the last one releases it.
#[derive(Debug, Clone)]
pub struct Store(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    read: ReadStore,
    /// Declared before `lock`, so that the writer ends before the blobs are released.
    catalog: Box<dyn Catalog>,
    _lease: Option<Lease>,
    lock: Arc<StoreLock>,
    proofs: Arc<Proofs>,
    leading: Option<Leading>,
}

/// The state of a process that leads a catalog in PostgreSQL.
#[derive(Debug)]
struct Leading {
    leadership: Leadership,
    server_key: ServerKey,
}

/// A catalog in PostgreSQL, and the terms under which a process leads it.
#[derive(Debug, Clone)]
pub struct PostgresCatalog {
    pub address: PostgresAddress,
    pub terms: LeaderTerms,
}

impl From<PostgresAddress> for PostgresCatalog {
    fn from(address: PostgresAddress) -> Self {
        Self { address, terms: LeaderTerms::default() }
    }
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
        if let Some(address) = remembered_catalog(&dir)? {
            return Self::open_postgres(dir, address).await;
        }
        // Without a log the database file is complete and does not change while writers are blocked, so it is opened
        // immutably. Reading it in WAL mode would create a log. With a log, SQLite isolates readers from the writer.
        let shared = SharedLock::try_take(&dir.join("lock")).map_err(|e| io(&dir.join("lock"), e))?;
        let closed = shared.filter(|_| folder::log_bytes(&dir) == 0);
        // Read before the database, because the witness and the marker never exceed the committed state.
        let inspection = Inspection::of(&dir, &RequestedPlace::Remembered, false).await?;
        let id = sql::sqlite::check_to_read(&dir, &inspection.found, closed.is_some()).await?;
        let blobs = BlobStore::over(inspection.blobs);
        let records = Arc::new(SqlRecords::new(sql::sqlite::open_readers(&dir, closed.is_some())));
        let opened_ms = clock::now_ms();
        Ok(Self(Arc::new(Reading {
            dir,
            id,
            opened_ms,
            blobs,
            calls: Calls::default(),
            records,
            address: None,
            _closed: closed.map(Arc::new),
        })))
    }

    async fn open_postgres(dir: PathBuf, address: PostgresAddress) -> Result<Self, OpenError> {
        let mut inspection = Inspection::of(&dir, &RequestedPlace::Remembered, false).await?;
        inspection.found.name_database(sql::postgres::name(&address));
        let id = sql::postgres::check_to_read(&address, &dir, &inspection.found).await?;
        let records = Arc::new(SqlRecords::new(sql::postgres::open_readers(&address)?));
        Ok(Self(Arc::new(Reading {
            dir,
            id,
            opened_ms: clock::now_ms(),
            blobs: BlobStore::over(inspection.blobs),
            calls: Calls::default(),
            records,
            address: Some(address),
            _closed: None,
        })))
    }

    /// Returns the store as `group` sees it: only its own runs and models.
    #[must_use]
    pub fn seen_by(&self, group: &Group) -> Self {
        let Reading { dir, id, opened_ms, blobs, calls, records, address, _closed } = &*self.0;
        Self(Arc::new(Reading {
            dir: dir.clone(),
            id: id.clone(),
            opened_ms: *opened_ms,
            blobs: blobs.clone(),
            calls: calls.clone(),
            records: Arc::new(ScopedRecords::new(Arc::clone(records), group.clone())),
            address: address.clone(),
            _closed: _closed.clone(),
        }))
    }

    /// Returns the process that holds the store in `dir`, if there is one. The store need not exist.
    pub fn holder_of(dir: &Path) -> Result<Option<Holder>, OpenError> {
        let path = dir.join("lock");
        lock::holder(&path).map_err(|e| OpenError::io(&path, &e))
    }

    /// Closes the connections to the database now instead of some time after the last clone is dropped.
    pub async fn close(self) {
        self.0.records.close().await;
    }

    /// Returns the store's unique identity.
    pub fn id(&self) -> &StoreId {
        &self.0.id
    }

    /// Returns the store's folder.
    pub fn dir(&self) -> &Path {
        &self.0.dir
    }

    /// Returns the blobs. Their calls block.
    pub fn blobs(&self) -> &BlobStore {
        &self.0.blobs
    }

    /// Runs a blocking call to the blobs' backend outside the async threads.
    pub async fn ask_blobs<T: Send + 'static>(&self, call: impl FnOnce() -> T + Send + 'static) -> T {
        self.0.calls.run(call).await
    }

    /// Size in bytes of the database and its log in the folder; 0 if the database is in PostgreSQL.
    pub fn database_bytes(&self) -> u64 {
        folder::database_bytes(self.dir()) + folder::log_bytes(self.dir())
    }

    pub(crate) fn calls(&self) -> &Calls {
        &self.0.calls
    }

    /// Returns the time at which this process opened the store, in milliseconds since 1970.
    pub(crate) fn opened_ms(&self) -> i64 {
        self.0.opened_ms
    }

    /// Checks that the database and the blobs were not exchanged since opening, and describes the problem if they were
    /// removed, emptied or replaced.
    pub(crate) async fn check_identity(&self) -> Result<(), String> {
        let database = match &self.0.address {
            Some(address) => sql::postgres::name(address),
            None if folder::has_database(self.dir()) => folder::database(self.dir()),
            None => {
                return Err(format!("the database `{}` is missing or empty", folder::database(self.dir()).display()));
            }
        };
        identity::check(self.id(), &database, self.blobs().place(), &**self).await
    }
}

impl Store {
    /// Opens the store in `dir`, or creates it. `holder` describes this process to others.
    pub async fn open(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        Self::open_with(dir, None, holder).await
    }

    /// Opens or creates a store with its blobs at `blobs`. An existing store must have them there already.
    pub async fn open_with(dir: &Path, blobs: Option<&Place>, holder: Holder) -> Result<Self, OpenError> {
        if !folder::has_database(dir)
            && remembered_catalog(dir)?.is_none()
            && Inspection::of(dir, &RequestedPlace::Remembered, false).await?.found.evidence().is_none()
        {
            refuse_other_files(dir)?;
        }
        make_folder(dir)?;
        Self::take(dir, RequestedPlace::named(blobs), holder, Purpose::Work).await
    }

    /// Opens or creates the store in `dir` over a given backend. For tests.
    pub async fn open_over(
        dir: &Path,
        blobs: Arc<dyn Backend>,
        holder: Holder,
        terms: LeaseTerms,
    ) -> Result<Self, OpenError> {
        make_folder(dir)?;
        let asked = Asked { place: RequestedPlace::Given(blobs), terms, ..Asked::to(Purpose::Work) };
        Self::take_by(dir, asked, holder).await
    }

    /// Opens or creates a store whose catalog is in PostgreSQL, and leads it. `dir` is this process's own folder.
    pub async fn open_on(
        catalog: &PostgresCatalog,
        dir: &Path,
        blobs: Option<&Place>,
        holder: Holder,
    ) -> Result<Self, OpenError> {
        make_folder(dir)?;
        let asked =
            Asked { place: RequestedPlace::named(blobs), catalog: Some(catalog.clone()), ..Asked::to(Purpose::Work) };
        Self::take_by(dir, asked, holder).await
    }

    /// Opens or creates a store whose catalog is in PostgreSQL over a given backend. For tests.
    pub async fn open_on_over(
        catalog: &PostgresCatalog,
        dir: &Path,
        blobs: Arc<dyn Backend>,
        holder: Holder,
    ) -> Result<Self, OpenError> {
        make_folder(dir)?;
        let asked =
            Asked { place: RequestedPlace::Given(blobs), catalog: Some(catalog.clone()), ..Asked::to(Purpose::Work) };
        Self::take_by(dir, asked, holder).await
    }

    /// Returns once no other process leads the catalog.
    pub async fn wait_to_lead(catalog: &PostgresCatalog) {
        sql::postgres::wait_to_lead(&catalog.address).await;
    }

    /// Returns this process's leadership, if the catalog is in PostgreSQL.
    pub fn leadership(&self) -> Option<&Leadership> {
        self.0.leading.as_ref().map(|leading| &leading.leadership)
    }

    /// Opens an existing store.
    pub async fn open_existing(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        there(dir).await?;
        Self::take(dir, RequestedPlace::Remembered, holder, Purpose::Work).await
    }

    /// Opens a store whose blobs are missing or were moved to `blobs`, or whose database lost transactions, and repairs
    /// its identity. Lost rows are not restored: the next collection removes blobs that only they named.
    pub async fn adopt(dir: &Path, blobs: Option<&Place>, holder: Holder) -> Result<Self, OpenError> {
        there(dir).await?;
        Self::take(dir, RequestedPlace::named(blobs), holder, Purpose::Adopt).await
    }

    /// Opens an existing store for a collection, even on a full disk.
    pub async fn open_to_collect(dir: &Path, holder: Holder) -> Result<Self, OpenError> {
        there(dir).await?;
        Self::take(dir, RequestedPlace::Remembered, holder, Purpose::Collect).await
    }

    async fn take(dir: &Path, place: RequestedPlace, holder: Holder, purpose: Purpose) -> Result<Self, OpenError> {
        Self::take_by(dir, Asked { place, ..Asked::to(purpose) }, holder).await
    }

    async fn take_by(dir: &Path, asked: Asked, holder: Holder) -> Result<Self, OpenError> {
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
        if asked.purpose == Purpose::Collect {
            reserve::release_if_full(&dir);
        } else if free < OPEN_NEEDS_BYTES {
            let message = format!("{free} bytes are free, {OPEN_NEEDS_BYTES} are needed");
            return Err(OpenError::Full { path: dir, message });
        }
        let catalog = choose_catalog(&dir, asked.catalog.clone())?;
        // Read under the lock, so that no other process is creating the store.
        let adopt = asked.purpose == Purpose::Adopt;
        let mut inspection = Inspection::of(&dir, &asked.place, adopt).await?;
        // The leader of a catalog needs no lease on the blobs: the marker has its epoch.
        let is_leased = catalog.is_none() && inspection.location.is_shared(&dir);
        if is_leased && inspection.found.marker().is_some_and(|marker| marker.held.is_some()) {
            wait_until_free(&dir, &inspection, asked.terms).await?;
            inspection = Inspection::of(&dir, &asked.place, adopt).await?;
        }
        let is_new = !folder::has_database(&dir) && inspection.found.evidence().is_none();
        if inspection.to_remember && (is_new || catalog.is_some()) && !adopt {
            // Written before the database exists; an existing database has a known place of blobs.
            inspection.place.remember(&dir).map_err(|e| io(&dir, e))?;
        }
        let begun = Instant::now();
        let Database { opened: Opened { mut link, store: id, verdict }, led } =
            Database::open(&dir, &mut inspection, catalog.as_ref(), adopt, &lock.holder()).await?;
        if inspection.to_remember && adopt {
            inspection.place.remember(&dir).map_err(|e| io(&dir, e))?;
        }
        let (location, opening) = (inspection.location, dir.clone());
        let opened = tokio::task::spawn_blocking(move || location.open()).await;
        let blobs = opened.map_err(|e| io(&opening, io::Error::other(e)))?.map_err(|e| io(&opening, e))?;
        let mut marker = inspection.found.marker().cloned();
        if let Verdict::New | Verdict::Unfinished(_) = verdict {
            marker = Some(mark(&dir, &blobs, marker, &Stored { id: id.clone(), epoch: 0, commits: 0 }, None).await?);
        }
        let stored = match (&mut link, &catalog, &led) {
            (Link::Sqlite(conn), _, _) => sql::sqlite::raise_epoch(&dir, conn).await?,
            (link, Some(catalog), Some((epoch, _))) => {
                sql::postgres::raise_epoch(&catalog.address, link, *epoch).await?
            }
            (Link::Postgres(_), _, _) => return Err(OpenError::NotAStore(dir)),
        };
        let held = is_leased.then(|| lease::held(&dir, &lock.holder())).transpose().map_err(|e| io(&dir, e))?;
        let leased_at = Instant::now();
        let marker = mark(&dir, &blobs, marker, &stored, held).await?;
        let lease = is_leased.then(|| Lease::begin(blobs.place(), marker, leased_at, asked.terms));
        let lease = lease.transpose().map_err(|e| io(&dir, e))?;
        if let Some(lease) = &lease {
            let check = lease.checked();
            blobs.permit_removals_by(move || check.may_remove());
        }
        let leading = led.zip(catalog.as_ref()).map(|((_, server_key), catalog)| {
            let leadership = Leadership::begin(stored.epoch, catalog.terms, begun);
            let check = leadership.clone();
            blobs.permit_removals_by(move || check.may_remove());
            Leading { leadership, server_key }
        });
        let witness = Witness::begin(&dir, &stored).map_err(|e| io(&dir, e))?;
        reserve::keep(&dir);
        remove_files_of_earlier_builds(&dir).map_err(|e| io(&dir, e))?;
        // By the writer's connection: a reader's would close the database later than the store.
        for (task, held) in sql::held(&mut link).await.map_err(|e| io(&dir, io::Error::other(e)))? {
            held.into_iter().for_each(|digest| blobs.hold(&task, digest));
        }
        let session = Session {
            link,
            epoch: stored.epoch,
            commits: stored.commits,
            witness,
            leading: leading
                .as_ref()
                .map(|leading| leading.leadership.clone())
                .zip(catalog.as_ref().map(|c| c.address.clone())),
        };
        let proofs = Arc::new(Proofs::new(lease.as_ref().map(Lease::checked)));
        let writer = Writer::start(session, Arc::clone(&proofs), Arc::clone(&lock)).map_err(|e| io(&dir, e))?;
        let readers = match &catalog {
            None => sql::sqlite::open_readers(&dir, false),
            Some(catalog) => sql::postgres::open_readers(&catalog.address)?,
        };
        let records = Arc::new(SqlRecords::new(readers));
        let catalog_ = Box::new(SqlCatalog { writer, records: Arc::clone(&records) });
        let opened_ms = clock::now_ms();
        let address = catalog.map(|catalog| catalog.address);
        let calls = Calls::default();
        let read = ReadStore(Arc::new(Reading { dir, id, opened_ms, blobs, calls, records, address, _closed: None }));
        Ok(Self(Arc::new(Inner { read, catalog: catalog_, _lease: lease, lock, proofs, leading })))
    }

    /// Returns the catalog: all data except the blobs.
    pub fn catalog(&self) -> &dyn Catalog {
        &*self.0.catalog
    }

    /// Returns the key of this store's server, which the first call creates. Reads the disk each time.
    pub fn server_key(&self) -> io::Result<ServerKey> {
        match &self.0.leading {
            Some(leading) => Ok(leading.server_key),
            None => server_key::read_or_make(self.dir()),
        }
    }

    /// Publishes the address of this process's server for other processes.
    pub fn set_address(&self, address: impl Into<String>) -> io::Result<()> {
        let address = address.into();
        if let Some(leadership) = self.leadership() {
            leadership.set_address(&address);
        }
        self.0.lock.set_address(address)
    }

    /// Returns the description of this process for others.
    pub fn holder(&self) -> Holder {
        self.0.lock.holder()
    }

    /// Moves an alias to a version: compares it with `expect` if given, checks the gates, moves, logs.
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

    /// Moves an alias back to `to`, or to the version before its last promotion. This adds a log entry.
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

    /// Deletes a task's checkpoints that `keep` does not select, under way or `at_end`, and returns the deleted manifests.
    /// The next [`Self::gc`] removes their blobs.
    pub async fn prune_checkpoints(&self, task: &TaskId, keep: Keep, at_end: bool) -> Result<Vec<Digest>, WriteError> {
        match self.order(Order::PruneCheckpoints { task: task.clone(), keep, at_end }).await? {
            Done::Pruned(manifests) => Ok(manifests),
            done => Err(unexpected(&done)),
        }
    }

    /// Keeps an artifact even if no row names it.
    pub async fn pin(&self, digest: Digest, reason: &str) -> Result<(), WriteError> {
        self.order_proven(&[digest], || Order::Pin { digest, reason: Some(reason.to_owned()) }).await.map(|_| ())
    }

    /// Removes a pin.
    pub async fn unpin(&self, digest: Digest) -> Result<(), WriteError> {
        self.order(Order::Pin { digest, reason: None }).await.map(|_| ())
    }

    /// Keeps a blob that a held task is about to store until [`Self::let_go`], also after a restart.
    pub async fn hold(&self, task: &TaskId, digest: Digest) -> Result<(), WriteError> {
        if !self.blobs().has_stored(task, digest) {
            self.order(Order::Hold { task: task.clone(), digest }).await?;
            self.blobs().hold(task, digest);
        }
        Ok(())
    }

    /// Keeps the blobs of tasks that are not held no longer. Deletes uploads without a request for `idle`, usually
    /// [`crate::blob::IDLE`].
    pub async fn let_go(&self, idle: Duration, is_held: impl Fn(&TaskId) -> bool + Send) -> Result<(), WriteError> {
        let over = self.blobs().let_go(idle, is_held);
        if over.is_empty() {
            return Ok(());
        }
        // If this fails, the next process reads the rows and deletes them.
        self.order(Order::LetGo(over)).await.map(|_| ())
    }

    /// Deletes an ended run. The next [`Self::gc`] removes its blobs.
    pub async fn forget(&self, run: &RunId) -> Result<Forgotten, WriteError> {
        match self.order(Order::Forget(run.clone())).await? {
            Done::Forgotten(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Deletes unreferenced data of a run that ended before a time: sweep trials other than the best, and checkpoints
    /// and shards of stages without a value. The run stays. The next [`Self::gc`] removes the blobs.
    pub async fn forget_leftovers(&self, run: &RunId, before_ms: i64) -> Result<Forgotten, WriteError> {
        match self.order(Order::ForgetLeftovers { run: run.clone(), before_ms }).await? {
            Done::Forgotten(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Records that a hook has received the history up to this row.
    pub async fn record_delivery(&self, hook: &str, id: i64) -> Result<(), WriteError> {
        self.order(Order::Delivered { hook: hook.to_owned(), id }).await.map(drop)
    }

    /// Removes history from before a time, in milliseconds since 1970; returns the number of rows that went.
    pub async fn prune_history(&self, before_ms: i64) -> Result<u64, WriteError> {
        match self.order(Order::PruneHistory { before_ms }).await? {
            Done::PrunedHistory(gone) => Ok(gone),
            done => Err(unexpected(&done)),
        }
    }

    /// Returns the proofs, which also record names during a collection.
    pub(crate) fn proofs(&self) -> &Arc<Proofs> {
        &self.0.proofs
    }

    /// Starts a collection and deletes its rows. Returns the tasks whose shards were deleted.
    pub(crate) async fn begin_collection(&self) -> Result<Vec<TaskId>, WriteError> {
        match self.order(Order::BeginCollection).await? {
            Done::Begun(forgotten) => Ok(forgotten),
            done => Err(unexpected(&done)),
        }
    }

    /// Deletes the records of blobs that no row has named since the collection began, and returns these blobs.
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

/// Restricts the folder to its user; without access to it, its files are out of reach. A folder of another user, or one
/// opened to a group by hand, is unchanged.
fn close_to_others(dir: &Path) -> io::Result<()> {
    let metadata = fs::metadata(dir)?;
    let mode = metadata.permissions().mode();
    if mode & 0o007 != 0 && metadata.uid() == nix::unistd::geteuid().as_raw() {
        fs::set_permissions(dir, fs::Permissions::from_mode(mode & !0o077))?;
    }
    Ok(())
}

/// Removes the lists of blobs that earlier builds kept beside the database. Rows and memory replace them.
fn remove_files_of_earlier_builds(dir: &Path) -> io::Result<()> {
    for name in ["blobs/held", "blobs/touched"] {
        match fs::remove_file(dir.join(name)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    Ok(())
}

fn make_folder(dir: &Path) -> Result<(), OpenError> {
    DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|e| OpenError::io(dir, &e))
}

/// Name of the file with the address of the database.
const CATALOG: &str = "CATALOG";

/// Returns the address of the database that the folder records; `None` if the database is in the folder.
fn remembered_catalog(dir: &Path) -> Result<Option<PostgresAddress>, OpenError> {
    let path = dir.join(CATALOG);
    let text = match fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => return Ok(None),
        Err(e) => return Err(OpenError::io(&path, &e)),
    };
    text.trim().parse().map(Some).map_err(|message| OpenError::Other { path, message })
}

/// Returns the catalog in PostgreSQL that the caller asked for or that the folder records, and records it.
fn choose_catalog(dir: &Path, asked: Option<PostgresCatalog>) -> Result<Option<PostgresCatalog>, OpenError> {
    let remembered = remembered_catalog(dir)?;
    let Some(asked) = asked else { return Ok(remembered.map(PostgresCatalog::from)) };
    let path = dir.join(CATALOG);
    if folder::has_database(dir) {
        let message = format!("its database is `{}`; `registry migrate` moves it", folder::DATABASE);
        return Err(OpenError::Other { path: dir.to_owned(), message });
    }
    if let Some(other) = remembered.as_ref().filter(|other| !other.is_same_database(&asked.address)) {
        let message = format!("its catalog is {other}, not {}; choose another folder with `--store`", asked.address);
        return Err(OpenError::Other { path, message });
    }
    remember_catalog(dir, &asked.address)?;
    Ok(Some(asked))
}

/// Records the address of the database.
pub(crate) fn remember_catalog(dir: &Path, address: &PostgresAddress) -> Result<(), OpenError> {
    let path = dir.join(CATALOG);
    let text = format!("{}\n", address.to_remember());
    write_whole(&path, text.as_bytes()).map_err(|e| OpenError::io(&path, &e))
}

/// Removes the record; the database is in the folder from then on.
pub(crate) fn forget_catalog(dir: &Path) -> Result<(), OpenError> {
    let path = dir.join(CATALOG);
    match fs::remove_file(&path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => Err(OpenError::io(&path, &e)),
        _ => Ok(()),
    }
}

/// An open database; for the leader of a catalog, also its first epoch and the key of its server.
struct Database {
    opened: Opened,
    led: Option<(u64, ServerKey)>,
}

impl Database {
    async fn open(
        dir: &Path,
        inspection: &mut Inspection,
        catalog: Option<&PostgresCatalog>,
        adopt: bool,
        holder: &Holder,
    ) -> Result<Self, OpenError> {
        let Some(PostgresCatalog { address, terms }) = catalog else {
            let opened = sql::sqlite::open_writer(dir, &inspection.found, adopt).await?;
            return Ok(Self { opened, led: None });
        };
        inspection.found.name_database(sql::postgres::name(address));
        let opening = sql::postgres::Opening { address, dir, found: &inspection.found, adopt, terms: *terms, holder };
        let led = sql::postgres::open_writer(&opening).await?;
        Ok(Self { opened: led.opened, led: Some((led.epoch, led.server_key)) })
    }
}

/// A request to open a store.
struct Asked {
    place: RequestedPlace,
    purpose: Purpose,
    terms: LeaseTerms,
    /// The catalog in PostgreSQL, if the caller names one.
    catalog: Option<PostgresCatalog>,
}

impl Asked {
    fn to(purpose: Purpose) -> Self {
        Self { place: RequestedPlace::Remembered, purpose, terms: LeaseTerms::default(), catalog: None }
    }
}

/// Purpose of opening a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Purpose {
    Work,
    Collect,
    Adopt,
}

/// The requested place of the blobs.
#[derive(Debug, Clone)]
enum RequestedPlace {
    /// The place recorded in the folder.
    Remembered,
    /// A place named by the caller.
    Named(Place),
    /// A backend of the caller.
    Given(Arc<dyn Backend>),
}

impl RequestedPlace {
    fn named(place: Option<&Place>) -> Self {
        place.map_or(Self::Remembered, |place| Self::Named(place.clone()))
    }
}

/// The parts of a store other than its database.
struct Inspection {
    place: Place,
    /// True if the folder does not record the place yet.
    to_remember: bool,
    location: Location,
    blobs: Arc<dyn Backend>,
    found: StoreParts,
}

impl Inspection {
    /// Reads the parts and changes nothing. A place other than the recorded one is an error, unless the blobs were
    /// `moved` there or the store does not exist yet.
    async fn of(dir: &Path, asked: &RequestedPlace, moved: bool) -> Result<Self, OpenError> {
        let (dir, asked) = (dir.to_owned(), asked.clone());
        let path = dir.clone();
        let looking = tokio::task::spawn_blocking(move || Self::inspect(&dir, asked, moved));
        looking.await.map_err(|e| OpenError::io(&path, &io::Error::other(e)))?
    }

    fn inspect(dir: &Path, asked: RequestedPlace, moved: bool) -> Result<Self, OpenError> {
        let io = |e: io::Error| OpenError::io(&dir.join("blobs/PLACE"), &e);
        let here = Place::Folder(std::path::absolute(dir).map_err(io)?);
        let remembered = Place::remembered(dir).map_err(io)?;
        let is_new = remembered.is_none() && !folder::has_database(dir);
        let current = remembered.unwrap_or(here);
        let (asked, given) = match asked {
            RequestedPlace::Remembered => (current.clone(), None),
            RequestedPlace::Named(place) => (place, None),
            RequestedPlace::Given(blobs) => (current.clone(), Some(blobs)),
        };
        let to_remember = asked != current;
        if to_remember && !moved && !is_new {
            return Err(OpenError::Elsewhere { dir: dir.to_owned(), place: current, asked });
        }
        let place = asked;
        let blobs_error = |e: BlobError| OpenError::Blobs { dir: dir.to_owned(), message: e.to_string() };
        let location = match given {
            Some(blobs) => Location::Given(blobs, dir.to_owned()),
            None => place.locate(dir).map_err(blobs_error)?,
        };
        let blobs = location.to_read().map_err(io)?;
        let found = StoreParts::read(dir, &*blobs).map_err(|e| match e {
            MarkerError::Blob(e) => blobs_error(e),
            MarkerError::Mismatch(mismatch) => OpenError::Mismatch { dir: dir.to_owned(), mismatch },
        })?;
        if to_remember && moved && found.marker().is_none() {
            let marker = blobs.marker_place();
            let message = format!("`{marker}` does not exist; copy the store's blobs and this marker there first");
            return Err(OpenError::Blobs { dir: dir.to_owned(), message });
        }
        Ok(Self { place, to_remember, location, blobs, found })
    }
}

/// Refuses a folder that is not, and never was, a store.
async fn there(dir: &Path) -> Result<(), OpenError> {
    if folder::has_database(dir) || remembered_catalog(dir)?.is_some() {
        return Ok(());
    }
    match Inspection::of(dir, &RequestedPlace::Remembered, false).await?.found.evidence() {
        Some(_) => Ok(()),
        None => Err(OpenError::NotAStore(dir.to_owned())),
    }
}

/// Waits until no other process holds the blobs of a store that is about to be opened.
async fn wait_until_free(dir: &Path, inspection: &Inspection, terms: LeaseTerms) -> Result<(), OpenError> {
    let own = lease::lock_of(dir).map_err(|e| OpenError::io(dir, &e))?;
    let (place, marker) = (Arc::clone(&inspection.blobs), inspection.blobs.marker_place());
    let waiting = tokio::task::spawn_blocking(move || lease::wait_until_free(&*place, &own, terms));
    let failed = |message: String| OpenError::Blobs { dir: dir.to_owned(), message };
    let waited = waiting.await.map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))?;
    waited.map_err(|by| OpenError::Held { dir: dir.to_owned(), by, marker })
}

/// Replaces the `old` marker beside the blobs by one of the opened store.
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
        "another process has just taken these blobs for its store: `{place}` has changed; each store needs its own place"
    )))
}

/// Names that a store's folder may have before its database exists.
const OF_A_STORE: [&str; 8] =
    ["lock", CATALOG, "blobs", "staging", "witness", "witness.new", "reserve", server_key::FILE];

/// Refuses to create a store in a folder with other files.
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
        // SQLite puts a log beside the database, and a journal while it is created.
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
