//! Reads files of folders with untrusted content.
//!
//! A path there may be a named pipe, which would block forever, a device, a folder, or a far larger file than expected.
//! So a file is checked before it is opened, opened without blocking, checked again, and read up to a limit.

use std::fs::{self, File, FileType, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use protocol::{Digest, limits};
use sha2::{Digest as _, Sha256};

/// Opens a regular file, or the target of a symbolic link to one. Returns the file and its length.
///
/// # Errors
/// If the path is something else; the message says what, without the path.
pub fn open(path: &Path) -> io::Result<(File, u64)> {
    expect_file(fs::metadata(path)?.file_type())?;
    // The path may have been replaced in between.
    let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(path)?;
    let found = file.metadata()?;
    expect_file(found.file_type())?;
    Ok((file, found.len()))
}

/// Reads a regular file of at most `limit` bytes.
///
/// # Errors
/// If the path is something else, or the file is too large; the message says what, without the path.
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let (file, length) = open(path)?;
    let mut bytes = Vec::with_capacity(usize::try_from(length.min(limit)).unwrap_or_default());
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(io::Error::new(
            io::ErrorKind::FileTooLarge,
            format!("has more than {limit} bytes; no more are read"),
        ));
    }
    Ok(bytes)
}

/// Digest of a regular file's content.
///
/// # Errors
/// If the path is something else; the message says what, without the path.
pub fn digest(path: &Path) -> io::Result<Digest> {
    let (mut file, _) = open(path)?;
    let mut hasher = Sha256::new();
    let mut part = vec![0; 256 << 10];
    loop {
        match file.read(&mut part)? {
            0 => return Ok(Digest::from_bytes(hasher.finalize().into())),
            count => hasher.update(&part[..count]),
        }
    }
}

fn expect_file(found: FileType) -> io::Result<()> {
    let what = match found {
        found if found.is_file() => return Ok(()),
        found if found.is_dir() => "a folder",
        found if found.is_fifo() => "a named pipe",
        found if found.is_socket() => "a socket",
        found if found.is_char_device() || found.is_block_device() => "a device",
        _ => "no regular file",
    };
    Err(io::Error::new(io::ErrorKind::InvalidInput, format!("is {what}; expected a file")))
}

/// Lists the files in `root` and below it, sorted. Symbolic links are followed. Anything else than a file or folder is
/// an error. So is a folder that appears twice: a cycle of links never ends, and a fan of them multiplies the files.
///
/// # Errors
/// The obstacle, with its path.
pub fn tree(root: &Path) -> io::Result<Vec<PathBuf>> {
    let named = |path: &Path, error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
    let refuse = |path: &Path, what: String| {
        Err(io::Error::new(io::ErrorKind::InvalidInput, format!("{}: {what}", path.display())))
    };
    let mut folders = vec![(root.to_owned(), 0)];
    let mut met = std::collections::HashSet::new();
    let mut files = Vec::new();
    while let Some((folder, depth)) = folders.pop() {
        let found = fs::metadata(&folder).map_err(|error| named(&folder, error))?;
        if !met.insert((found.dev(), found.ino())) {
            return refuse(&folder, "leads to a folder that was read already; remove the symbolic link".into());
        }
        if depth > limits::FOLDER_DEPTH {
            return refuse(&folder, format!("folders are nested more than {} deep", limits::FOLDER_DEPTH));
        }
        for entry in fs::read_dir(&folder).map_err(|error| named(&folder, error))? {
            let path = entry.map_err(|error| named(&folder, error))?.path();
            let found = fs::metadata(&path).map_err(|error| named(&path, error))?;
            if found.is_dir() {
                folders.push((path, depth + 1));
            } else {
                expect_file(found.file_type()).map_err(|error| named(&path, error))?;
                files.push(path);
            }
            if files.len() + folders.len() > limits::FOLDER_FILES {
                return refuse(root, format!("has more than {} files", limits::FOLDER_FILES));
            }
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;
    use std::process::Command;

    use super::*;

    fn fifo(path: &Path) {
        let made = Command::new("mkfifo").arg(path).status().expect("mkfifo runs");
        assert!(made.success());
    }

    #[test]
    fn what_is_no_file_is_named_and_never_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fifo(&at("pipe"));
        fs::create_dir(at("folder.npy")).unwrap();
        let _socket = UnixListener::bind(at("socket")).unwrap();
        symlink(at("pipe"), at("link")).unwrap();
        symlink(at("loop"), at("loop")).unwrap();
        symlink("/dev/zero", at("zero")).unwrap();
        for (name, part) in [
            ("pipe", "is a named pipe; expected a file"),
            ("link", "is a named pipe"),
            ("folder.npy", "is a folder"),
            ("socket", "is a socket"),
            ("zero", "is a device"),
            ("loop", "symbolic link"),
        ] {
            for said in [read(&at(name), 10).unwrap_err(), digest(&at(name)).unwrap_err()] {
                assert!(said.to_string().contains(part), "{name}: {said}");
            }
        }
        fs::write(at("file"), b"0123456789").unwrap();
        symlink(at("file"), at("to a file")).unwrap();
        assert_eq!(read(&at("to a file"), 10).unwrap(), b"0123456789");
        assert!(read(&at("file"), 9).unwrap_err().to_string().contains("more than 9 bytes"));
        assert_eq!(digest(&at("file")).unwrap(), Digest::of(b"0123456789"));
        assert_eq!(read(&at("none"), 9).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn a_tree_of_links_ends() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir_all(at("a/b")).unwrap();
        fs::write(at("a/b/file"), b"x").unwrap();
        symlink(at("a/b/file"), at("linked file")).unwrap();
        assert_eq!(tree(folder.path()).unwrap(), [at("a/b/file"), at("linked file")]);
        // A cycle, and a fan that doubles at each level.
        symlink(folder.path(), at("a/b/up")).unwrap();
        let said = tree(folder.path()).unwrap_err().to_string();
        assert!(said.contains("up") && said.contains("was read already"), "{said}");
        fs::remove_file(at("a/b/up")).unwrap();
        for i in 0..30 {
            fs::create_dir(at(&format!("f{i}"))).unwrap();
            for side in ["l", "r"] {
                symlink(at(&format!("f{}", i + 1)), at(&format!("f{i}/{side}"))).unwrap();
            }
        }
        fs::create_dir(at("f30")).unwrap();
        assert!(tree(&at("f0")).unwrap_err().to_string().contains("was read already"));
        fifo(&at("a/pipe"));
        let said = tree(&at("a")).unwrap_err().to_string();
        assert!(said.contains("a/pipe: is a named pipe"), "{said}");
    }
}
