//! Files as bytes: the pages are the machine's, shared by all processes that read the file.
#![allow(unsafe_code, reason = "a mapping is sound only while nobody changes the file, which no type can say")]

use std::fs::File;
use std::io;

use bytes::Bytes;
use memmap2::{Advice, Mmap};

/// The content of a blob's file. Files of blobs are written under another name, given theirs once they are whole, and removed or
/// replaced later, never changed; pages of a removed file stay as long as they are mapped. Somebody who cuts a file short
/// by hand ends the processes that read it; they start again and find the blob damaged.
pub(crate) fn file(file: &File) -> io::Result<Bytes> {
    if file.metadata()?.len() == 0 {
        return Ok(Bytes::new());
    }
    // SAFETY: see above.
    let map = unsafe { Mmap::map(file)? };
    // Examples come in a random order; what is around them is not read with them.
    map.advise(Advice::Random)?;
    Ok(Bytes::from_owner(map))
}
