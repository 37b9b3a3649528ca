//! Moves a store's catalog between SQLite, in the store's folder, and PostgreSQL. The blobs stay where they are.
//!
//! The process holds the store while it copies. The copy is one transaction, verified before it counts. Then the folder names the
//! other database, and opening it raises the epoch, so that the former one is refused from then on. After an interruption the folder
//! still names a whole database.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use crate::catalog::PostgresAddress;
use crate::lock::Holder;
pub use crate::move_error::MoveError;
use crate::open_error::OpenError;
use crate::store::{self, PostgresCatalog, Store};
use crate::{folder, sql};

/// Moves the catalog of the store in `dir` to an empty database of PostgreSQL. Returns the number of rows. The file stays beside, as
/// `stride.db.moved`.
pub async fn to_postgres(dir: &Path, to: &PostgresAddress, holder: Holder) -> Result<u64, MoveError> {
    if !folder::has_database(dir) {
        return Err(match store::remembered_catalog(dir)? {
            Some(at) => MoveError::Refused(format!("the catalog of `{}` is in {at} already", dir.display())),
            None => OpenError::NotAStore(dir.to_owned()).into(),
        });
    }
    let held = Store::open_existing(dir, holder.clone()).await?;
    let pool = sql::sqlite::open_readers(dir, false);
    let copied = sql::postgres::fill(to, &pool).await;
    pool.close().await;
    let rows = copied?;
    close(held).await;
    let from = folder::database(dir);
    let moved = dir.join(format!("{}.moved", folder::DATABASE));
    fs::rename(&from, &moved).map_err(|e| OpenError::io(&moved, &e))?;
    store::remember_catalog(dir, to)?;
    // Raises the epoch, also beside the blobs.
    close(Store::open_existing(dir, holder).await?).await;
    Ok(rows)
}

/// Moves a catalog out of PostgreSQL into the folder `dir` of one of its processes. Returns the number of rows.
pub async fn to_folder(from: &PostgresAddress, dir: &Path, holder: Holder) -> Result<u64, MoveError> {
    if folder::has_database(dir) {
        let (dir, file) = (dir.display(), folder::DATABASE);
        return Err(MoveError::Refused(format!(
            "`{dir}` has a catalog already, `{file}`; name a folder that uses {from}"
        )));
    }
    let held = Store::open_on(&PostgresCatalog::from(from.clone()), dir, None, holder.clone()).await?;
    let fresh = dir.join(format!("{}.new", folder::DATABASE));
    match fs::remove_file(&fresh) {
        Err(e) if e.kind() != ErrorKind::NotFound => return Err(OpenError::io(&fresh, &e).into()),
        _ => {}
    }
    let pool = sql::postgres::open_readers(from)?;
    let copied = sql::transfer::to_file(&pool, &fresh).await;
    pool.close().await;
    let rows = copied?;
    close(held).await;
    let path = folder::database(dir);
    fs::rename(&fresh, &path).map_err(|e| OpenError::io(&path, &e))?;
    store::forget_catalog(dir)?;
    close(Store::open_existing(dir, holder).await?).await;
    Ok(rows)
}

async fn close(store: Store) {
    (*store).clone().close().await;
    drop(store);
}
