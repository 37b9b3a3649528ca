//! A bundle becomes a version of a store.
//!
//! The file is read twice: once only to verify it, so that of a bundle that is not whole nothing is stored at all, and once to store its
//! blobs, verified again on the way. The version is registered last, in one transaction; what a crash leaves before that are blobs that no
//! row names, which the next collection takes.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use checkpoint::BlobError;
use protocol::{Digest, ModelName, Owner};
use serde_json::{Value, json};

use super::{Bundle, BundleError, Sink, read};
use crate::blob::{BlobStore, Protected, Upload};
use crate::versions::Version;
use crate::{QueryError, Store, Write, WriteError};

/// Why a bundle was not imported. Nothing was registered.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("{0}")]
    File(#[from] std::io::Error),
    /// The bundle.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The store.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// Likewise.
    #[error(transparent)]
    Query(#[from] QueryError),
}

/// Where files of a bundle are stored, and kept from collection until the version names them.
struct IntoStore<'a> {
    blobs: &'a BlobStore,
    upload: Option<Upload>,
    protected: Vec<Protected>,
}

impl Sink for IntoStore<'_> {
    fn begin(&mut self, digest: Digest, bytes: u64) -> Result<(), BlobError> {
        self.protected.push(self.blobs.protect(digest));
        self.upload = Some(self.blobs.begin(bytes)?);
        Ok(())
    }

    fn write(&mut self, piece: &[u8]) -> Result<(), BlobError> {
        match &mut self.upload {
            Some(upload) => upload.write(piece),
            None => Err(BlobError::Refused("no file was begun".into())),
        }
    }

    fn end(&mut self, digest: Digest) -> Result<(), BlobError> {
        match self.upload.take() {
            Some(upload) => self.blobs.commit(upload, digest),
            None => Err(BlobError::Refused("no file was begun".into())),
        }
    }
}

impl Store {
    /// Registers the version in a bundle's file, as `model` or as what it was called where it was exported. Of a model that the store has it
    /// becomes the next version; an artifact that it has as this model already gets no new one.
    pub async fn import_bundle(&self, file: &Path, model: Option<ModelName>) -> Result<Version, ImportError> {
        // The store's own user; a model without an owner is the store's.
        let owner = Owner { admin: true, ..Owner::default() };
        self.import_bundle_of(file, model, owner).await
    }

    /// The same, for the owner of a token.
    pub async fn import_bundle_of(
        &self,
        file: &Path,
        model: Option<ModelName>,
        owner: Owner,
    ) -> Result<Version, ImportError> {
        let (blobs, file) = (self.blobs().clone(), file.to_owned());
        let (Bundle { head, .. }, _protected) = self.ask_blobs(move || store(&blobs, &file)).await?;
        let name = model.unwrap_or_else(|| head.model.clone());
        let mut source = json!({
            "imported": {"model": head.model, "version": head.version, "source": head.source},
        });
        // What decides which version of a model is best is not for a file from elsewhere to change.
        if self.model(&name).await?.is_none()
            && let (Some(metric), mode @ ("min" | "max")) =
                (head.source["metric"].as_str(), head.source["mode"].as_str().unwrap_or("min"))
        {
            source["metric"] = metric.into();
            source["mode"] = mode.into();
        }
        let metrics: BTreeMap<String, f64> =
            head.metrics.into_iter().map(|(metric, value)| (metric, value.unwrap_or(f64::NAN))).collect();
        let own = Write::ModelOwner { model: name.clone(), owner };
        let write = Write::Version { model: name.clone(), artifact: head.artifact, metrics, source };
        self.write(vec![own, write]).await?;
        let version = self.version_of(&name, head.artifact).await?;
        Ok(version.ok_or_else(|| QueryError::NotFound(format!("no version of `{name}` is {}", head.artifact)))?)
    }
}

fn store(blobs: &BlobStore, file: &Path) -> Result<(Bundle, Vec<Protected>), ImportError> {
    let open = || File::open(file).map(BufReader::new);
    let verified = read(open()?, &mut ())?;
    let mut sink = IntoStore { blobs, upload: None, protected: Vec::new() };
    let stored = read(open()?, &mut sink)?;
    if stored != verified {
        return Err(BundleError::Damaged("the file changed while it was read".into()).into());
    }
    Ok((stored, sink.protected))
}

/// Where an imported version came from, in words; nothing for others.
pub(crate) fn origin(source: &Value) -> Option<String> {
    let imported = source.get("imported")?;
    Some(format!("imported, {}:{} there", imported["model"].as_str()?, imported["version"]))
}
