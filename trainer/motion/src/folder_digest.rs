//! The digest of a dataset folder's content; a changed digest means that the folder must be opened again.
//!
//! It covers exactly the files that [`Dataset::open`](crate::Dataset::open) reads: the three lists, the two statistics,
//! and the features and texts of every listed clip. The absence of a listed clip's file counts, because the clip would
//! be skipped. Times and permissions do not count. One pass over the bytes; nothing is parsed or checked.
//!
//! The digest is that of a text with one line a file in this order, `<path>\0<sha256 of the content, or "absent">`.
//!
//! A process that digests the same files again and again keeps their digests in [`Hashes`], by the file's stamp.

use std::collections::{BTreeSet, HashMap};
use std::fmt::Write as _;
use std::io;
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use protocol::stage::DataFormat;
use protocol::{Digest, limits};

use crate::dataset::{MANY_PROBLEMS, OpenError, Problem, ProblemKind, Split, is_clip_id};
use crate::files::{DataPath, Stamp};

/// A digest is kept for a file that had not been changed for so many seconds when it was read.
const SETTLED_SECONDS: i64 = 2;

/// Digests of files by what their metadata says, so that a file that did not change is read once.
#[derive(Debug, Default)]
pub struct Hashes {
    known: Mutex<HashMap<(u64, u64), (Stamp, Digest)>>,
}

impl Hashes {
    fn digest(&self, file: &DataPath, stamps: &mut Vec<Stamp>, go_on: &dyn Fn() -> bool) -> io::Result<Digest> {
        let found = file.stamp()?;
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner).get(&found.file()).copied();
        if let Some((stamp, digest)) = known
            && stamp == found
        {
            stamps.push(stamp);
            return Ok(digest);
        }
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let (digest, stamp) = file.digest(go_on)?;
        if stamp.is_older(SETTLED_SECONDS, i64::try_from(now).unwrap_or(i64::MAX)) {
            self.known.lock().unwrap_or_else(PoisonError::into_inner).insert(stamp.file(), (stamp, digest));
        }
        stamps.push(stamp);
        Ok(digest)
    }
}

/// The content of a folder or file at one time. Equal fingerprints taken before and after reading say that it did not change meanwhile.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fingerprint {
    /// The digest of the content.
    pub digest: Digest,
    /// The stamps of its files.
    stamps: Vec<Stamp>,
}

/// Digest of the content of folder `path`, or all missing and unreadable files together.
pub fn folder_digest(path: &DataPath, format: DataFormat) -> Result<Digest, OpenError> {
    folder_fingerprint(path, format, &Hashes::default(), &|| true).map(|found| found.digest)
}

/// [`folder_digest`] with the files' stamps. Fails soon after `go_on` returns false.
pub fn folder_fingerprint(
    path: &DataPath,
    format: DataFormat,
    hashes: &Hashes,
    go_on: &dyn Fn() -> bool,
) -> Result<Fingerprint, OpenError> {
    let mut problems = vec![];
    let mut stamps = vec![];
    if !path.is_folder() {
        let what = if path.exists() { "is not a folder" } else { "no such folder" };
        let todo = "set dataset.path to the folder with new_joint_vecs/ and texts/";
        problems.push(Problem { kind: ProblemKind::Missing, what: format!("{}: {what}; {todo}", path.display()) });
        return Err(OpenError { folder: path.shown().into(), problems });
    }
    let mut listing = format!("stride/folder/1\0{format:?}\n");
    let mut ids = BTreeSet::new();
    for split in Split::ALL {
        let name = format!("{split}.txt");
        let file = path.join(&name);
        let bytes = file.read(limits::CLIP_LIST_BYTES);
        if let Ok(bytes) = &bytes {
            let text = String::from_utf8_lossy(bytes);
            ids.extend(text.lines().map(str::trim).filter(|id| !id.is_empty()).map(str::to_owned));
        }
        let digest = bytes.and_then(|bytes| {
            // A list is small, and its stamp is needed in any case.
            stamps.push(file.stamp()?);
            Ok(Digest::of(&bytes))
        });
        problems.extend(add(&mut listing, &name, &file, true, digest));
    }
    for name in ["Mean.npy", "Std.npy"] {
        let file = path.join(name);
        problems.extend(add(&mut listing, name, &file, true, hashes.digest(&file, &mut stamps, go_on)));
    }
    for id in &ids {
        if !is_clip_id(id) {
            let what = format!("{}: `{}` is not a clip id", path.display(), protocol::excerpt(id));
            problems.push(Problem { kind: ProblemKind::Text, what });
            continue;
        }
        for name in [format!("new_joint_vecs/{id}.npy"), format!("texts/{id}.txt")] {
            let file = path.join(&name);
            problems.extend(add(&mut listing, &name, &file, false, hashes.digest(&file, &mut stamps, go_on)));
        }
        if problems.len() > MANY_PROBLEMS {
            break;
        }
    }
    if problems.is_empty() {
        Ok(Fingerprint { digest: Digest::of(listing.as_bytes()), stamps })
    } else {
        Err(OpenError { folder: path.shown().into(), problems })
    }
}

/// Digest of a file, or of all files in a folder and below it by their paths. Times and permissions do not count.
///
/// # Errors
/// The obstacle, with its path.
pub fn files_digest(path: &DataPath) -> io::Result<Digest> {
    files_fingerprint(path, &Hashes::default(), &|| true).map(|found| found.digest)
}

/// [`files_digest`] with the files' stamps. Fails soon after `go_on` returns false.
///
/// # Errors
/// As there.
pub fn files_fingerprint(path: &DataPath, hashes: &Hashes, go_on: &dyn Fn() -> bool) -> io::Result<Fingerprint> {
    let mut stamps = vec![];
    if !path.is_folder() {
        let digest = hashes.digest(path, &mut stamps, go_on)?;
        return Ok(Fingerprint { digest, stamps });
    }
    let mut listing = "stride/files/1\n".to_owned();
    for file in path.tree()? {
        let shown = file.shown();
        let name = shown.strip_prefix(path.shown()).unwrap_or(shown).to_string_lossy().replace('\\', "/");
        let named = |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", file.display()));
        let digest = hashes.digest(&file, &mut stamps, go_on).map_err(named)?.hex();
        writeln!(listing, "{name}\0{digest}").expect("a string takes all that is written");
    }
    Ok(Fingerprint { digest: Digest::of(listing.as_bytes()), stamps })
}

/// Adds one file's line to `listing`. A missing file is a problem only if it is `needed`.
fn add(listing: &mut String, name: &str, file: &DataPath, needed: bool, found: io::Result<Digest>) -> Option<Problem> {
    let digest = match found {
        Ok(digest) => digest.hex(),
        Err(e) if e.kind() == io::ErrorKind::NotFound && !needed => "absent".to_owned(),
        Err(e) if e.kind() == io::ErrorKind::NotFound => {
            let what = format!("{}: no such file; a dataset folder needs it", file.display());
            return Some(Problem { kind: ProblemKind::Missing, what });
        }
        Err(e) => return Some(Problem { kind: ProblemKind::Io, what: format!("{}: {e}", file.display()) }),
    };
    writeln!(listing, "{name}\0{digest}").expect("a string takes all that is written");
    None
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn local(path: &std::path::Path) -> DataPath {
        DataPath::local(path)
    }

    fn folder() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let file = dir.path().join(name);
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(file, text).unwrap();
        };
        write("train.txt", "b\na");
        write("val.txt", "");
        write("test.txt", "c\n");
        write("Mean.npy", "m");
        write("Std.npy", "s");
        write("new_joint_vecs/a.npy", "1");
        write("new_joint_vecs/b.npy", "2");
        write("texts/a.txt", "x");
        dir
    }

    #[test]
    fn what_is_read_counts_and_nothing_else() {
        let dir = folder();
        let digest = || folder_digest(&local(dir.path()), DataFormat::Humanml3d).unwrap();
        let first = digest();
        fs::write(dir.path().join("all.txt"), "a\nb\nc\n").unwrap();
        fs::write(dir.path().join("new_joint_vecs/z.npy"), "not listed").unwrap();
        assert_eq!(digest(), first);
        fs::write(dir.path().join("texts/c.txt"), "").unwrap();
        let second = digest();
        assert_ne!(second, first, "an empty file is not a missing one");
        fs::write(dir.path().join("new_joint_vecs/b.npy"), "3").unwrap();
        assert_ne!(digest(), second);
        assert_ne!(digest(), folder_digest(&local(dir.path()), DataFormat::Kit).unwrap());
    }

    #[test]
    fn what_is_no_file_is_named_and_not_waited_for() {
        protocol::show_excerpts();
        let dir = folder();
        let pipe = dir.path().join("new_joint_vecs/b.npy");
        fs::remove_file(&pipe).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        fs::create_dir(dir.path().join("texts/c.txt")).unwrap();
        let error = folder_digest(&local(dir.path()), DataFormat::Humanml3d).unwrap_err().to_string();
        assert!(error.contains("b.npy: is a named pipe; expected a file"), "{error}");
        assert!(error.contains("c.txt: is a folder; expected a file"), "{error}");
        assert!(files_digest(&local(&pipe)).unwrap_err().to_string().contains("is a named pipe"));
        let error = files_digest(&local(dir.path())).unwrap_err().to_string();
        assert!(error.contains("new_joint_vecs/b.npy: is a named pipe"), "{error}");
        fs::write(dir.path().join("train.txt"), "../../../etc/passwd\na\u{1b}[31m\n").unwrap();
        let error = folder_digest(&local(dir.path()), DataFormat::Humanml3d).unwrap_err().to_string();
        assert!(error.contains("`../../../etc/passwd` is not a clip id") && !error.contains('\u{1b}'), "{error}");
    }

    #[test]
    fn all_that_is_missing_is_named() {
        let dir = folder();
        fs::remove_file(dir.path().join("val.txt")).unwrap();
        fs::remove_file(dir.path().join("Std.npy")).unwrap();
        let error = folder_digest(&local(dir.path()), DataFormat::Humanml3d).unwrap_err().to_string();
        assert!(error.contains("val.txt") && error.contains("Std.npy"), "{error}");
        let nowhere = dir.path().join("nowhere");
        assert!(folder_digest(&local(&nowhere), DataFormat::Kit).unwrap_err().to_string().contains("no such folder"));
    }
}
