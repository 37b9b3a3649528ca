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

mod opening;
mod parts;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use protocol::stage::Keep;
use protocol::{Alias, Digest, Group, ModelName, RunId, TaskId};

use self::opening::{Asked, HeldStore, Leading, Purpose};
pub use self::parts::PostgresCatalog;
use self::parts::{Inspection, RequestedPlace, make_folder, refuse_other_files, there};
pub(crate) use self::parts::{forget_catalog, remember_catalog, remembered_catalog};
use crate::blob::place::Place;
use crate::blob::{Backend, BlobStore};
use crate::calls::Calls;
use crate::catalog::{Catalog, Done, Order, PostgresAddress, PromoteOrder, Records, RollbackOrder, Which};
use crate::forget::Forgotten;
use crate::identity;
use crate::lease::{Lease, LeaseTerms};
use crate::lock::{self, Holder, SharedLock, StoreLock, network_filesystem};
use crate::open_error::OpenError;
use crate::proofs::Proofs;
use crate::scoped::ScopedRecords;
use crate::server_key::{self, ServerKey};
use crate::sql::{self, Leadership, SqlRecords};
use crate::store_id::StoreId;
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
        let held = opening::open(dir, asked, holder).await?;
        let HeldStore { dir, id, blobs, catalog, records, address, lease, lock, proofs, leading } = held;
        let opened_ms = clock::now_ms();
        let calls = Calls::default();
        let read = ReadStore(Arc::new(Reading { dir, id, opened_ms, blobs, calls, records, address, _closed: None }));
        Ok(Self(Arc::new(Inner { read, catalog, _lease: lease, lock, proofs, leading })))
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
        let model = model.clone();
        let alias = alias.clone();
        let reason = reason.to_owned();
        let actor = actor.to_owned();
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

fn promoted(done: Done) -> Result<Promotion, WriteError> {
    match done {
        Done::Promoted(promotion) => Ok(*promotion),
        done => Err(unexpected(&done)),
    }
}

fn unexpected(done: &Done) -> WriteError {
    WriteError::Internal(format!("the writer answered {done:?} to another order"))
}
