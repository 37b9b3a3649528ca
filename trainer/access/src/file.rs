//! Reading of files with secrets and settings; only regular files are read.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use nix::fcntl::OFlag;

/// Opens a regular file for reading. A pipe, a device or a folder is an error at once: opening a pipe would wait for its writer.
/// Symbolic links are followed, because Kubernetes mounts secrets as links.
pub fn open_regular(path: &Path) -> io::Result<File> {
    let file = OpenOptions::new().read(true).custom_flags(OFlag::O_NONBLOCK.bits()).open(path)?;
    if file.metadata()?.is_file() {
        return Ok(file);
    }
    Err(io::Error::new(
        io::ErrorKind::InvalidInput,
        "is not a regular file; expected a file, not a folder, pipe or device",
    ))
}

/// Reads a regular file of at most `limit` bytes.
pub fn read_regular(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_regular(path)?.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            format!("has more than {limit} bytes; check that it is the right file"),
        ));
    }
    Ok(bytes)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use nix::sys::stat::Mode;

    use super::*;
    use crate::{Token, Tokens};

    #[test]
    fn a_pipe_in_the_place_of_a_secret_is_refused_and_does_not_block() {
        let dir = tempfile::tempdir().unwrap();
        let pipe = dir.path().join("token");
        nix::unistd::mkfifo(&pipe, Mode::from_bits_truncate(0o600)).unwrap();
        // Without the refusal each of these would wait for a writer that never comes.
        let errors = [
            Token::from_file(&pipe).unwrap_err().to_string(),
            Tokens::read(&pipe).unwrap_err().to_string(),
            crate::tls::ServerTls::read(&pipe, &pipe).unwrap_err().to_string(),
            crate::tls::pinned(&pipe).unwrap_err().to_string(),
            crate::local::read(dir.path()).unwrap_err().to_string(),
        ];
        for error in errors {
            assert!(error.contains("not a regular file"), "{error}");
        }
        assert!(open_regular(dir.path()).is_err(), "a folder");
        std::fs::write(dir.path().join("file"), "12345").unwrap();
        std::os::unix::fs::symlink("file", dir.path().join("link")).unwrap();
        assert_eq!(read_regular(&dir.path().join("link"), 5).unwrap(), b"12345");
        assert!(read_regular(&dir.path().join("link"), 4).is_err());
    }
}
