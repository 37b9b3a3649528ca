//! Writes a bundle file by file from any source.

use std::fmt;
use std::io::{self, Write};

use protocol::Manifest;
use tar::{EntryType, Header};
use zstd::stream::write::Encoder;

use super::Head;
use super::format::{CARD, HEAD, MANIFEST};

/// A fast level: weights hardly compress.
const LEVEL: i32 = 3;
/// Alignment of entries in a tar archive.
const BLOCK: u64 = 512;

/// Reason why a bundle cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The output cannot be written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The content is invalid.
    #[error("{0}")]
    Content(String),
}

/// Writer of a bundle: [`begin`](Self::begin), then [`file`](Self::file) and [`write`](Self::write) for each file of
/// the manifest in order, then [`finish`](Self::finish).
pub struct Writer<W: Write> {
    encoder: Encoder<'static, W>,
    /// The open entry's name, and the number of bytes that it still lacks.
    open: (String, u64),
    padding: u64,
}

impl<W: Write> fmt::Debug for Writer<W> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Writer").field("open", &self.open).finish_non_exhaustive()
    }
}

impl<W: Write> Writer<W> {
    /// Starts a bundle with head, manifest and card.
    pub fn begin(into: W, head: &Head, manifest: &Manifest, card: &str) -> Result<Self, WriteError> {
        let mut encoder = Encoder::new(into, LEVEL)?;
        encoder.include_checksum(true)?;
        let mut writer = Self { encoder, open: (String::new(), 0), padding: 0 };
        let mut text = serde_json::to_vec_pretty(head).map_err(|e| WriteError::Content(e.to_string()))?;
        text.push(b'\n');
        for (name, content) in [(HEAD, &text[..]), (MANIFEST, &manifest.to_bytes()), (CARD, card.as_bytes())] {
            writer.file(name, content.len() as u64)?;
            writer.write(content)?;
        }
        Ok(writer)
    }

    /// Starts a file of `bytes` bytes.
    pub fn file(&mut self, name: &str, bytes: u64) -> Result<(), WriteError> {
        self.close()?;
        let mut header = Header::new_ustar();
        header.set_path(name).map_err(|e| WriteError::Content(format!("file `{name}`: {e}")))?;
        header.set_entry_type(EntryType::Regular);
        header.set_size(bytes);
        header.set_mode(0o644);
        header.set_mtime(0);
        header.set_uid(0);
        header.set_gid(0);
        header.set_cksum();
        self.encoder.write_all(header.as_bytes())?;
        self.open = (name.to_owned(), bytes);
        self.padding = bytes.next_multiple_of(BLOCK) - bytes;
        Ok(())
    }

    /// Appends bytes to the open file.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), WriteError> {
        let (name, left) = &mut self.open;
        *left = left
            .checked_sub(bytes.len() as u64)
            .ok_or_else(|| WriteError::Content(format!("file `{name}` has more bytes than its manifest says")))?;
        Ok(self.encoder.write_all(bytes)?)
    }

    /// Ends the bundle and returns the inner writer.
    pub fn finish(mut self) -> Result<W, WriteError> {
        self.close()?;
        self.encoder.write_all(&[0; 2 * BLOCK as usize])?;
        Ok(self.encoder.finish()?)
    }

    fn close(&mut self) -> Result<(), WriteError> {
        let (name, left) = &self.open;
        if *left > 0 {
            return Err(WriteError::Content(format!("file `{name}` lacks {left} of the bytes in its manifest")));
        }
        let zeros = [0; BLOCK as usize];
        let padding = usize::try_from(std::mem::take(&mut self.padding)).unwrap_or_default();
        Ok(self.encoder.write_all(&zeros[..padding])?)
    }
}
