//! Access to files outside the store: below data roots alone, and only with the digest in the stage's key.
//!
//! A path of a pipeline becomes a [`DataPath`] here and nowhere else. A worker of a server opens it beneath one of its data roots; one that was
//! started by its own user opens it wherever it leads. Its content is digested before it is read and must be what the stage expects: the
//! expectation is part of the stage's key, and comes from the submitter. After reading, content and stamps are compared again, so what was
//! read is what was digested. A user who can write below a data root could still exchange a folder for another and back between the two.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::Digest;
use protocol::stage::ExternalFolder;

use crate::files::DataPath;
use crate::folder_digest::{Fingerprint, Hashes, files_fingerprint, folder_fingerprint};
use crate::roots::Root;

/// The reason why a file outside the store is not read.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// The worker has no data root.
    #[error(
        "`{path}`: this worker has no data root; start it with `--data-root DIR` and use a path below that folder, or \
         bring the data with `trainer data push PIPELINE`"
    )]
    NoRoots {
        /// As the pipeline has it.
        path: String,
    },
    /// The path leads elsewhere.
    #[error(
        "`{path}` is not below a data root of this worker ({roots}); use a path below one, or start the worker with \
         another `--data-root`"
    )]
    Outside {
        /// As the pipeline has it.
        path: String,
        /// Folders that may be read.
        roots: String,
    },
    /// The content is not the expected one.
    #[error(
        "`{path}` on `{machine}` has digest {found}; the run expects {expected}; the copies on the machines \
         differ, or the data has changed since the run was submitted"
    )]
    Differs {
        /// As the pipeline has it.
        path: String,
        /// The machine that read it.
        machine: String,
        /// The digest of the content there.
        found: Digest,
        /// The digest in the stage's key.
        expected: Digest,
    },
    /// The content changed between digesting and the end of reading.
    #[error("`{path}` on `{machine}` changed while it was read; do not change it while the stage runs")]
    Changed {
        /// As the pipeline has it.
        path: String,
        /// The machine that read it.
        machine: String,
    },
    /// The stage came without a digest to hold the content against.
    #[error("the task has no digest of `{path}`; the coordinator must compute it before it grants the task")]
    Unresolved {
        /// As the pipeline has it.
        path: String,
    },
    /// It cannot be digested.
    #[error("{0}")]
    Unreadable(String),
    /// The caller has stopped the reading.
    #[error("reading was stopped")]
    Interrupted,
}

/// The data roots of a process, and the digests of the files that it read.
#[derive(Debug, Default)]
pub struct DataAccess {
    /// `None` allows every path.
    roots: Option<Vec<Arc<Root>>>,
    /// Compares content with its expected digest.
    verifies: bool,
    /// Name of the machine in messages.
    machine: String,
    hashes: Hashes,
}

/// A file or folder that was digested and may be read.
#[derive(Debug)]
pub struct Opened {
    folder: ExternalFolder,
    path: DataPath,
    before: Option<Fingerprint>,
}

impl Opened {
    /// The path to read.
    pub fn path(&self) -> &DataPath {
        &self.path
    }
}

impl DataAccess {
    /// Reads wherever the process may: for workers of a user's own run.
    pub fn anywhere(machine: impl Into<String>) -> Self {
        Self { roots: None, verifies: true, machine: machine.into(), hashes: Hashes::default() }
    }

    /// Reads below `roots` alone: for workers of a server.
    pub fn beneath(roots: Vec<Root>, machine: impl Into<String>) -> Self {
        let roots = roots.into_iter().map(Arc::new).collect();
        Self { roots: Some(roots), verifies: true, machine: machine.into(), hashes: Hashes::default() }
    }

    /// Reads wherever the process may, without expectations: for values that are not stored.
    pub fn unverified() -> Self {
        Self::default()
    }

    /// The path that a setting names. A relative one is looked up below each data root in turn.
    fn find(&self, named: &str) -> Result<DataPath, AccessError> {
        let Some(roots) = &self.roots else { return Ok(DataPath::local(named)) };
        let path = Path::new(named);
        let below = |root: &Arc<Root>| match path.is_absolute() {
            true => Some(DataPath::beneath(Arc::clone(root), root.relative(path)?, path.to_owned())),
            false => Some(DataPath::beneath(Arc::clone(root), path.to_owned(), root.path().join(path))),
        };
        let mut candidates = roots.iter().filter_map(below);
        let Some(first) = candidates.next() else {
            let path = named.to_owned();
            if roots.is_empty() {
                return Err(AccessError::NoRoots { path });
            }
            let roots: Vec<String> = roots.iter().map(|root| format!("`{}`", root.path().display())).collect();
            return Err(AccessError::Outside { path, roots: roots.join(", ") });
        };
        Ok(if first.exists() { first } else { candidates.find(DataPath::exists).unwrap_or(first) })
    }

    fn fingerprint(
        &self,
        folder: &ExternalFolder,
        path: &DataPath,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Fingerprint, AccessError> {
        let found = match folder.format {
            Some(format) => folder_fingerprint(path, format, &self.hashes, go_on).map_err(|error| error.to_string()),
            None => {
                files_fingerprint(path, &self.hashes, go_on).map_err(|error| format!("{}: {error}", path.display()))
            }
        };
        match found {
            Err(_) if !go_on() => Err(AccessError::Interrupted),
            found => found.map_err(AccessError::Unreadable),
        }
    }

    /// The digest of what `folder` names, for a stage that came without one.
    ///
    /// # Errors
    /// If it may not or cannot be read, or `go_on` returns false.
    pub fn digest(&self, folder: &ExternalFolder, go_on: &dyn Fn() -> bool) -> Result<Digest, AccessError> {
        Ok(self.fingerprint(folder, &self.find(&folder.path)?, go_on)?.digest)
    }

    /// Opens what `folder` names, whose content must have the digest `expected`.
    ///
    /// # Errors
    /// If it may not or cannot be read, is something else, or `go_on` returns false.
    pub fn open(
        &self,
        folder: ExternalFolder,
        expected: Option<&Digest>,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Opened, AccessError> {
        let path = self.find(&folder.path)?;
        if !self.verifies {
            return Ok(Opened { folder, path, before: None });
        }
        let Some(expected) = expected else { return Err(AccessError::Unresolved { path: folder.path }) };
        let before = self.fingerprint(&folder, &path, go_on)?;
        if before.digest != *expected {
            let machine = self.machine.clone();
            let found = before.digest;
            return Err(AccessError::Differs { path: folder.path, machine, found, expected: *expected });
        }
        Ok(Opened { folder, path, before: Some(before) })
    }

    /// Refuses content that changed since it was opened.
    ///
    /// # Errors
    /// If it did, or `go_on` returns false.
    pub fn expect_unchanged(&self, opened: &Opened, go_on: &dyn Fn() -> bool) -> Result<(), AccessError> {
        let Some(before) = &opened.before else { return Ok(()) };
        match self.fingerprint(&opened.folder, &opened.path, go_on) {
            Ok(after) if after == *before => Ok(()),
            Err(AccessError::Interrupted) => Err(AccessError::Interrupted),
            Ok(_) | Err(_) => {
                Err(AccessError::Changed { path: opened.folder.path.clone(), machine: self.machine.clone() })
            }
        }
    }
}

/// Opens data roots, as options name them.
///
/// # Errors
/// Which one is no folder, or cannot be opened.
pub fn open_roots(paths: &[PathBuf]) -> Result<Vec<Root>, String> {
    let open = |path: &PathBuf| {
        Root::open(path).map_err(|error| format!("the data root `{}` cannot be used: {error}", path.display()))
    };
    paths.iter().map(open).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    fn always() -> bool {
        true
    }

    fn folder_of(path: &Path) -> ExternalFolder {
        let path = path.display().to_string();
        ExternalFolder { field: "path".into(), path, format: None, files: &[], origin: "" }
    }

    fn beneath(root: &Path) -> DataAccess {
        DataAccess::beneath(vec![Root::open(root).unwrap()], "here")
    }

    #[test]
    fn nothing_outside_the_roots_can_be_named() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        fs::create_dir_all(at("root/set")).unwrap();
        fs::write(at("root/set/a"), "in").unwrap();
        fs::write(at("secret"), "out").unwrap();
        let access = beneath(&at("root"));
        assert_eq!(access.digest(&folder_of(&at("root/set/a")), &always).unwrap(), Digest::of(b"in"));
        assert_eq!(
            access.digest(&folder_of(Path::new("set/a")), &always).unwrap(),
            Digest::of(b"in"),
            "relative to the root"
        );
        let refused = |path: &Path| access.digest(&folder_of(path), &always).unwrap_err().to_string();
        for outside in [at("secret"), at("rootless"), "/etc/passwd".into(), "/proc/self/environ".into()] {
            let said = refused(&outside);
            assert!(said.contains("is not below a data root"), "{said}");
        }
        for climbing in [at("root/../secret"), "../secret".into(), "set/../../secret".into()] {
            let said = refused(&climbing);
            assert!(said.contains("is outside the data root"), "{said}");
        }
        let none = DataAccess::beneath(vec![], "here");
        let said = none.digest(&folder_of(&at("root/set/a")), &always).unwrap_err().to_string();
        assert!(said.contains("has no data root") && said.contains("--data-root DIR"), "{said}");
    }

    #[test]
    fn a_link_that_leads_out_of_a_root_is_refused_wherever_it_stands() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        fs::create_dir_all(at("root/set/more")).unwrap();
        fs::create_dir_all(at("out")).unwrap();
        fs::write(at("out/secret"), "out").unwrap();
        fs::write(at("root/set/a"), "in").unwrap();
        symlink("../../root/set/a", at("root/set/round")).unwrap();
        let access = beneath(&at("root"));
        let opened = |path: &str| access.find(&at(path).display().to_string()).unwrap();
        // The kernel follows what stays below the root, and nothing else.
        symlink("a", at("root/set/inner")).unwrap();
        assert_eq!(opened("root/set/inner").read(9).unwrap(), b"in");
        symlink("../../out/secret", at("root/set/file")).unwrap();
        symlink(at("out"), at("root/set/folder")).unwrap();
        symlink("/proc/self/root", at("root/set/magic")).unwrap();
        for path in ["root/set/file", "root/set/folder/secret", "root/set/magic/etc/passwd", "root/set/round"] {
            let path = opened(path);
            let said = path.read(9).unwrap_err().to_string();
            assert!(said.contains("is outside the data root"), "{said}");
            assert!(path.has_entry() && !path.exists() && !path.is_folder());
            assert!(path.hold().is_err() && path.digest(&always).is_err());
        }
        let said = opened("root/set").tree().unwrap_err().to_string();
        assert!(said.contains("is outside the data root"), "{said}");
        // An opened path stays on its file, even if a link takes the file's place.
        let held = opened("root/set/a").hold().unwrap();
        fs::remove_file(at("root/set/a")).unwrap();
        symlink(at("out/secret"), at("root/set/a")).unwrap();
        assert_eq!(fs::read(held.path()).unwrap(), b"in");
    }

    #[test]
    fn content_must_be_what_is_expected_before_and_after_reading() {
        let place = tempfile::tempdir().unwrap();
        let set = place.path().join("set");
        fs::create_dir(&set).unwrap();
        fs::write(set.join("a"), "one").unwrap();
        let access = beneath(place.path());
        let digest = access.digest(&folder_of(&set), &always).unwrap();
        let opened = access.open(folder_of(&set), Some(&digest), &always).unwrap();
        access.expect_unchanged(&opened, &always).unwrap();
        // Files of any size are digested no further once the caller stops.
        let never = || false;
        assert!(matches!(access.open(folder_of(&set), Some(&digest), &never), Err(AccessError::Interrupted)));
        assert!(matches!(access.expect_unchanged(&opened, &never), Err(AccessError::Interrupted)));
        let other = Digest::of(b"other");
        let said = access.open(folder_of(&set), Some(&other), &always).unwrap_err().to_string();
        for part in [
            &*set.display().to_string(),
            "`here`",
            &digest.to_string(),
            &other.to_string(),
            "the copies on the machines differ",
        ] {
            assert!(said.contains(part), "{part}: {said}");
        }
        assert!(matches!(access.open(folder_of(&set), None, &always), Err(AccessError::Unresolved { .. })));
        // The same content in another file: it was exchanged meanwhile.
        fs::write(set.join("b"), "one").unwrap();
        fs::rename(set.join("b"), set.join("a")).unwrap();
        assert!(matches!(access.expect_unchanged(&opened, &always), Err(AccessError::Changed { .. })));
        // Another content.
        let opened = access.open(folder_of(&set), Some(&digest), &always).unwrap();
        fs::write(set.join("a"), "two").unwrap();
        assert!(matches!(access.expect_unchanged(&opened, &always), Err(AccessError::Changed { .. })));
        fs::write(set.join("a"), "one").unwrap();
        let opened = access.open(folder_of(&set), Some(&digest), &always).unwrap();
        fs::remove_file(set.join("a")).unwrap();
        assert!(matches!(access.expect_unchanged(&opened, &always), Err(AccessError::Changed { .. })));
        fs::write(set.join("a"), "one").unwrap();
        let opened = access.open(folder_of(&set), Some(&digest), &always).unwrap();
        fs::write(set.join("b"), "more").unwrap();
        assert!(matches!(access.expect_unchanged(&opened, &always), Err(AccessError::Changed { .. })));
    }
}
