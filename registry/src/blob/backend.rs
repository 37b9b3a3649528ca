//! What a place for bytes must do.

use std::collections::BTreeSet;
use std::fmt;
use std::io::Read;

use checkpoint::BlobError;
use protocol::Digest;

/// A blob as a listing shows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry {
    /// Its name.
    pub digest: Digest,
    /// Its length.
    pub bytes: u64,
    /// When it was last put, in milliseconds since 1970.
    pub put_ms: i64,
}

/// What a backend says of a blob without reading it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stat {
    /// Its length.
    pub bytes: u64,
    /// When it was last put, in milliseconds since 1970.
    pub put_ms: i64,
    /// Another text after every change of the bytes, in one line.
    pub stamp: String,
}

/// Why a place gives no answers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Since when, in milliseconds since 1970.
    pub since_ms: i64,
    /// What happens instead, in words.
    pub what: String,
}

/// Where bytes lie. Calls block, and may come from many threads; one digest may be put by two of them at once.
pub trait Backend: Send + Sync + fmt::Debug {
    /// A place for a blob of `bytes` bytes to arrive at.
    fn stage(&self, bytes: u64) -> Result<Box<dyn Staged>, BlobError>;
    /// The bytes as they lie there from byte `from` on, unverified.
    fn read(&self, digest: Digest, from: u64) -> Result<Box<dyn Read + Send>, BlobError>;
    /// What is known without reading it, if it is there.
    fn stat(&self, digest: Digest) -> Result<Option<Stat>, BlobError>;
    /// Marks a blob that is there as put just now, and makes sure that it would survive a loss of power.
    fn touch(&self, digest: Digest) -> Result<Stat, BlobError>;
    /// Removes it; it need not be there.
    fn remove(&self, digest: Digest) -> Result<(), BlobError>;
    /// Takes away its name but keeps the bytes for somebody to look at; it need not be there.
    fn put_aside(&self, digest: Digest) -> Result<(), BlobError>;
    /// All blobs, in no particular order. What else lies there is left out.
    fn list(&self) -> Result<Vec<Entry>, BlobError>;
    /// Whether there is no blob.
    fn is_empty(&self) -> Result<bool, BlobError>;
    /// What lies among the blobs and is not the store's.
    fn strays(&self) -> Result<Vec<String>, BlobError>;
    /// What was put aside.
    fn aside(&self) -> Result<Vec<String>, BlobError>;
    /// Where the marker lies, in words.
    fn marker_place(&self) -> String;
    /// The marker, a text of one line that stands beside the blobs and says whose they are.
    fn marker(&self) -> Result<Option<String>, BlobError>;
    /// Puts a marker in the place of `old`, `None` for none; `false`, and nothing is changed, if there is not `old`. Of two that
    /// try this at once one is told `false`.
    fn set_marker(&self, old: Option<&str>, marker: &str) -> Result<bool, BlobError>;

    /// Why it gives no answers now, as far as the last calls have shown.
    fn problem(&self) -> Option<Problem> {
        None
    }

    /// As [`stage`](Self::stage), in place of what is staged under a name of 64 hexadecimal digits. A backend that can keeps what has
    /// arrived when it is dropped, and when the process ends.
    fn stage_as(&self, name: &str, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let _ = name;
        self.stage(bytes)
    }
    /// Goes on with what is staged under a name, if there is something, and gives what has arrived to `read`.
    fn staged_as(&self, name: &str, read: &mut dyn FnMut(&[u8])) -> Result<Option<Box<dyn Staged>>, BlobError> {
        let _ = (name, read);
        Ok(None)
    }
    /// Forgets what is staged under a name, if there is something.
    fn unstage(&self, name: &str) -> Result<(), BlobError> {
        let _ = name;
        Ok(())
    }
    /// Forgets what is staged under other names than these.
    fn unstage_but(&self, names: &BTreeSet<String>) -> Result<(), BlobError> {
        let _ = names;
        Ok(())
    }
}

/// A blob on its way into a [`Backend`]. It is gone if it is dropped.
pub trait Staged: Send + fmt::Debug {
    /// Appends bytes.
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError>;
    /// Gives it its name; returns once it would survive a loss of power. `false`, and nothing is changed, if a blob has that
    /// name already. Never shows a part of it under the name.
    fn commit(self: Box<Self>, digest: Digest) -> Result<bool, BlobError>;
}
