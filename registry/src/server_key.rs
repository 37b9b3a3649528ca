//! The key with which a store's server recognises secrets of grants and receipts of uploads that it issued.
//!
//! The key is in the file `server-key` of the store's folder, which only the store's user can read. Backups leave it
//! out, so a server on an older copy of the store accepts nothing that the newer one issued.

use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use crate::blob::disk::{regular, sync_dir};

/// Name of the file in the store's folder.
pub(crate) const FILE: &str = "server-key";

/// A key of a server.
pub type ServerKey = [u8; 32];

/// Reads the key of the folder `dir`, or creates one. The caller must hold the store's lock.
pub(crate) fn read_or_make(dir: &Path) -> io::Result<ServerKey> {
    let path = dir.join(FILE);
    match regular(OpenOptions::new().read(true), &path) {
        Ok(file) => {
            let mut bytes = Vec::new();
            file.take(33).read_to_end(&mut bytes)?;
            bytes.try_into().map_err(|_| {
                let message = format!(
                    "`{}` is not a key of 32 bytes; remove it, and the server creates a new one",
                    path.display()
                );
                io::Error::new(ErrorKind::InvalidData, message)
            })
        }
        Err(error) if error.kind() == ErrorKind::NotFound => make(dir, &path),
        Err(error) => Err(error),
    }
}

/// Draws a key.
pub(crate) fn random() -> io::Result<ServerKey> {
    let mut key = ServerKey::default();
    getrandom::fill(&mut key).map_err(io::Error::other)?;
    Ok(key)
}

fn make(dir: &Path, path: &Path) -> io::Result<ServerKey> {
    let key = random()?;
    let fresh = path.with_extension("new");
    // Left by an interrupted start.
    let _ = fs::remove_file(&fresh);
    let mut file = regular(OpenOptions::new().write(true).create_new(true).mode(0o600), &fresh)?;
    file.write_all(&key)?;
    file.sync_all()?;
    fs::rename(&fresh, path)?;
    sync_dir(dir)?;
    Ok(key)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_key_is_made_once_for_its_user_alone() {
        let dir = tempfile::tempdir().unwrap();
        let key = read_or_make(dir.path()).unwrap();
        assert_eq!(read_or_make(dir.path()).unwrap(), key);
        assert_ne!(read_or_make(tempfile::tempdir().unwrap().path()).unwrap(), key);
        let path = dir.path().join(FILE);
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        fs::write(&path, b"short").unwrap();
        assert!(read_or_make(dir.path()).unwrap_err().to_string().contains("not a key of 32 bytes"));
    }
}
