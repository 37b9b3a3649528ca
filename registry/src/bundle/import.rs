//! Imports a bundle as a version of a store.
//!
//! The file is read twice: first to verify it, so that nothing of a damaged bundle is stored, then to store its blobs,
//! verified again. The version is registered last, in one transaction. A crash before that leaves blobs that no row
//! names, which the next collection removes.

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

/// Reason why a bundle was not imported. Nothing was registered.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("{0}")]
    File(#[from] std::io::Error),
    /// The bundle is invalid.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The store refused a write.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A query of the store failed.
    #[error(transparent)]
    Query(#[from] QueryError),
}

/// Stores the files of a bundle and protects them from collection until a row names the version.
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
            None => Err(BlobError::Refused("no file was started".into())),
        }
    }

    fn end(&mut self, digest: Digest) -> Result<(), BlobError> {
        match self.upload.take() {
            Some(upload) => self.blobs.commit(upload, digest),
            None => Err(BlobError::Refused("no file was started".into())),
        }
    }
}

impl Store {
    /// Registers the version in a bundle's file, under `model` or its original name. It becomes the model's next
    /// version; an artifact that the model already has gets no new version.
    pub async fn import_bundle(&self, file: &Path, model: Option<ModelName>) -> Result<Version, ImportError> {
        // The store's own user; a model without an owner belongs to the store.
        let owner = Owner { admin: true, ..Owner::default() };
        self.import_bundle_of(file, model, owner).await
    }

    /// Imports a bundle for the owner of a token.
    pub async fn import_bundle_of(
        &self,
        file: &Path,
        model: Option<ModelName>,
        owner: Owner,
    ) -> Result<Version, ImportError> {
        let file = file.to_owned();
        let (Bundle { head, .. }, _protected) = self.ask_blobs(move |blobs| store(blobs, &file)).await?;
        let name = model.unwrap_or_else(|| head.model.clone());
        let mut source = json!({
            "imported": {"model": head.model, "version": head.version, "source": head.source},
        });
        // A file from elsewhere must not change which metric ranks an existing model.
        if !self.has_model(&name).await?
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

/// Describes the origin of an imported version; `None` for others.
pub(crate) fn origin(source: &Value) -> Option<String> {
    let imported = source.get("imported")?;
    Some(format!("imported, {}:{} there", imported["model"].as_str()?, imported["version"]))
}
