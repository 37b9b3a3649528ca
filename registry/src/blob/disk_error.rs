//! Translation of failed file system calls on blobs into messages with a remedy.

use std::io::{self, ErrorKind};
use std::path::Path;

use checkpoint::BlobError;

/// Returns true if the disk is full or a quota is used up.
pub(crate) fn is_full(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge)
}

/// Returns true if the user has no write permission.
pub(crate) fn is_read_only(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem)
}

pub(super) fn error(did: &str, path: &Path, e: &io::Error) -> BlobError {
    let path = path.display();
    if is_full(e) {
        BlobError::Storage(format!(
            "failed to {did} `{path}`: the disk is full or a quota is used up ({e}); `registry gc` removes \
             unneeded blobs, even on a full disk; then run the same command again"
        ))
    } else if is_read_only(e) {
        BlobError::Storage(format!(
            "failed to {did} `{path}`: not writable ({e}); make it writable or choose another folder with `--store`"
        ))
    } else {
        BlobError::Unavailable(format!("failed to {did} `{path}`: {e}"))
    }
}
