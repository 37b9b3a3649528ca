//! A blob on its way to the bucket.

use std::fs::OpenOptions;
use std::io;
use std::sync::Arc;

use checkpoint::BlobError;
use protocol::Digest;

use super::multipart::PART_BYTES;
use super::requests::Inner;
use crate::blob::Staged;
use crate::blob::disk::regular;
use crate::blob::staging::Part;
use crate::failpoints::fail_point;

/// A blob being written to the store's folder, sent when it is complete.
#[derive(Debug)]
pub(super) struct StagedObject {
    pub(super) part: Part,
    pub(super) objects: Arc<Inner>,
}

impl Staged for StagedObject {
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError> {
        self.part.write(bytes)
    }

    fn commit(mut self: Box<Self>, digest: Digest) -> Result<bool, BlobError> {
        fail_point!("blob::after_write");
        let here = |e: io::Error| crate::blob::fs::error("read", &self.part.path, &e);
        io::Write::flush(&mut self.part.file).map_err(here)?;
        let file = regular(OpenOptions::new().read(true), &self.part.path).map_err(here)?;
        let bytes = file.metadata().map_err(here)?.len();
        // A put in one request fails by itself if the name is taken.
        if bytes > PART_BYTES as u64 && self.objects.head(digest)?.is_some() {
            return Ok(false);
        }
        // Recorded first: a collection that sees the object must see that it is young, even if the server's clock
        // differs.
        self.objects.note(digest);
        let path = self.objects.remote.blob(digest);
        let sent = self.objects.send(&path, bytes, file).map_err(|e| self.objects.remote.error("write", &path, &e));
        fail_point!("blob::after_rename");
        sent
    }
}
