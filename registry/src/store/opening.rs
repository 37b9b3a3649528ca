//! Opening a store for this process alone.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use super::parts::{
    Inspection, PostgresCatalog, RequestedPlace, choose_catalog, close_to_others, remove_files_of_earlier_builds,
};
use crate::blob::BlobStore;
use crate::blob::disk::free_bytes;
use crate::catalog::{Catalog, PostgresAddress, Records};
use crate::folder;
use crate::identity::{Held, Marker, Verdict, Witness};
use crate::lease::{self, Lease, LeaseTerms};
use crate::lock::{Holder, StoreLock, Taken, network_filesystem};
use crate::open_error::OpenError;
use crate::proofs::Proofs;
use crate::reserve::{self, OPEN_NEEDS_BYTES};
use crate::server_key::ServerKey;
use crate::sql::{self, Leadership, Link, Opened, Session, SqlCatalog, SqlRecords, Writer};
use crate::store_id::{StoreId, Stored};

/// A request to open a store.
pub(super) struct Asked {
    pub(super) place: RequestedPlace,
    pub(super) purpose: Purpose,
    pub(super) terms: LeaseTerms,
    /// The catalog in PostgreSQL, if the caller names one.
    pub(super) catalog: Option<PostgresCatalog>,
}

impl Asked {
    pub(super) fn to(purpose: Purpose) -> Self {
        Self { place: RequestedPlace::Remembered, purpose, terms: LeaseTerms::default(), catalog: None }
    }
}

/// Purpose of opening a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    Work,
    Collect,
    Adopt,
}

/// The state of a process that leads a catalog in PostgreSQL.
#[derive(Debug)]
pub(super) struct Leading {
    pub(super) leadership: Leadership,
    pub(super) server_key: ServerKey,
}

/// A store that this process holds.
pub(super) struct HeldStore {
    pub(super) dir: PathBuf,
    pub(super) id: StoreId,
    pub(super) blobs: BlobStore,
    pub(super) catalog: Box<dyn Catalog>,
    pub(super) records: Arc<dyn Records>,
    /// Address of the database, unless it is a file of the folder.
    pub(super) address: Option<PostgresAddress>,
    pub(super) lease: Option<Lease>,
    pub(super) lock: Arc<StoreLock>,
    pub(super) proofs: Arc<Proofs>,
    pub(super) leading: Option<Leading>,
}

/// Opens the store that `asked` describes, or creates it. This process holds it from then on.
pub(super) async fn open(dir: &Path, asked: Asked, holder: Holder) -> Result<HeldStore, OpenError> {
    let opening = Opening::lock(dir, asked, holder).await?;
    let mut inspection = opening.inspect().await?;
    let is_leased = opening.is_leased(&inspection);
    let begun = Instant::now();
    let mut database = opening.open_database(&mut inspection).await?;
    let marked = opening.mark_blobs(inspection, &mut database.opened, database.led.as_ref(), is_leased).await?;
    opening.start(database, marked, begun).await
}

/// A locked folder whose store is about to be opened.
struct Opening {
    dir: PathBuf,
    lock: Arc<StoreLock>,
    /// The catalog, if it is in PostgreSQL.
    catalog: Option<PostgresCatalog>,
    place: RequestedPlace,
    purpose: Purpose,
    terms: LeaseTerms,
}

/// Blobs that carry the marker of the store that is being opened.
struct MarkedBlobs {
    blobs: BlobStore,
    stored: Stored,
    lease: Option<Lease>,
}

impl Opening {
    async fn lock(dir: &Path, asked: Asked, holder: Holder) -> Result<Self, OpenError> {
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
        let Asked { place, purpose, terms, catalog } = asked;
        let free = free_bytes(&dir).map_err(|e| io(&dir, e))?;
        if purpose == Purpose::Collect {
            reserve::release_if_full(&dir);
        } else if free < OPEN_NEEDS_BYTES {
            let message = format!("{free} bytes are free, {OPEN_NEEDS_BYTES} are needed");
            return Err(OpenError::Full { path: dir, message });
        }
        let catalog = choose_catalog(&dir, catalog)?;
        Ok(Self { dir, lock, catalog, place, purpose, terms })
    }

    fn io(&self, error: &io::Error) -> OpenError {
        OpenError::io(&self.dir, error)
    }

    fn adopts(&self) -> bool {
        self.purpose == Purpose::Adopt
    }

    /// The leader of a catalog needs no lease on the blobs: the marker has its epoch.
    fn is_leased(&self, inspection: &Inspection) -> bool {
        self.catalog.is_none() && inspection.location.is_shared(&self.dir)
    }

    /// Reads the parts under the lock, so that no other process is creating the store.
    async fn inspect(&self) -> Result<Inspection, OpenError> {
        let mut inspection = Inspection::of(&self.dir, &self.place, self.adopts()).await?;
        if self.is_leased(&inspection) && inspection.found.marker().is_some_and(|marker| marker.held.is_some()) {
            wait_until_free(&self.dir, &inspection, self.terms).await?;
            inspection = Inspection::of(&self.dir, &self.place, self.adopts()).await?;
        }
        let is_new = !folder::has_database(&self.dir) && inspection.found.evidence().is_none();
        if inspection.to_remember && (is_new || self.catalog.is_some()) && !self.adopts() {
            // Written before the database exists; an existing database has a known place of blobs.
            inspection.place.remember(&self.dir).map_err(|e| self.io(&e))?;
        }
        Ok(inspection)
    }

    async fn open_database(&self, inspection: &mut Inspection) -> Result<Database, OpenError> {
        let holder = self.lock.holder();
        let database = Database::open(&self.dir, inspection, self.catalog.as_ref(), self.adopts(), &holder).await?;
        if inspection.to_remember && self.adopts() {
            inspection.place.remember(&self.dir).map_err(|e| self.io(&e))?;
        }
        Ok(database)
    }

    /// Raises the epoch of the store and writes it beside the blobs, so that an earlier holder collects nothing.
    async fn mark_blobs(
        &self,
        inspection: Inspection,
        opened: &mut Opened,
        led: Option<&(u64, ServerKey)>,
        is_leased: bool,
    ) -> Result<MarkedBlobs, OpenError> {
        let Inspection { location, found, .. } = inspection;
        let joined = tokio::task::spawn_blocking(move || location.open()).await;
        let blobs = joined.map_err(|e| self.io(&io::Error::other(e)))?.map_err(|e| self.io(&e))?;
        let mut marker = found.marker().cloned();
        if let Verdict::New | Verdict::Unfinished(_) = opened.verdict {
            let first = Stored { id: opened.store.clone(), epoch: 0, commits: 0 };
            marker = Some(mark(&self.dir, &blobs, marker, &first, None).await?);
        }
        let stored = match (&mut opened.link, &self.catalog, led) {
            (Link::Sqlite(conn), _, _) => sql::sqlite::raise_epoch(&self.dir, conn).await?,
            (link, Some(catalog), Some((epoch, _))) => {
                sql::postgres::raise_epoch(&catalog.address, link, *epoch).await?
            }
            (Link::Postgres(_), _, _) => return Err(OpenError::NotAStore(self.dir.clone())),
        };
        let held = is_leased.then(|| lease::held(&self.dir, &self.lock.holder()));
        let held = held.transpose().map_err(|e| self.io(&e))?;
        let leased_at = Instant::now();
        let marker = mark(&self.dir, &blobs, marker, &stored, held).await?;
        let lease = is_leased.then(|| Lease::begin(blobs.place(), marker, leased_at, self.terms));
        let lease = lease.transpose().map_err(|e| self.io(&e))?;
        if let Some(lease) = &lease {
            let check = lease.checked();
            blobs.permit_removals_by(move || check.may_remove());
        }
        Ok(MarkedBlobs { blobs, stored, lease })
    }

    /// Starts the writer and the readers. The leadership counts from `begun`, before the database was opened.
    async fn start(self, database: Database, marked: MarkedBlobs, begun: Instant) -> Result<HeldStore, OpenError> {
        let Database { opened: Opened { mut link, store: id, .. }, led } = database;
        let MarkedBlobs { blobs, stored, lease } = marked;
        let leading = led.zip(self.catalog.as_ref()).map(|((_, server_key), catalog)| {
            let leadership = Leadership::begin(stored.epoch, catalog.terms, begun);
            let check = leadership.clone();
            blobs.permit_removals_by(move || check.may_remove());
            Leading { leadership, server_key }
        });
        let witness = Witness::begin(&self.dir, &stored).map_err(|e| self.io(&e))?;
        reserve::keep(&self.dir);
        remove_files_of_earlier_builds(&self.dir).map_err(|e| self.io(&e))?;
        // By the writer's connection: a reader's would close the database later than the store.
        for (task, held) in sql::held(&mut link).await.map_err(|e| self.io(&io::Error::other(e)))? {
            held.into_iter().for_each(|digest| blobs.hold(&task, digest));
        }
        let address = self.catalog.as_ref().map(|catalog| catalog.address.clone());
        let leadership = leading.as_ref().map(|leading| leading.leadership.clone());
        let leading_at = leadership.zip(address.clone());
        let session = Session { link, epoch: stored.epoch, commits: stored.commits, witness, leading: leading_at };
        let proofs = Arc::new(Proofs::new(lease.as_ref().map(Lease::checked)));
        let writer = Writer::start(session, Arc::clone(&proofs), Arc::clone(&self.lock)).map_err(|e| self.io(&e))?;
        let readers = match &address {
            None => sql::sqlite::open_readers(&self.dir, false),
            Some(address) => sql::postgres::open_readers(address)?,
        };
        let records = Arc::new(SqlRecords::new(readers));
        let catalog = Box::new(SqlCatalog { writer, records: Arc::clone(&records) });
        let Self { dir, lock, .. } = self;
        Ok(HeldStore { dir, id, blobs, catalog, records, address, lease, lock, proofs, leading })
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

/// Waits until no other process holds the blobs of a store that is about to be opened.
async fn wait_until_free(dir: &Path, inspection: &Inspection, terms: LeaseTerms) -> Result<(), OpenError> {
    let own = lease::lock_of(dir).map_err(|e| OpenError::io(dir, &e))?;
    let place = Arc::clone(&inspection.blobs);
    let marker = inspection.blobs.marker_place();
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
    let place = blobs.place();
    let written = marker.clone();
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
