//! Local authentication: a token in the store's folder that only the store's user can read. Every start of the holder
//! makes a new token.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use crate::file::read_regular;
use crate::secret::Token;

/// Limit of the file, which contains one token.
const FILE_BYTES: u64 = 4096;

fn path(dir: &Path) -> PathBuf {
    dir.join("token")
}

/// The published token file, removed on drop. Drop it before the store's lock, so that the next holder's file is not
/// removed.
#[derive(Debug)]
pub struct Published {
    path: PathBuf,
}

/// Writes `token` to the folder of the store that this process holds.
pub fn publish(dir: &Path, token: &Token) -> io::Result<Published> {
    let path = path(dir);
    let fresh = dir.join(format!("token.{}", std::process::id()));
    let _ = fs::remove_file(&fresh);
    // `create_new` guarantees our owner and mode, even if another file had this name before.
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&fresh)?;
    file.write_all(token.secret().as_bytes())?;
    fs::rename(&fresh, &path)?;
    Ok(Published { path })
}

impl Drop for Published {
    fn drop(&mut self) {
        // A file left behind is harmless: its token is invalid and the next holder replaces it.
        let _ = fs::remove_file(&self.path);
    }
}

/// Reads the token of the process that holds the store in `dir`; `None` if there is no file.
pub fn read(dir: &Path) -> io::Result<Option<Token>> {
    match read_regular(&path(dir), FILE_BYTES).map(|bytes| String::from_utf8_lossy(&bytes).into_owned()) {
        Ok(text) => text.parse().map(Some).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn the_file_is_its_users_alone_and_goes_with_its_holder() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(read(dir.path()).unwrap(), None);
        fs::write(path(dir.path()), "left by one that was killed").unwrap();
        fs::set_permissions(path(dir.path()), fs::Permissions::from_mode(0o644)).unwrap();
        let token = Token::random();
        let published = publish(dir.path(), &token).unwrap();
        assert_eq!(read(dir.path()).unwrap(), Some(token));
        assert_eq!(fs::metadata(path(dir.path())).unwrap().permissions().mode() & 0o777, 0o600);
        drop(published);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
