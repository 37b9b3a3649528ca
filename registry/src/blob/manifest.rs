//! Manifests in a store, with checks that their files are complete and whole.

use checkpoint::BlobError;
use protocol::artifact::Chunk;
use protocol::{Digest, Manifest};

use super::BlobStore;
use super::reader::Reader;

/// Size limit of a manifest that is read; ours have at most a few megabytes.
pub const MANIFEST_BYTES: u64 = 64 << 20;

/// Error of an artifact that is not whole.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The manifest or one of its blobs could not be read.
    #[error(transparent)]
    Blob(BlobError),
    /// The blob is not a manifest.
    #[error("blob {digest} is not a manifest: {cause}")]
    NotAManifest {
        digest: Digest,
        /// Error of the JSON reader.
        cause: String,
    },
    /// A newer build wrote the manifest.
    #[error("manifest {digest} has format {found}; this build reads {expected}; use a newer build", expected = Manifest::FORMAT)]
    Format {
        /// Digest of the manifest.
        digest: Digest,
        /// Format number of the manifest.
        found: u32,
    },
    /// A file is missing or has another length.
    #[error("manifest {digest} lists {file} as blob {blob} of {expected} bytes, which is {found}")]
    Incomplete {
        /// Digest of the manifest.
        digest: Digest,
        /// The file, or the chunk of one.
        file: String,
        blob: Digest,
        /// Length in the manifest.
        expected: u64,
        /// Description of the stored blob.
        found: String,
    },
}

impl ManifestError {
    /// Returns the blob that is missing or damaged, if that is the error.
    pub(crate) fn blob(&self) -> Option<Digest> {
        match self {
            Self::Blob(BlobError::NotFound(digest) | BlobError::Corrupt { expected: digest, .. }) => Some(*digest),
            Self::Incomplete { blob, .. } => Some(*blob),
            Self::Blob(_) | Self::NotAManifest { .. } | Self::Format { .. } => None,
        }
    }
}

/// A blob of a file in a manifest.
#[derive(Debug, Clone)]
pub(crate) struct Listed {
    /// The file's name.
    name: String,
    /// Number of the blob among the file's, from 1.
    number: usize,
    /// Number of the file's blobs.
    of: usize,
    pub(crate) blob: Chunk,
}

impl Listed {
    /// Names the file, or the chunk of one.
    fn file(&self) -> String {
        let Self { name, number, of, .. } = self;
        if *of == 1 { format!("`{name}`") } else { format!("chunk {number} of {of} of `{name}`") }
    }
}

/// Returns the blobs of a manifest's files.
pub(crate) fn listed(manifest: &Manifest) -> impl Iterator<Item = Listed> + '_ {
    manifest.files.iter().flat_map(|(name, file)| {
        let of = file.chunks.len().max(1);
        file.blobs().enumerate().map(move |(at, blob)| Listed { name: name.clone(), number: at + 1, of, blob })
    })
}

/// Parses the bytes of the manifest `digest`.
fn parse(digest: Digest, bytes: &[u8]) -> Result<Manifest, ManifestError> {
    let not_a_manifest = |cause: String| ManifestError::NotAManifest { digest, cause };
    let manifest: Manifest = serde_json::from_slice(bytes).map_err(|e| not_a_manifest(e.to_string()))?;
    if !manifest.is_readable() {
        return Err(ManifestError::Format { digest, found: manifest.format });
    }
    manifest.check_files().map_err(not_a_manifest)?;
    Ok(manifest)
}

impl BlobStore {
    /// Returns the manifest named `digest` and its length. A manifest that this process has just stored is not
    /// requested again.
    pub(crate) fn stored_manifest(&self, digest: Digest) -> Result<(Manifest, u64), ManifestError> {
        if let Some(content) = self.seen().content(digest) {
            return Ok((parse(digest, &content)?, content.len() as u64));
        }
        let bytes = self.manifest_bytes(digest, |reader| reader)?;
        Ok((parse(digest, &bytes)?, bytes.len() as u64))
    }

    /// Returns the manifest named `digest`.
    pub fn manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        parse(digest, &self.manifest_bytes(digest, |reader| reader)?)
    }

    /// Like [`Self::manifest`], for one of very many.
    pub(crate) fn manifest_of_many(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        parse(digest, &self.manifest_bytes(digest, Reader::without_record)?)
    }

    fn manifest_bytes(&self, digest: Digest, with: impl Fn(Reader) -> Reader) -> Result<Vec<u8>, ManifestError> {
        let stat = self.must_stat(digest).map_err(ManifestError::Blob)?;
        if stat.bytes > MANIFEST_BYTES {
            let cause = format!("it has {} bytes; expected at most {MANIFEST_BYTES}", stat.bytes);
            return Err(ManifestError::NotAManifest { digest, cause });
        }
        let reader = self.reader(digest, stat).map_err(ManifestError::Blob)?;
        with(reader).all().map_err(ManifestError::Blob)
    }

    /// Returns the manifest named `digest` after checking that every listed blob exists with the right length.
    pub fn complete_manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let manifest = self.manifest(digest)?;
        for part in listed(&manifest) {
            self.check_listed(digest, &part)?;
        }
        Ok(manifest)
    }

    /// Checks that a blob listed by the manifest `digest` exists with the right length.
    pub(crate) fn check_listed(&self, digest: Digest, part: &Listed) -> Result<(), ManifestError> {
        let Chunk { digest: blob, bytes: expected } = part.blob;
        let found = self.size(blob).map_err(ManifestError::Blob)?;
        if found == Some(expected) {
            return Ok(());
        }
        let found = found.map_or_else(|| "not in the store".into(), |bytes| format!("{bytes} bytes long"));
        Err(ManifestError::Incomplete { digest, file: part.file(), blob, expected, found })
    }

    /// Returns the manifest named `digest` after verifying every listed blob. Hashes the blobs that were written since
    /// they were last hashed.
    pub fn whole_manifest(&self, digest: Digest) -> Result<Manifest, ManifestError> {
        let manifest = self.complete_manifest(digest)?;
        for blob in manifest.blobs() {
            self.verify(blob.digest).map_err(ManifestError::Blob)?;
        }
        Ok(manifest)
    }

    /// Returns the missing or damaged part of an artifact, if there is one. An error gives no information about the
    /// artifact.
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
