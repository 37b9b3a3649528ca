//! Transfers of the store's blobs over HTTP, under one grant.
//!
//! Large blobs are sent and received in parts. They are in memory as a whole only if the stage asks for that. An
//! interrupted transfer continues at the byte where it stopped.

use std::sync::Arc;

use bytes::{Bytes, BytesMut};
use checkpoint::{Blob, BlobError, Blobs, digest_of, read_parts};
use protocol::artifact::Chunk;
use protocol::limits::SMALL_BLOB_BYTES;
use protocol::proof::SignedRequest;
use protocol::{Digest, FileEntry, Manifest};

use crate::active_assignment::ActiveAssignment;
use crate::cache::{Arriving, Cache, Cached};
use crate::client::{CallError, Client, Credential};
use crate::failpoints;
use crate::receipts::Receipts;
use crate::retry::{self, GaveUp};

/// [`Blobs`] of an attempt. Writes carry its grant; reads are verified and cached.
#[derive(Debug)]
pub(crate) struct HttpBlobs {
    pub(crate) held: Arc<ActiveAssignment>,
    pub(crate) client: Client,
    pub(crate) cache: Arc<Cache>,
    /// Receipts of uploads.
    pub(crate) receipts: Receipts,
    /// True in gangs, whose uploads pass the fail points of checkpoints.
    pub(crate) gang: bool,
}

/// Number of times that a blob that arrives damaged is fetched again.
const DAMAGED: u32 = 2;
/// Size of one part.
const PART_BYTES: usize = 8 << 20;

impl HttpBlobs {
    /// Uploads a manifest whose blobs are uploaded.
    pub(crate) fn put_manifest(&self, manifest: &Manifest) -> Result<Digest, BlobError> {
        let digest = self.put(manifest.to_bytes())?;
        self.receipts.note(digest, manifest);
        Ok(digest)
    }

    /// Returns the blob from the cache, after fetching it if necessary.
    fn cached(&self, digest: Digest) -> Result<Cached, BlobError> {
        if let Some(blob) = self.cache.get(digest) {
            return Ok(blob);
        }
        let mut damaged = 0;
        loop {
            let mut arriving = None;
            // The coordinator verifies what it sends, and mends the store if a blob is damaged there.
            let through_server = damaged > 0;
            retry::until_ended(&self.held, &format!("fetching blob {digest}"), |_| {
                self.fetch(digest, &mut arriving, through_server)
            })
            .map_err(|gave_up| error(gave_up, Some(digest)))?;
            let arrived = arriving.ok_or_else(|| BlobError::Unavailable(format!("blob {digest} did not arrive")))?;
            match arrived.finish(&self.cache)? {
                Ok(blob) => return Ok(blob),
                Err(found) => {
                    damaged += 1;
                    if damaged > DAMAGED {
                        return Err(BlobError::Corrupt { expected: digest, found });
                    }
                    tracing::warn!("blob {digest} arrived damaged: its bytes hash to {found}; fetching it again");
                }
            }
        }
    }

    /// Returns a file of several blobs as one, from the cache or joined from its blobs and verified as a whole.
    fn joined(&self, file: &FileEntry) -> Result<Cached, BlobError> {
        if let Some(whole) = self.cache.get(file.digest) {
            return Ok(whole);
        }
        let local = |e: std::io::Error| BlobError::Storage(format!("file {} cannot be kept here: {e}", file.digest));
        let mut joined = self.cache.arriving(file.digest, Some(file.bytes)).map_err(local)?;
        for Chunk { digest, .. } in file.blobs() {
            read_parts(&self.cached(digest)?, |part| joined.write(part).map_err(local))?;
        }
        joined.finish(&self.cache)?.map_err(|found| BlobError::Corrupt { expected: file.digest, found })
    }

    /// Fetches the missing bytes. Bytes that have arrived stay in `arriving` if the connection breaks.
    fn fetch(&self, digest: Digest, arriving: &mut Option<Arriving>, through_server: bool) -> Result<(), CallError> {
        let offset = arriving.as_ref().map_or(0, Arriving::written);
        let mut download = self.client.wait(self.client.get_blob(digest, offset, through_server))?;
        let local = |e: std::io::Error| CallError::Storage(format!("blob {digest} cannot be kept here: {e}"));
        let arriving = match arriving {
            Some(arriving) => arriving,
            None => arriving.insert(self.cache.arriving(digest, download.length()).map_err(local)?),
        };
        while let Some(bytes) = self.client.wait(download.next())? {
            arriving.write(&bytes).map_err(local)?;
        }
        Ok(())
    }

    /// Sends a blob to the place of the blobs. Gives up as soon as the grant has ended.
    fn send_directly(&self, signed: &SignedRequest, source: &dyn Blob) -> Result<(), String> {
        let mut offset = 0;
        let next = || {
            if let Some(reason) = self.held.ended() {
                return Err(reason);
            }
            let part = part(source, offset).map_err(|error| error.to_string())?;
            offset += part.len() as u64;
            Ok((!part.is_empty()).then_some(part))
        };
        self.client.wait(self.client.direct.put(signed, source.bytes(), next))
    }

    /// Sends the bytes that the store lacks, directly to the place of the blobs if the coordinator has signed a request.
    fn send(&self, credential: &Credential, digest: Digest, source: &dyn Blob) -> Result<(), CallError> {
        let bytes = source.bytes();
        let mut offset = 0;
        if bytes > SMALL_BLOB_BYTES {
            let receipt = self.receipts.of(digest);
            let there = self.client.wait(self.client.staged(credential, digest, receipt))?;
            if there.stored {
                self.receipts.keep(digest, there.receipt);
                return Ok(());
            }
            offset = there.staged;
            if let Some(signed) = &there.direct
                && self.send_directly(signed, source).is_ok()
            {
                let there = self.client.wait(self.client.sent(credential, digest))?;
                if there.stored {
                    self.receipts.keep(digest, there.receipt);
                    return Ok(());
                }
                tracing::warn!("the place of the blobs does not attest blob {digest}; sending it through the server");
            }
            if offset > 0 {
                tracing::info!("{offset} of {bytes} bytes of blob {digest} have arrived; sending the rest");
            }
        }
        loop {
            let part = part(source, offset).map_err(|error| CallError::Storage(error.to_string()))?;
            let end = offset + part.len() as u64;
            let there = self.client.wait(self.client.put_part(credential, digest, bytes, offset, part))?;
            if there.stored {
                self.receipts.keep(digest, there.receipt);
                return Ok(());
            }
            if there.staged != end || end == bytes {
                return Err(CallError::Fault(format!(
                    "{end} of {bytes} bytes of blob {digest} were sent, but {} bytes arrived",
                    there.staged
                )));
            }
            offset = end;
        }
    }
}

/// The bytes that begin at `offset`, at most [`PART_BYTES`].
fn part(source: &dyn Blob, offset: u64) -> Result<Bytes, BlobError> {
    let length = (source.bytes() - offset).min(PART_BYTES as u64);
    let mut part = BytesMut::zeroed(usize::try_from(length).unwrap_or(PART_BYTES));
    source.read_at(offset, &mut part)?;
    Ok(part.freeze())
}

impl Blobs for HttpBlobs {
    fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
        self.cached(digest)?.into_memory()
    }

    fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
        self.put_copy(&&bytes[..])
    }

    fn put_copy(&self, source: &dyn Blob) -> Result<Digest, BlobError> {
        if self.gang {
            failpoints::hit("checkpoint::before_upload");
        }
        let digest = digest_of(source)?;
        retry::until_put_off(&self.held, &format!("uploading blob {digest}"), |credential| {
            self.send(credential, digest, source)
        })
        .map_err(|gave_up| error(gave_up, None))?;
        if self.gang {
            failpoints::hit("checkpoint::after_upload");
        }
        Ok(digest)
    }

    fn open(&self, digest: Digest) -> Result<Box<dyn Blob>, BlobError> {
        Ok(Box::new(self.cached(digest)?))
    }

    fn map(&self, digest: Digest) -> Result<Bytes, BlobError> {
        self.cached(digest)?.into_bytes()
    }

    fn map_chunks(&self, file: &FileEntry) -> Option<Result<Bytes, BlobError>> {
        Some(self.joined(file).and_then(Cached::into_bytes))
    }
}

fn error(gave_up: GaveUp, wanted: Option<Digest>) -> BlobError {
    match (gave_up, wanted) {
        (GaveUp::Ended(reason), _) => BlobError::Refused(reason),
        (GaveUp::Answer(CallError::NotFound(_)), Some(digest)) => BlobError::NotFound(digest),
        (GaveUp::Answer(CallError::Damaged(message)), _) => BlobError::Damaged(message),
        (GaveUp::Answer(CallError::Storage(message)), _) => BlobError::Storage(message),
        (GaveUp::Answer(CallError::Stale(message)), _) => BlobError::Refused(message),
        (GaveUp::Answer(CallError::Refused(message) | CallError::Unauthorized(message)), _) => {
            BlobError::Unfit(message)
        }
        (GaveUp::Answer(error), _) => BlobError::Unavailable(error.to_string()),
    }
}
