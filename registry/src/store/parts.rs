//! The folder of a store before it is opened: its files, the record of its database, and the place of its blobs.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::Path;
use std::sync::Arc;

use checkpoint::BlobError;

use crate::blob::Backend;
use crate::blob::disk::write_whole;
use crate::blob::place::{Location, Place};
use crate::catalog::PostgresAddress;
use crate::identity::{MarkerError, StoreParts};
use crate::open_error::OpenError;
use crate::sql::LeaderTerms;
use crate::{folder, server_key};

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

pub(super) fn make_folder(dir: &Path) -> Result<(), OpenError> {
    DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|e| OpenError::io(dir, &e))
}

/// Restricts the folder to its user; without access to it, its files are out of reach. A folder of another user, or one
/// opened to a group by hand, is unchanged.
pub(super) fn close_to_others(dir: &Path) -> io::Result<()> {
    let metadata = fs::metadata(dir)?;
    let mode = metadata.permissions().mode();
    if mode & 0o007 != 0 && metadata.uid() == nix::unistd::geteuid().as_raw() {
        fs::set_permissions(dir, fs::Permissions::from_mode(mode & !0o077))?;
    }
    Ok(())
}

/// Removes the lists of blobs that earlier builds kept beside the database. Rows and memory replace them.
pub(super) fn remove_files_of_earlier_builds(dir: &Path) -> io::Result<()> {
    for name in ["blobs/held", "blobs/touched"] {
        match fs::remove_file(dir.join(name)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    Ok(())
}

/// Name of the file with the address of the database.
const CATALOG: &str = "CATALOG";

/// Returns the address of the database that the folder records; `None` if the database is in the folder.
pub(crate) fn remembered_catalog(dir: &Path) -> Result<Option<PostgresAddress>, OpenError> {
    let path = dir.join(CATALOG);
    let text = match fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => return Ok(None),
        Err(e) => return Err(OpenError::io(&path, &e)),
    };
    text.trim().parse().map(Some).map_err(|message| OpenError::Other { path, message })
}

/// Returns the catalog in PostgreSQL that the caller asked for or that the folder records, and records it.
pub(super) fn choose_catalog(dir: &Path, asked: Option<PostgresCatalog>) -> Result<Option<PostgresCatalog>, OpenError> {
    let remembered = remembered_catalog(dir)?;
    let Some(asked) = asked else { return Ok(remembered.map(PostgresCatalog::from)) };
    if folder::has_database(dir) {
        let message = format!("its database is `{}`; `registry migrate` moves it to PostgreSQL", folder::DATABASE);
        return Err(OpenError::Catalog { dir: dir.to_owned(), message });
    }
    if let Some(other) = remembered.as_ref().filter(|other| !other.is_same_database(&asked.address)) {
        let message = format!("its catalog is {other}, not {}; choose another folder with `--store`", asked.address);
        return Err(OpenError::Catalog { dir: dir.to_owned(), message });
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

/// The requested place of the blobs.
#[derive(Debug, Clone)]
pub(super) enum RequestedPlace {
    /// The place recorded in the folder.
    Remembered,
    /// A place named by the caller.
    Named(Place),
    /// A backend of the caller.
    Given(Arc<dyn Backend>),
}

impl RequestedPlace {
    pub(super) fn named(place: Option<&Place>) -> Self {
        place.map_or(Self::Remembered, |place| Self::Named(place.clone()))
    }
}

/// The parts of a store other than its database.
pub(super) struct Inspection {
    pub(super) place: Place,
    /// True if the folder does not record the place yet.
    pub(super) to_remember: bool,
    pub(super) location: Location,
    pub(super) blobs: Arc<dyn Backend>,
    pub(super) found: StoreParts,
}

impl Inspection {
    /// Reads the parts and changes nothing. A place other than the recorded one is an error, unless the blobs were
    /// `moved` there or the store does not exist yet.
    pub(super) async fn of(dir: &Path, asked: &RequestedPlace, moved: bool) -> Result<Self, OpenError> {
        let dir = dir.to_owned();
        let asked = asked.clone();
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
pub(super) async fn there(dir: &Path) -> Result<(), OpenError> {
    if folder::has_database(dir) || remembered_catalog(dir)?.is_some() {
        return Ok(());
    }
    match Inspection::of(dir, &RequestedPlace::Remembered, false).await?.found.evidence() {
        Some(_) => Ok(()),
        None => Err(OpenError::NotAStore(dir.to_owned())),
    }
}

/// Names that a store's folder may have before its database exists.
const OF_A_STORE: [&str; 8] =
    ["lock", CATALOG, "blobs", "staging", "witness", "witness.new", "reserve", server_key::FILE];

/// Refuses to create a store in a folder with other files.
pub(super) fn refuse_other_files(dir: &Path) -> Result<(), OpenError> {
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
