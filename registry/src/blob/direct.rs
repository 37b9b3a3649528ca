//! Blobs that workers read and write at the place itself, by signed requests.

use std::sync::PoisonError;

use checkpoint::BlobError;
use protocol::Digest;
use protocol::limits::SMALL_BLOB_BYTES;
use protocol::message::Grant;
use protocol::proof::SignedRequest;

use super::BlobStore;
use super::known::Finding;
use super::uploads::{holder, staged_name};

/// The name under which a blob arrives: that of an upload through this process.
fn name(grant: &Grant, digest: Digest) -> String {
    staged_name(&(holder(grant), digest))
}

impl BlobStore {
    /// Signs a request that reads a blob which is not known to be damaged. `None` for a small blob, and if the place takes
    /// no signed requests. The reader verifies the bytes.
    pub fn sign_read(&self, digest: Digest) -> Result<Option<SignedRequest>, BlobError> {
        let Some(signed) = self.backend().sign_read(digest) else { return Ok(None) };
        let bytes = self.not_damaged(digest)?.bytes;
        Ok(Some(signed).filter(|_| bytes > SMALL_BLOB_BYTES))
    }

    /// Signs a request that sends a blob under a grant. `None` if the place does not verify what it stores.
    pub fn sign_write(&self, grant: &Grant, digest: Digest) -> Option<SignedRequest> {
        self.backend().sign_write(&name(grant, digest), digest)
    }

    /// Returns true if the blob was sent under the grant and the place attests its digest.
    pub fn has_arrived(&self, grant: &Grant, digest: Digest) -> bool {
        self.backend().has_arrived(&name(grant, digest), digest)
    }

    /// Stores a blob that [`Self::has_arrived`], as if it had been put by this process.
    pub fn take_over(&self, grant: &Grant, digest: Digest) -> Result<(), BlobError> {
        let name = name(grant, digest);
        if !self.reuse(digest)? {
            let stat = self.backend().settle(&name, digest)?;
            let _no_removal = self.removal(digest).read().unwrap_or_else(PoisonError::into_inner);
            let now = self.must_stat(digest)?;
            if now.stamp == stat.stamp {
                self.known().set(digest, stat.stamp, Finding::Whole);
                self.seen().note(digest, stat.bytes);
            }
        }
        if let Err(error) = self.backend().forget_arrived(&name) {
            tracing::debug!("a sent blob stays until the next collection: {error}");
        }
        Ok(())
    }
}
