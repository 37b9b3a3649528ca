//! The digest of a dataset folder's content: what decides whether it has to be opened again.
//!
//! It covers the files that [`Dataset::open`](crate::Dataset::open) reads and nothing else: the three lists, the two
//! statistics, and the features and texts of every listed clip. A listed clip without a file counts as such, because it
//! would be skipped. Times and permissions do not count. One pass over the bytes, nothing is parsed or checked.
//!
//! The digest is that of a text with one line a file in this order, `<path>\0<sha256 of the content, or "absent">`.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

use protocol::Digest;
use protocol::stage::DataFormat;

use crate::dataset::{OpenError, Problem, ProblemKind, Split};

/// The digest of what is in the folder `path`; all that is missing or unreadable at once otherwise.
pub fn folder_digest(path: &Path, format: DataFormat) -> Result<Digest, OpenError> {
    let mut problems = vec![];
    if !path.is_dir() {
        let what = if path.exists() { "is not a folder" } else { "no such folder" };
        let todo = "set dataset.path to the folder that holds new_joint_vecs/ and texts/";
        problems.push(Problem { kind: ProblemKind::Missing, what: format!("{}: {what}; {todo}", path.display()) });
        return Err(OpenError { folder: path.into(), problems });
    }
    let mut listing = format!("stride/folder/1\0{format:?}\n");
    let mut ids = BTreeSet::new();
    for split in Split::ALL {
        let name = format!("{split}.txt");
        let Some(bytes) = hash(path, &name, true, &mut listing, &mut problems) else { continue };
        let text = String::from_utf8_lossy(&bytes);
        ids.extend(text.lines().map(str::trim).filter(|id| !id.is_empty()).map(str::to_owned));
    }
    for name in ["Mean.npy", "Std.npy"] {
        hash(path, name, true, &mut listing, &mut problems);
    }
    for id in &ids {
        hash(path, &format!("new_joint_vecs/{id}.npy"), false, &mut listing, &mut problems);
        hash(path, &format!("texts/{id}.txt"), false, &mut listing, &mut problems);
    }
    if problems.is_empty() {
        Ok(Digest::of(listing.as_bytes()))
    } else {
        Err(OpenError { folder: path.into(), problems })
    }
}

/// The digest of a file, or of all files in a folder and below it by their paths. Times and permissions do not count.
pub fn files_digest(path: &Path) -> std::io::Result<Digest> {
    if path.is_file() {
        return Ok(Digest::of(&std::fs::read(path)?));
    }
    let mut listing = "stride/files/1\n".to_owned();
    let mut folders = vec![path.to_owned()];
    let mut files = BTreeSet::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder)? {
            let entry = entry?.path();
            if entry.is_dir() {
                folders.push(entry);
            } else {
                files.insert(entry);
            }
        }
    }
    for file in files {
        let name = file.strip_prefix(path).unwrap_or(&file).to_string_lossy().replace('\\', "/");
        let digest = Digest::of(&std::fs::read(&file)?).hex();
        writeln!(listing, "{name}\0{digest}").expect("a string takes all that is written");
    }
    Ok(Digest::of(listing.as_bytes()))
}

/// Adds one file's line to `listing` and gives its bytes. A missing file is a problem only if it is `needed`.
fn hash(root: &Path, name: &str, needed: bool, listing: &mut String, problems: &mut Vec<Problem>) -> Option<Vec<u8>> {
    let file = root.join(name);
    let bytes = match std::fs::read(&file) {
        Ok(bytes) => Some(bytes),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound && !needed => None,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            let what = format!("{}: no such file; a dataset folder needs it", file.display());
            problems.push(Problem { kind: ProblemKind::Missing, what });
            return None;
        }
        Err(e) => {
            problems.push(Problem { kind: ProblemKind::Io, what: format!("{}: {e}", file.display()) });
            return None;
        }
    };
    let digest = bytes.as_deref().map_or_else(|| "absent".to_owned(), |bytes| Digest::of(bytes).hex());
    writeln!(listing, "{name}\0{digest}").expect("a string takes all that is written");
    bytes
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

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
        let digest = || folder_digest(dir.path(), DataFormat::Humanml3d).unwrap();
        let first = digest();
        fs::write(dir.path().join("all.txt"), "a\nb\nc\n").unwrap();
        fs::write(dir.path().join("new_joint_vecs/z.npy"), "not listed").unwrap();
        assert_eq!(digest(), first);
        fs::write(dir.path().join("texts/c.txt"), "").unwrap();
        let second = digest();
        assert_ne!(second, first, "an empty file is not a missing one");
        fs::write(dir.path().join("new_joint_vecs/b.npy"), "3").unwrap();
        assert_ne!(digest(), second);
        assert_ne!(digest(), folder_digest(dir.path(), DataFormat::Kit).unwrap());
    }

    #[test]
    fn all_that_is_missing_is_named() {
        let dir = folder();
        fs::remove_file(dir.path().join("val.txt")).unwrap();
        fs::remove_file(dir.path().join("Std.npy")).unwrap();
        let error = folder_digest(dir.path(), DataFormat::Humanml3d).unwrap_err().to_string();
        assert!(error.contains("val.txt") && error.contains("Std.npy"), "{error}");
        let nowhere = dir.path().join("nowhere");
        assert!(folder_digest(&nowhere, DataFormat::Kit).unwrap_err().to_string().contains("no such folder"));
    }
}
