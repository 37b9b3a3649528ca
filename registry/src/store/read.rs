//! Read access to a store, for any number of processes.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::Group;

use super::parts::{Inspection, RequestedPlace, remembered_catalog, there};
use crate::blob::BlobStore;
use crate::calls::Calls;
use crate::catalog::{PostgresAddress, Records};
use crate::lock::{self, Holder, SharedLock, network_filesystem};
use crate::open_error::OpenError;
use crate::scoped::ScopedRecords;
use crate::sql::{self, SqlRecords};
use crate::store_id::StoreId;
use crate::{clock, folder, identity};

/// Read access to the committed data of a store. A [`Store`](super::Store) contains one. A read-only process opens its
/// own, even while another process holds the store; it starts and writes nothing. Clones share it.
#[derive(Debug, Clone)]
pub struct ReadStore(pub(super) Arc<Reading>);

#[derive(Debug)]
pub(super) struct Reading {
    pub(super) dir: PathBuf,
    pub(super) id: StoreId,
    pub(super) opened_ms: i64,
    pub(super) blobs: BlobStore,
    pub(super) calls: Calls,
    pub(super) records: Arc<dyn Records>,
    /// Address of the database, unless it is a file of the folder.
    pub(super) address: Option<PostgresAddress>,
    /// Blocks writers while a database without a log is read.
    pub(super) _closed: Option<Arc<SharedLock>>,
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
    pub async fn ask_blobs<T: Send + 'static>(&self, call: impl FnOnce(&BlobStore) -> T + Send + 'static) -> T {
        let blobs = self.blobs().clone();
        self.0.calls.run(move || call(&blobs)).await
    }

    /// Size in bytes of the database and its log in the folder; 0 if the database is in PostgreSQL.
    pub fn database_bytes(&self) -> u64 {
        folder::database_bytes(self.dir()) + folder::log_bytes(self.dir())
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
