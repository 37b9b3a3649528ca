//! Reads a blob part by part, verified before its last part is returned.

use std::fmt;
use std::io::{self, Read};
use std::sync::Arc;

use checkpoint::BlobError;
use protocol::Digest;
use protocol::digest::Hasher;

use super::backend::{Backend, Stat};
use super::known::{Finding, Findings};

/// Size of one read.
pub const PART_BYTES: usize = 1 << 20;

/// A blob being read. Each part is held back until the next one was read, and the last one until all bytes were hashed.
/// A damaged blob is therefore never returned whole.
pub struct Reader {
    findings: Arc<Findings>,
    digest: Digest,
    stat: Stat,
    source: Box<dyn Read + Send>,
    state: State,
    held_back: Option<Vec<u8>>,
    /// True if a whole blob is recorded, which spares the next reader's hashing.
    records_whole: bool,
}

enum State {
    /// The bytes are hashed as they are read.
    Hashing(Hasher),
    /// The blob was verified before.
    Verified,
    Ended,
}

impl fmt::Debug for Reader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reader").field("digest", &self.digest).finish_non_exhaustive()
    }
}

impl Reader {
    pub(super) fn new(
        backend: &dyn Backend,
        findings: &Arc<Findings>,
        digest: Digest,
        stat: Stat,
    ) -> Result<Self, BlobError> {
        let source = backend.read(digest, 0)?;
        let findings = Arc::clone(findings);
        let state = State::Hashing(Hasher::default());
        Ok(Self { findings, digest, stat, source, state, held_back: None, records_whole: true })
    }

    /// Leaves no record of a whole blob, which would take memory for each of very many.
    pub(super) fn without_record(self) -> Self {
        Self { records_whole: false, ..self }
    }

    /// Reads a verified blob from byte `from` on.
    pub(super) fn verified(
        backend: &dyn Backend,
        findings: &Arc<Findings>,
        digest: Digest,
        stat: Stat,
        from: u64,
    ) -> Result<Self, BlobError> {
        let source = backend.read(digest, from)?;
        let findings = Arc::clone(findings);
        Ok(Self { findings, digest, stat, source, state: State::Verified, held_back: None, records_whole: true })
    }

    /// Returns the blob's length.
    pub fn bytes(&self) -> u64 {
        self.stat.bytes
    }

    /// Returns the rest of the bytes in memory.
    pub(super) fn all(mut self) -> Result<Vec<u8>, BlobError> {
        let mut bytes = Vec::with_capacity(usize::try_from(self.bytes()).unwrap_or_default());
        while let Some(part) = self.next_part()? {
            bytes.extend_from_slice(&part);
        }
        Ok(bytes)
    }

    /// Returns the next bytes, or `None` after the last ones. Returns [`BlobError::Corrupt`] instead of a damaged
    /// blob's last part.
    pub fn next_part(&mut self) -> Result<Option<Vec<u8>>, BlobError> {
        loop {
            let hasher = match &mut self.state {
                State::Hashing(hasher) => hasher,
                State::Verified => {
                    let part = read_part(&mut *self.source, self.digest, self.stat.bytes)?;
                    return Ok((!part.is_empty()).then_some(part));
                }
                State::Ended => return Ok(self.held_back.take()),
            };
            let part = read_part(&mut *self.source, self.digest, self.stat.bytes)?;
            hasher.update(&part);
            if part.is_empty() {
                let found = std::mem::take(hasher).finish();
                self.state = State::Ended;
                if found != self.digest {
                    self.held_back = None;
                    self.findings.note(self.digest, &self.stat, Finding::Damaged(found));
                    return Err(BlobError::Corrupt { expected: self.digest, found });
                }
                if self.records_whole {
                    self.findings.note(self.digest, &self.stat, Finding::Whole);
                }
            } else if let Some(before) = self.held_back.replace(part) {
                return Ok(Some(before));
            }
        }
    }
}

/// Reads up to [`PART_BYTES`] of a blob of `bytes`; fewer only at the end.
fn read_part(source: &mut (dyn Read + Send), digest: Digest, bytes: u64) -> Result<Vec<u8>, BlobError> {
    let most = usize::try_from(bytes).map_or(PART_BYTES, |bytes| bytes.min(PART_BYTES));
    let mut part = Vec::with_capacity(most);
    source.take(PART_BYTES as u64).read_to_end(&mut part).map_err(|e| read_error(digest, &e))?;
    Ok(part)
}

pub(super) fn read_error(digest: Digest, e: &io::Error) -> BlobError {
    let message = format!("failed to read blob {digest}: {e}");
    match e.kind() {
        io::ErrorKind::HostUnreachable => BlobError::Unreachable(message),
        _ => BlobError::Unavailable(message),
    }
}
