//! Files as mapped bytes: all processes that read a file share its pages.
#![allow(unsafe_code, reason = "a mapping is sound only while nobody changes the file, which no type can say")]

use std::fs::File;
use std::io;

use bytes::Bytes;
use memmap2::{Advice, Mmap};

/// Maps the content of a blob's file. A blob is written under another name and renamed once it is whole. Later it is
/// removed or replaced but never changed. Pages of a removed file stay as long as they are mapped. If a user truncates
/// a file by hand, the processes that read it die; after a restart they find the blob damaged.
pub(crate) fn file(file: &File) -> io::Result<Bytes> {
    if file.metadata()?.len() == 0 {
        return Ok(Bytes::new());
    }
    // SAFETY: files of blobs never change, see above.
    let map = unsafe { Mmap::map(file)? };
    // Examples are read in random order, so read-ahead does not help.
    map.advise(Advice::Random)?;
    Ok(Bytes::from_owner(map))
}
