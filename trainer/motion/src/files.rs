//! Opens files of folders with untrusted content.
//!
//! A [`DataPath`] is a path together with the permission to open it. A user's own commands may open any path
//! ([`DataPath::local`]). A worker whose pipelines come from other users may open paths below a [`Root`] only. Parsers of
//! such files take a `DataPath` and open files through it.
//!
//! A path there may be a named pipe, which would block forever, a device, a folder, or a far larger file than expected.
//! So a file is checked before it is opened, opened without blocking, checked again, and read up to a limit.

use std::ffi::OsString;
use std::fs::{self, File, FileType, Metadata, OpenOptions};
use std::io::{self, Read};
use std::os::fd::AsRawFd as _;
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{self, Path, PathBuf};
use std::sync::Arc;

use protocol::digest::Hasher;
use protocol::{Digest, excerpt, limits};

use crate::roots::Root;

/// A file or folder, and what may be opened to reach it.
#[derive(Debug, Clone)]
pub struct DataPath {
    /// The path to open; relative to the root, if there is one.
    path: PathBuf,
    /// As messages name it.
    shown: PathBuf,
    /// The folder that it must not leave.
    root: Option<Arc<Root>>,
}

impl DataPath {
    /// A path that may lead anywhere.
    pub fn local(path: impl Into<PathBuf>) -> Self {
        let path = path.into();
        Self { shown: path.clone(), path, root: None }
    }

    /// A path below `root`; messages name it `shown`.
    pub(crate) fn beneath(root: Arc<Root>, path: PathBuf, shown: PathBuf) -> Self {
        Self { path, shown, root: Some(root) }
    }

    /// The path as it was named, for messages and file name extensions. Only this type opens it.
    pub fn shown(&self) -> &Path {
        &self.shown
    }

    /// [`shown`](Self::shown), for messages.
    pub fn display(&self) -> path::Display<'_> {
        self.shown.display()
    }

    /// A path in this folder.
    #[must_use]
    pub fn join(&self, name: impl AsRef<Path>) -> Self {
        let name = name.as_ref();
        Self { path: self.path.join(name), shown: self.shown.join(name), root: self.root.clone() }
    }

    /// A path in this folder that a file names: messages show it as an excerpt of that file.
    #[must_use]
    pub fn join_quoted(&self, name: &str) -> Self {
        Self { shown: self.shown.join(excerpt(name)), ..self.join(name) }
    }

    /// The same with another ending.
    #[must_use]
    pub fn with_extension(&self, ending: &str) -> Self {
        let shown = self.shown.with_extension(ending);
        Self { path: self.path.with_extension(ending), shown, root: self.root.clone() }
    }

    /// Opens a regular file, or what a symbolic link to one leads to. Gives its length too.
    ///
    /// # Errors
    /// If the path is something else; the message says what, without the path.
    pub fn open(&self) -> io::Result<(File, u64)> {
        let (file, found) = self.open_with_metadata()?;
        Ok((file, found.len()))
    }

    fn open_with_metadata(&self) -> io::Result<(File, Metadata)> {
        expect_file(self.metadata()?.file_type())?;
        // It may have become something else in between.
        let file = match &self.root {
            Some(root) => root.read(&self.path)?,
            None => OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(&self.path)?,
        };
        let found = file.metadata()?;
        expect_file(found.file_type())?;
        Ok((file, found))
    }

    /// Reads a regular file of at most `limit` bytes.
    ///
    /// # Errors
    /// If the path is something else, or the file is too large; the message says what, without the path.
    pub fn read(&self, limit: u64) -> io::Result<Vec<u8>> {
        let (file, length) = self.open()?;
        let mut bytes = Vec::with_capacity(usize::try_from(length.min(limit)).unwrap_or_default());
        file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
        if bytes.len() as u64 > limit {
            return Err(io::Error::new(
                io::ErrorKind::FileTooLarge,
                format!("has more than {limit} bytes, the largest supported size"),
            ));
        }
        Ok(bytes)
    }

    /// The digest of a regular file's content, and the stamp that it had when it was opened.
    ///
    /// # Errors
    /// If the path is something else; the message says what, without the path. [`io::ErrorKind::Interrupted`] once
    /// `go_on` returns false.
    pub(crate) fn digest(&self, go_on: &dyn Fn() -> bool) -> io::Result<(Digest, Stamp)> {
        let (mut file, found) = self.open_with_metadata()?;
        let mut hasher = Hasher::default();
        let mut part = vec![0; 256 << 10];
        loop {
            if !go_on() {
                return Err(io::ErrorKind::Interrupted.into());
            }
            match file.read(&mut part)? {
                0 => return Ok((hasher.finish(), Stamp::of(&found))),
                count => hasher.update(&part[..count]),
            }
        }
    }

    /// The stamp of a regular file.
    pub(crate) fn stamp(&self) -> io::Result<Stamp> {
        let found = self.metadata()?;
        expect_file(found.file_type())?;
        Ok(Stamp::of(&found))
    }

    /// A regular file under a path that any reader can open and that leads nowhere else.
    ///
    /// # Errors
    /// If the path is something else; the message says what, without the path.
    pub fn hold(&self) -> io::Result<HeldFile> {
        let (file, _) = self.open()?;
        let path = match &self.root {
            Some(_) => PathBuf::from(format!("/proc/self/fd/{}", file.as_raw_fd())),
            None => self.path.clone(),
        };
        Ok(HeldFile { path, file })
    }

    fn metadata(&self) -> io::Result<Metadata> {
        match &self.root {
            Some(root) => root.locate(&self.path)?.metadata(),
            None => fs::metadata(&self.path),
        }
    }

    /// True for a folder and for a symbolic link to one.
    pub fn is_folder(&self) -> bool {
        self.metadata().is_ok_and(|found| found.is_dir())
    }

    /// True if its metadata can be read.
    pub fn exists(&self) -> bool {
        self.metadata().is_ok()
    }

    /// True if there is an entry of that name, which may be a dangling link.
    pub fn has_entry(&self) -> bool {
        match &self.root {
            // A link that leads out of the root exists; opening it reports the error.
            Some(root) => !matches!(root.locate(&self.path), Err(e) if e.kind() == io::ErrorKind::NotFound),
            None => self.path.symlink_metadata().is_ok(),
        }
    }

    /// The names in a folder, sorted.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn names(&self) -> io::Result<Vec<OsString>> {
        let mut names = match &self.root {
            Some(root) => root.names(&self.path)?,
            None => {
                fs::read_dir(&self.path)?.map(|entry| Ok(entry?.file_name())).collect::<io::Result<Vec<OsString>>>()?
            }
        };
        names.sort();
        Ok(names)
    }

    /// The files in this folder and below it, sorted. Follows symbolic links. Other file types, and folders met twice (link
    /// cycles), are errors.
    ///
    /// # Errors
    /// The first path that cannot be read, with the cause.
    pub fn tree(&self) -> io::Result<Vec<Self>> {
        let named =
            |path: &Self, error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
        let refuse = |path: &Self, what: String| {
            Err(io::Error::new(io::ErrorKind::InvalidInput, format!("{}: {what}", path.display())))
        };
        let mut folders = vec![(self.clone(), 0)];
        let mut met = std::collections::HashSet::new();
        let mut files = Vec::new();
        while let Some((folder, depth)) = folders.pop() {
            let found = folder.metadata().map_err(|error| named(&folder, error))?;
            if !met.insert((found.dev(), found.ino())) {
                return refuse(&folder, "is a symbolic link to a folder that was already read; remove the link".into());
            }
            if depth > limits::FOLDER_DEPTH {
                return refuse(&folder, format!("folders are nested more than {} deep", limits::FOLDER_DEPTH));
            }
            for name in folder.names().map_err(|error| named(&folder, error))? {
                let path = folder.join(name);
                let found = path.metadata().map_err(|error| named(&path, error))?;
                if found.is_dir() {
                    folders.push((path, depth + 1));
                } else {
                    expect_file(found.file_type()).map_err(|error| named(&path, error))?;
                    files.push(path);
                }
                if files.len() + folders.len() > limits::FOLDER_FILES {
                    return refuse(self, format!("has more than {} files", limits::FOLDER_FILES));
                }
            }
        }
        files.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(files)
    }
}

/// An open file for readers that take a path. The path is valid for as long as this value lives.
#[derive(Debug)]
pub struct HeldFile {
    path: PathBuf,
    /// Keeps the path valid.
    file: File,
}

impl HeldFile {
    /// The path to read it by.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file itself.
    pub fn file(&self) -> &File {
        &self.file
    }
}

/// A file's metadata that changes with its content: device, inode, length, and the times of the last write and of the last change to the inode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stamp {
    device: u64,
    inode: u64,
    bytes: u64,
    written: (i64, i64),
    changed: (i64, i64),
}

impl Stamp {
    fn of(found: &Metadata) -> Self {
        Self {
            device: found.dev(),
            inode: found.ino(),
            bytes: found.len(),
            written: (found.mtime(), found.mtime_nsec()),
            changed: (found.ctime(), found.ctime_nsec()),
        }
    }

    /// The file's identity: device and inode.
    pub(crate) fn file(&self) -> (u64, u64) {
        (self.device, self.inode)
    }

    /// True if the last change lies at least `seconds` before `now`, in seconds since 1970. Clocks of file systems tick slowly: a file that
    /// was just changed may change again and keep its stamp.
    pub(crate) fn is_older(&self, seconds: i64, now: i64) -> bool {
        self.changed.0.saturating_add(seconds) < now
    }
}

fn expect_file(found: FileType) -> io::Result<()> {
    let what = match found {
        found if found.is_file() => return Ok(()),
        found if found.is_dir() => "a folder",
        found if found.is_fifo() => "a named pipe",
        found if found.is_socket() => "a socket",
        found if found.is_char_device() || found.is_block_device() => "a device",
        _ => "not a regular file",
    };
    Err(io::Error::new(io::ErrorKind::InvalidInput, format!("is {what}; expected a file")))
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
        let path = |name: &str| DataPath::local(at(name));
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
            for said in [path(name).read(10).unwrap_err(), path(name).digest(&|| true).unwrap_err()] {
                assert!(said.to_string().contains(part), "{name}: {said}");
            }
        }
        fs::write(at("file"), b"0123456789").unwrap();
        symlink(at("file"), at("to a file")).unwrap();
        assert_eq!(path("to a file").read(10).unwrap(), b"0123456789");
        assert!(path("file").read(9).unwrap_err().to_string().contains("more than 9 bytes"));
        assert_eq!(path("file").digest(&|| true).unwrap().0, Digest::of(b"0123456789"));
        assert_eq!(path("none").read(9).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn a_tree_of_links_ends() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir_all(at("a/b")).unwrap();
        fs::write(at("a/b/file"), b"x").unwrap();
        symlink(at("a/b/file"), at("linked file")).unwrap();
        let tree = |path: PathBuf| DataPath::local(path).tree();
        let found: Vec<PathBuf> = tree(at("")).unwrap().into_iter().map(|file| file.shown).collect();
        assert_eq!(found, [at("a/b/file"), at("linked file")]);
        // A cycle, and a fan that doubles at each level.
        symlink(folder.path(), at("a/b/up")).unwrap();
        let said = tree(at("")).unwrap_err().to_string();
        assert!(said.contains("up") && said.contains("was already read"), "{said}");
        fs::remove_file(at("a/b/up")).unwrap();
        for i in 0..30 {
            fs::create_dir(at(&format!("f{i}"))).unwrap();
            for side in ["l", "r"] {
                symlink(at(&format!("f{}", i + 1)), at(&format!("f{i}/{side}"))).unwrap();
            }
        }
        fs::create_dir(at("f30")).unwrap();
        assert!(tree(at("f0")).unwrap_err().to_string().contains("was already read"));
        fifo(&at("a/pipe"));
        let said = tree(at("a")).unwrap_err().to_string();
        assert!(said.contains("a/pipe: is a named pipe"), "{said}");
    }
}
