//! Manifests as they lie in a store: read, complete, whole.

use checkpoint::BlobError;
use protocol::{Digest, FileEntry, Manifest};

use super::BlobStore;

/// The largest manifest that is read; ours are at most a few megabytes.
pub const MANIFEST_BYTES: u64 = 64 << 20;

/// Why an artifact cannot be taken for whole.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The manifest itself, or a blob of it, could not be read.
    #[error(transparent)]
    Blob(BlobError),
    /// Another blob than a manifest.
    #[error("blob {digest} is not a manifest: {cause}")]
    NotAManifest {
        /// The blob.
        digest: Digest,
        /// What the reader said.
        cause: String,
    },
    /// Written by a newer build.
    #[error("manifest {digest} has format {found}, this build reads {expected}; use a newer build", expected = Manifest::FORMAT)]
    Format {
        /// The manifest.
        digest: Digest,
        /// Its version.
        found: u32,
    },
    /// A file is missing or cut.
    #[error("manifest {digest} lists `{file}` as blob {blob} of {expected} bytes, which is {found}")]
    Incomplete {
        /// The manifest.
        digest: Digest,
        /// The file's name in it.
        file: String,
        blob: Digest,
        /// Bytes by the manifest.
        expected: u64,
        /// What is there.
        found: String,
    },
}

impl ManifestError {
    /// The blob that is missing or not what it should be, if that is what is wrong.
    pub(crate) fn blob(&self) -> Option<Digest> {
        match self {
            Self::Blob(BlobError::NotFound(digest) | BlobError::Corrupt { expected: digest, .. }) => Some(*digest),
            Self::Incomplete { blob, .. } => Some(*blob),
            Self::Blob(_) | Self::NotAManifest { .. } | Self::Format { .. } => None,
        }
    }
}

/// Refuses a file that a manifest lists if it has another length than that, or none.
fn as_listed(digest: Digest, name: &str, file: &FileEntry, found: Option<u64>) -> Result<(), ManifestError> {
    if found == Some(file.bytes) {
        return Ok(());
    }
    Err(ManifestError::Incomplete {
        digest,
        file: name.to_owned(),
        blob: file.digest,
        expected: file.bytes,
        found: found.map_or_else(|| "not in the store".into(), |bytes| format!("{bytes} bytes long")),
    })
}

/// The manifest that `bytes`, called `digest`, are.
fn parse(digest: Digest, bytes: &[u8]) -> Result<Manifest, ManifestError> {
    let manifest: Manifest =
        serde_json::from_slice(bytes).map_err(|e| ManifestError::NotAManifest { digest, cause: e.to_string() })?;
    if manifest.format != Manifest::FORMAT {
        return Err(ManifestError::Format { digest, found: manifest.format });
    }
    Ok(manifest)
}

impl BlobStore {
    /// The manifest named `digest`, and its length. Asks for none that this process has just stored.
    pub(crate) fn stored_manifest(&self, digest: Digest) -> Result<(Manifest, u64), ManifestError> {
        if let Some(content) = self.seen().content(digest) {
            return Ok((parse(digest, &content)?, content.len() as u64));
        }
        let bytes = self.manifest_bytes(digest)?;
        Ok((parse(digest, &bytes)?, bytes.len() as u64))
    }

    /// The manifest named `digest`.
    pub fn manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        parse(digest, &self.manifest_bytes(digest)?)
    }

    fn manifest_bytes(&self, digest: Digest) -> Result<Vec<u8>, ManifestError> {
        let stat = self.must_stat(digest).map_err(ManifestError::Blob)?;
        if stat.bytes > MANIFEST_BYTES {
            let cause = format!("it has {} bytes, and a manifest at most {MANIFEST_BYTES}", stat.bytes);
            return Err(ManifestError::NotAManifest { digest, cause });
        }
        self.get(digest).map_err(ManifestError::Blob)
    }

    /// The manifest named `digest`, once every blob that it lists is known to be there with the right length.
    pub fn complete_manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let manifest = self.manifest(digest)?;
        for (name, file) in &manifest.files {
            let found = self.size(file.digest).map_err(ManifestError::Blob)?;
            as_listed(digest, name, file, found)?;
        }
        Ok(manifest)
    }

    /// Makes sure that a file which the manifest `digest` lists is there with the right length.
    pub(crate) fn check_listed(&self, digest: Digest, name: &str, file: &FileEntry) -> Result<(), ManifestError> {
        as_listed(digest, name, file, self.size(file.digest).map_err(ManifestError::Blob)?)
    }

    /// The manifest named `digest`, once every blob that it lists is known to be whole. Takes as long as hashing what was
    /// not hashed since it was last written to.
    pub fn whole_manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let manifest = self.complete_manifest(digest)?;
        for file in manifest.files.values() {
            self.verify(file.digest).map_err(ManifestError::Blob)?;
        }
        Ok(manifest)
    }

    /// What is wrong with an artifact, if anything is: a part of it is missing or damaged. An error says nothing about it.
    pub fn flaw(&self, artifact: Digest) -> Result<Option<ManifestError>, BlobError> {
        match self.whole_manifest(artifact) {
            Ok(_) => Ok(None),
            Err(ManifestError::Blob(
                e @ (BlobError::Unreachable(_)
                | BlobError::Unavailable(_)
                | BlobError::Storage(_)
                | BlobError::Refused(_)),
            )) => Err(e),
            Err(flaw) => Ok(Some(flaw)),
        }
    }
}
