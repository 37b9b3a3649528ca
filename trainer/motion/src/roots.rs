//! A folder that file access is confined to.
//!
//! Every open is one `openat2` with `RESOLVE_BENEATH`: the kernel follows each part of the path, links included, and refuses to leave the
//! folder. Nothing is checked first and opened later, so a link that is swapped in between leads nowhere else. Links with absolute targets
//! are refused, also if they lead back into the folder. A mount below the folder belongs to it.

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use nix::dir::Dir;
use nix::errno::Errno;
use nix::fcntl::{OFlag, OpenHow, ResolveFlag, open, openat2};
use nix::sys::stat::Mode;

/// Tries of an open that the kernel could not finish because something was renamed meanwhile.
const TRIES: usize = 64;

/// An open folder; later changes of its path do not affect it.
#[derive(Debug)]
pub struct Root {
    /// As it was given, absolute.
    path: PathBuf,
    /// The path with all links resolved.
    canonical: PathBuf,
    folder: OwnedFd,
}

impl Root {
    /// Opens the folder `path`.
    ///
    /// # Errors
    /// If it is no folder or cannot be opened, or the kernel has no `openat2` (Linux before 5.6).
    pub fn open(path: &Path) -> io::Result<Self> {
        let canonical = std::fs::canonicalize(path)?;
        let folder = open(&canonical, OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_CLOEXEC, Mode::empty())?;
        let root = Self { path: std::path::absolute(path)?, canonical, folder };
        root.beneath(Path::new("."), OFlag::O_PATH)?;
        Ok(root)
    }

    /// As it was given.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The part of an absolute `path` below this folder; none if it begins elsewhere.
    pub(crate) fn relative(&self, path: &Path) -> Option<PathBuf> {
        let below = path.strip_prefix(&self.path).or_else(|_| path.strip_prefix(&self.canonical)).ok()?;
        Some(if below.as_os_str().is_empty() { PathBuf::from(".") } else { below.to_owned() })
    }

    /// The file or folder `path`, without reading it: enough to look at its metadata.
    pub(crate) fn locate(&self, path: &Path) -> io::Result<File> {
        self.beneath(path, OFlag::O_PATH).map(File::from)
    }

    /// The file `path` for reading, without waiting for the writer of a pipe.
    pub(crate) fn read(&self, path: &Path) -> io::Result<File> {
        self.beneath(path, OFlag::O_RDONLY | OFlag::O_NONBLOCK | OFlag::O_NOCTTY).map(File::from)
    }

    /// The names in the folder `path`.
    pub(crate) fn names(&self, path: &Path) -> io::Result<Vec<std::ffi::OsString>> {
        use std::os::unix::ffi::OsStrExt as _;
        let folder = self.beneath(path, OFlag::O_RDONLY | OFlag::O_DIRECTORY)?;
        let mut names = Vec::new();
        for entry in Dir::from_fd(folder)?.iter() {
            let entry = entry?;
            let name = std::ffi::OsStr::from_bytes(entry.file_name().to_bytes());
            if name != "." && name != ".." {
                names.push(name.to_owned());
            }
        }
        Ok(names)
    }

    fn beneath(&self, path: &Path, flags: OFlag) -> io::Result<OwnedFd> {
        let resolve = ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_MAGICLINKS;
        let how = OpenHow::new().flags(flags | OFlag::O_CLOEXEC).resolve(resolve);
        for _ in 0..TRIES {
            match openat2(&self.folder, path, how) {
                Err(Errno::EAGAIN) => {}
                Err(Errno::EXDEV) => {
                    let what = format!("is outside the data root `{}`", self.path.display());
                    return Err(io::Error::new(io::ErrorKind::PermissionDenied, what));
                }
                done => return done.map_err(io::Error::from),
            }
        }
        Err(io::Error::new(io::ErrorKind::ResourceBusy, "was renamed repeatedly while it was opened"))
    }
}
