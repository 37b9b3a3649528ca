//! The store's blobs over HTTP, in the name of one grant.

use std::sync::Arc;

use bytes::Bytes;
use checkpoint::{BlobError, Blobs};
use protocol::Digest;

use crate::active_assignment::ActiveAssignment;
use crate::cache::Cache;
use crate::client::{CallError, Client};
use crate::failpoints;
use crate::retry::{self, GaveUp};

/// [`Blobs`] of an attempt. Writes carry its grant; reads are verified and cached.
#[derive(Debug)]
pub(crate) struct HttpBlobs {
    pub(crate) held: Arc<ActiveAssignment>,
    pub(crate) client: Client,
    pub(crate) cache: Arc<Cache>,
    /// Whether the fail points of checkpoints are passed: in gangs.
    pub(crate) gang: bool,
}

/// How often a blob that arrives damaged is fetched again.
const DAMAGED: u32 = 2;

impl Blobs for HttpBlobs {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        if let Some(blob) = self.cache.get(digest) {
            return Ok(blob);
        }
        let mut damaged = 0;
        loop {
            let bytes = retry::until_ended(&self.held, &format!("fetching blob {digest}"), |_| {
                self.client.wait(self.client.get_blob(digest))
            })
            .map_err(|gave_up| error(gave_up, Some(digest)))?;
            let found = Digest::of(&bytes);
            if found == digest {
                let blob: Arc<[u8]> = Arc::from(&*bytes);
                self.cache.insert(digest, &blob);
                return Ok(blob);
            }
            damaged += 1;
            if damaged > DAMAGED {
                return Err(BlobError::Corrupt { expected: digest, found });
            }
            tracing::warn!("blob {digest} arrived damaged: its bytes hash to {found}; fetching it again");
        }
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        if self.gang {
            failpoints::hit("checkpoint::before_upload");
        }
        let expected = Digest::of(&bytes);
        // Cheap to clone: each try sends the same memory.
        let bytes = Bytes::from(bytes);
        let stored = retry::until_ended(&self.held, &format!("uploading blob {expected}"), |grant| {
            self.client.wait(self.client.put_blob(grant, bytes.clone()))
        })
        .map_err(|gave_up| error(gave_up, None))?;
        if stored != expected {
            return Err(BlobError::Corrupt { expected, found: stored });
        }
        if self.gang {
            failpoints::hit("checkpoint::after_upload");
        }
        Ok(expected)
    }
}

fn error(gave_up: GaveUp, wanted: Option<Digest>) -> BlobError {
    match (gave_up, wanted) {
        (GaveUp::Ended(reason), _) => BlobError::Refused(reason),
        (GaveUp::Answer(CallError::NotFound(_)), Some(digest)) => BlobError::NotFound(digest),
        (GaveUp::Answer(CallError::Storage(message)), _) => BlobError::Storage(message),
        (GaveUp::Answer(CallError::Stale(message)), _) => BlobError::Refused(message),
        (GaveUp::Answer(error), _) => BlobError::Unavailable(error.to_string()),
    }
}
