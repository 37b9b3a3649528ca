//! A store that this process holds, and the ways to take it.

use std::io;
use std::path::Path;
use std::sync::Arc;

use super::opening::{self, Asked, HeldStore, Leading, Purpose};
use super::parts::{
    Inspection, PostgresCatalog, RequestedPlace, make_folder, refuse_other_files, remembered_catalog, there,
};
use super::read::{ReadStore, Reading};
use crate::blob::Backend;
use crate::blob::place::Place;
use crate::calls::Calls;
use crate::catalog::Catalog;
use crate::lease::{Lease, LeaseTerms};
use crate::lock::{Holder, StoreLock};
use crate::open_error::OpenError;
use crate::proofs::Proofs;
use crate::server_key::{self, ServerKey};
use crate::sql::{self, Leadership};
use crate::{clock, folder};

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

    /// Returns the proofs, which also record names during a collection.
    pub(crate) fn proofs(&self) -> &Arc<Proofs> {
        &self.0.proofs
    }
}
