//! Files of artifacts over [`Blobs`]: written and read as one, stored in blobs of limited size.
//!
//! A file that is longer than a chunk is several blobs, so an upload that is interrupted continues with the first chunk
//! that is missing. Memory does not grow with the file, except in [`get`].

use std::sync::Arc;

use bytes::Bytes;
use protocol::artifact::Chunk;
use protocol::digest::Hasher;
use protocol::{FileEntry, limits};

use crate::{Blob, BlobError, Blobs, Joined, past_the_end, read_parts};

/// Stores the concatenation of `pieces` as a file; see [`put_copy`].
pub fn put(blobs: &dyn Blobs, pieces: &[&[u8]], chunk_bytes: u64) -> Result<FileEntry, BlobError> {
    put_copy(blobs, &Joined::new(pieces.to_vec()), chunk_bytes)
}

/// Stores a copy of `source` as a file whose blobs have `chunk_bytes` bytes, usually [`limits::CHUNK_BYTES`].
pub fn put_copy(blobs: &dyn Blobs, source: &dyn Blob, chunk_bytes: u64) -> Result<FileEntry, BlobError> {
    let bytes = source.bytes();
    if bytes <= chunk_bytes {
        return Ok(FileEntry::of_blob(blobs.put_copy(source)?, bytes));
    }
    if bytes.div_ceil(chunk_bytes) > limits::FILE_CHUNKS as u64 {
        let most = limits::FILE_CHUNKS as u64 * chunk_bytes;
        return Err(BlobError::Unfit(format!("a file has {bytes} bytes; expected at most {most}")));
    }
    let mut hasher = Hasher::default();
    let mut chunks = Vec::new();
    let mut start = 0;
    while start < bytes {
        let chunk = Part { whole: source, start, bytes: chunk_bytes.min(bytes - start) };
        read_parts(&chunk, |part| {
            hasher.update(part);
            Ok::<_, BlobError>(())
        })?;
        chunks.push(Chunk { digest: blobs.put_copy(&chunk)?, bytes: chunk.bytes });
        start += chunk.bytes;
    }
    Ok(FileEntry { digest: hasher.finish(), bytes, chunks })
}

/// A part of a blob.
#[derive(Debug)]
struct Part<'a> {
    whole: &'a dyn Blob,
    start: u64,
    bytes: u64,
}

impl Blob for Part<'_> {
    fn bytes(&self) -> u64 {
        self.bytes
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), BlobError> {
        if offset.checked_add(out.len() as u64).is_none_or(|end| end > self.bytes) {
            return Err(past_the_end(offset, out.len(), self.bytes));
        }
        self.whole.read_at(self.start + offset, out)
    }
}

/// Returns the verified bytes of a file in memory.
pub fn get(blobs: &dyn Blobs, file: &FileEntry) -> Result<Arc<[u8]>, BlobError> {
    if file.chunks.is_empty() {
        return blobs.get(file.digest);
    }
    let opened = open(blobs, file)?;
    let length = usize::try_from(file.bytes).unwrap_or(usize::MAX);
    let mut bytes: Arc<[u8]> = std::iter::repeat_n(0, length).collect();
    let out = Arc::get_mut(&mut bytes).expect("the buffer is new and not shared");
    opened.read_at(0, out)?;
    let mut hasher = Hasher::default();
    hasher.update(out);
    let found = hasher.finish();
    if found != file.digest {
        return Err(BlobError::Corrupt { expected: file.digest, found });
    }
    Ok(bytes)
}

/// Verifies all blobs of a file and opens it for reading in parts.
pub fn open(blobs: &dyn Blobs, file: &FileEntry) -> Result<Box<dyn Blob>, BlobError> {
    if file.chunks.is_empty() {
        return blobs.open(file.digest);
    }
    file.check().map_err(BlobError::Damaged)?;
    let mut opened = Vec::new();
    for Chunk { digest, bytes } in file.blobs() {
        let blob = blobs.open(digest)?;
        if blob.bytes() != bytes {
            let found = blob.bytes();
            return Err(BlobError::Damaged(format!("blob {digest} has {found} bytes; its manifest lists {bytes}")));
        }
        opened.push(blob);
    }
    Ok(Box::new(Joined::new(opened)))
}

/// Maps a file; see [`Blobs::map`].
pub fn map(blobs: &dyn Blobs, file: &FileEntry) -> Result<Bytes, BlobError> {
    if file.chunks.is_empty() {
        return blobs.map(file.digest);
    }
    blobs.map_chunks(file).unwrap_or_else(|| get(blobs, file).map(Bytes::from_owner))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use std::collections::BTreeMap;
    use std::sync::Mutex;

    use protocol::Digest;

    use super::*;

    #[derive(Debug, Default)]
    struct Kept(Mutex<BTreeMap<Digest, Vec<u8>>>);

    impl Blobs for Kept {
        fn get(&self, digest: Digest) -> Result<Arc<[u8]>, BlobError> {
            let kept = self.0.lock().unwrap();
            let bytes = kept.get(&digest).ok_or(BlobError::NotFound(digest))?;
            match Digest::of(bytes) {
                found if found == digest => Ok(bytes.clone().into()),
                found => Err(BlobError::Corrupt { expected: digest, found }),
            }
        }

        fn put(&self, bytes: Vec<u8>) -> Result<Digest, BlobError> {
            let digest = Digest::of(&bytes);
            self.0.lock().unwrap().insert(digest, bytes);
            Ok(digest)
        }
    }

    fn bytes(count: usize) -> Vec<u8> {
        (0..count).map(|i| (i % 251) as u8).collect()
    }

    #[test]
    fn a_file_is_the_same_bytes_in_one_blob_and_in_several() {
        let all = bytes(100);
        for chunk in [1, 7, 33, 50, 99, 100, 1000] {
            let blobs = Kept::default();
            let file = put(&blobs, &[&all[..0], &all[..33], &all[33..34], &all[34..], &[]], chunk).unwrap();
            assert_eq!((file.digest, file.bytes), (Digest::of(&all), 100), "{chunk}");
            assert_eq!(file.chunks.is_empty(), chunk >= 100, "{chunk}");
            assert_eq!(file.check(), Ok(()));
            let cut: Vec<Digest> = all.chunks(chunk as usize).map(Digest::of).collect();
            assert_eq!(file.blobs().map(|blob| blob.digest).collect::<Vec<_>>(), cut, "{chunk}");
            assert_eq!(*get(&blobs, &file).unwrap(), *all);
            assert_eq!(*map(&blobs, &file).unwrap(), *all);
            let opened = open(&blobs, &file).unwrap();
            assert_eq!(opened.bytes(), 100);
            for (from, to) in [(0, 100), (0, 0), (100, 100), (6, 8), (32, 67), (99, 100)] {
                let mut out = vec![0; to - from];
                opened.read_at(from as u64, &mut out).unwrap();
                assert_eq!(out, all[from..to], "{chunk}: {from}..{to}");
            }
            assert!(opened.read_at(99, &mut [0; 2]).is_err());
        }
    }

    #[test]
    fn a_damaged_or_missing_chunk_is_named() {
        let blobs = Kept::default();
        let file = put(&blobs, &[&bytes(100)], 40).unwrap();
        let damaged = file.chunks[1].digest;
        blobs.0.lock().unwrap().get_mut(&damaged).unwrap()[3] ^= 1;
        let refused = open(&blobs, &file).unwrap_err();
        assert!(matches!(refused, BlobError::Corrupt { expected, .. } if expected == damaged), "{refused}");
        blobs.0.lock().unwrap().remove(&damaged);
        let refused = get(&blobs, &file).unwrap_err();
        assert!(matches!(refused, BlobError::NotFound(digest) if digest == damaged), "{refused}");
    }

    #[test]
    fn chunks_that_are_not_the_file_are_refused() {
        let blobs = Kept::default();
        let file = put(&blobs, &[&bytes(100)], 40).unwrap();
        let mut swapped = file.clone();
        swapped.chunks.swap(0, 1);
        let refused = get(&blobs, &swapped).unwrap_err();
        assert!(matches!(refused, BlobError::Corrupt { expected, .. } if expected == file.digest), "{refused}");
        let mut longer = file.clone();
        longer.bytes += 1;
        assert!(matches!(open(&blobs, &longer), Err(BlobError::Damaged(_))));
        let mut shifted = file;
        shifted.chunks[0].bytes -= 1;
        shifted.chunks[1].bytes += 1;
        assert!(matches!(get(&blobs, &shifted), Err(BlobError::Damaged(_))));
        let refused = put(&blobs, &[&bytes(513)], 1).unwrap_err();
        assert!(refused.to_string().contains("a file has 513 bytes; expected at most 512"), "{refused}");
    }
}
