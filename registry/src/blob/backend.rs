//! Interface of a place that stores bytes.

use std::collections::BTreeSet;
use std::fmt;
use std::io::Read;

use checkpoint::BlobError;
use protocol::Digest;
use protocol::proof::SignedRequest;

/// A blob in a listing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry {
    pub digest: Digest,
    /// Length in bytes.
    pub bytes: u64,
    /// Time of the last put, in milliseconds since 1970.
    pub put_ms: i64,
}

/// Metadata of a blob, known without reading it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stat {
    /// Length in bytes.
    pub bytes: u64,
    /// Time of the last put, in milliseconds since 1970.
    pub put_ms: i64,
    /// One line of text that differs after every change of the bytes.
    pub stamp: String,
}

/// A reason why a place does not answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Start of the problem, in milliseconds since 1970.
    pub since_ms: i64,
    /// Description of the failure.
    pub what: String,
}

/// A place for bytes. Calls block and may come from many threads; two threads may put one digest at the same time.
pub trait Backend: Send + Sync + fmt::Debug {
    /// Opens a staging area for a blob of `bytes` bytes.
    fn stage(&self, bytes: u64) -> Result<Box<dyn Staged>, BlobError>;
    /// Reads the stored bytes from byte `from` on, unverified.
    fn read(&self, digest: Digest, from: u64) -> Result<Box<dyn Read + Send>, BlobError>;
    /// Returns the metadata of a blob, or `None` if it does not exist.
    fn stat(&self, digest: Digest) -> Result<Option<Stat>, BlobError>;
    /// Sets the put time of an existing blob to now and makes the blob durable.
    fn touch(&self, digest: Digest) -> Result<Stat, BlobError>;
    /// Removes a blob if it exists.
    fn remove(&self, digest: Digest) -> Result<(), BlobError>;
    /// Moves a blob, if it exists, out of its name and keeps the bytes for inspection.
    fn put_aside(&self, digest: Digest) -> Result<(), BlobError>;
    /// Lists all blobs in no particular order. Leaves out other files.
    fn list(&self) -> Result<Vec<Entry>, BlobError>;
    /// Returns true if there is no blob.
    fn is_empty(&self) -> Result<bool, BlobError>;
    /// Lists files among the blobs that do not belong to the store.
    fn strays(&self) -> Result<Vec<String>, BlobError>;
    /// Lists the blobs that were put aside.
    fn aside(&self) -> Result<Vec<String>, BlobError>;
    /// Describes uploads in parts that have not ended and belong to no call of this process.
    fn unfinished(&self) -> Result<Vec<String>, BlobError> {
        Ok(Vec::new())
    }
    /// Ends the uploads that [`Self::unfinished`] lists, deletes their parts and returns their number. Only for the
    /// holder of the blobs.
    fn give_up_unfinished(&self) -> Result<u64, BlobError> {
        Ok(0)
    }
    /// Describes the marker's location for messages.
    fn marker_place(&self) -> String;
    /// Reads the marker: a line of text beside the blobs that names the store they belong to.
    fn marker(&self) -> Result<Option<String>, BlobError>;
    /// Replaces the marker if it equals `old`, where `None` means no marker. Otherwise returns `false` and changes
    /// nothing. If two callers try at once, one gets `false`.
    fn set_marker(&self, old: Option<&str>, marker: &str) -> Result<bool, BlobError>;

    /// Returns the current problem of the place, as seen in the last calls.
    fn problem(&self) -> Option<Problem> {
        None
    }

    /// Signs a request that reads a blob from the place. `None` if the place takes no signed requests.
    fn sign_read(&self, digest: Digest) -> Option<SignedRequest> {
        let _ = digest;
        None
    }
    /// Signs a request that stores a blob under a name of 64 hexadecimal digits beside the blobs, unless that is taken. The
    /// place refuses bytes that do not hash to `digest`. `None` if the place takes no such requests.
    fn sign_write(&self, name: &str, digest: Digest) -> Option<SignedRequest> {
        let _ = (name, digest);
        None
    }
    /// Returns true if a signed request has stored a blob under `name`, and the place attests that it hashes to `digest`.
    fn has_arrived(&self, name: &str, digest: Digest) -> bool {
        let _ = (name, digest);
        false
    }
    /// Gives a blob that has arrived the name of its digest, without reading it here.
    fn settle(&self, name: &str, digest: Digest) -> Result<Stat, BlobError> {
        let _ = name;
        Err(BlobError::NotFound(digest))
    }
    /// Deletes a blob that has arrived, if it exists.
    fn forget_arrived(&self, name: &str) -> Result<(), BlobError> {
        let _ = name;
        Ok(())
    }

    /// Opens a staging area under a name of 64 hexadecimal digits and replaces an older one of that name. A backend
    /// that can keeps the bytes when the value is dropped or the process ends.
    fn stage_as(&self, name: &str, bytes: u64) -> Result<Box<dyn Staged>, BlobError> {
        let _ = name;
        self.stage(bytes)
    }
    /// Continues the staged bytes of a name, if there are any, and passes the arrived bytes to `read`.
    fn staged_as(&self, name: &str, read: &mut dyn FnMut(&[u8])) -> Result<Option<Box<dyn Staged>>, BlobError> {
        let _ = (name, read);
        Ok(None)
    }
    /// Deletes the staged bytes of a name, if there are any.
    fn unstage(&self, name: &str) -> Result<(), BlobError> {
        let _ = name;
        Ok(())
    }
    /// Deletes all named staged bytes except those of `names`.
    fn unstage_but(&self, names: &BTreeSet<String>) -> Result<(), BlobError> {
        let _ = names;
        Ok(())
    }
}

/// A blob being written to a [`Backend`]. Dropping it deletes the bytes.
pub trait Staged: Send + fmt::Debug {
    /// Appends bytes to the unnamed blob.
    fn write(&mut self, bytes: &[u8]) -> Result<(), BlobError>;
    /// Gives the blob its name and returns when it is durable. Returns `false` and changes nothing if the name is
    /// taken. The name never shows part of a blob.
    fn commit(self: Box<Self>, digest: Digest) -> Result<bool, BlobError>;
}
