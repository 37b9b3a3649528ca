//! The digest of a dataset folder's content; a changed digest means that the folder must be opened again.
//!
//! It covers exactly the files that [`Dataset::open`](crate::Dataset::open) reads: the three lists, the two statistics,
//! and the features and texts of every listed clip. The absence of a listed clip's file counts, because the clip would
//! be skipped. Times and permissions do not count. One pass over the bytes; nothing is parsed or checked.
//!
//! The digest is that of a text with one line per file in this order, `<path>\0<sha256 of the content, or "absent">`.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

use protocol::stage::DataFormat;
use protocol::{Digest, limits};

use crate::dataset::{MANY_PROBLEMS, OpenError, Problem, ProblemKind, Split, is_clip_id};
use crate::files;

/// Digest of the content of folder `path`, or all missing and unreadable files together.
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
        let file = path.join(&name);
        let bytes = files::read(&file, limits::CLIP_LIST_BYTES);
        if let Ok(bytes) = &bytes {
            let text = String::from_utf8_lossy(bytes);
            ids.extend(text.lines().map(str::trim).filter(|id| !id.is_empty()).map(str::to_owned));
        }
        problems.extend(add(&mut listing, &name, &file, true, bytes.map(|bytes| Digest::of(&bytes))));
    }
    for name in ["Mean.npy", "Std.npy"] {
        let file = path.join(name);
        problems.extend(add(&mut listing, name, &file, true, files::digest(&file)));
    }
    for id in &ids {
        if !is_clip_id(id) {
            let what = format!("{}: `{}` is not a clip id", path.display(), id.escape_debug());
            problems.push(Problem { kind: ProblemKind::Text, what });
            continue;
        }
        for name in [format!("new_joint_vecs/{id}.npy"), format!("texts/{id}.txt")] {
            let file = path.join(&name);
            problems.extend(add(&mut listing, &name, &file, false, files::digest(&file)));
        }
        if problems.len() > MANY_PROBLEMS {
            break;
        }
    }
    if problems.is_empty() {
        Ok(Digest::of(listing.as_bytes()))
    } else {
        Err(OpenError { folder: path.into(), problems })
    }
}

/// Digest of a file, or of all files in a folder and below it by their paths. Times and permissions do not count.
///
/// # Errors
/// The obstacle, with its path.
pub fn files_digest(path: &Path) -> std::io::Result<Digest> {
    if !path.is_dir() {
        return files::digest(path);
    }
    let mut listing = "stride/files/1\n".to_owned();
    for file in files::tree(path)? {
        let name = file.strip_prefix(path).unwrap_or(&file).to_string_lossy().replace('\\', "/");
        let named = |error: std::io::Error| std::io::Error::new(error.kind(), format!("{}: {error}", file.display()));
        let digest = files::digest(&file).map_err(named)?.hex();
        writeln!(listing, "{name}\0{digest}").expect("a string takes all that is written");
    }
    Ok(Digest::of(listing.as_bytes()))
}

/// Adds one file's line to `listing`. A missing file is a problem only if it is `needed`.
fn add(listing: &mut String, name: &str, file: &Path, needed: bool, found: std::io::Result<Digest>) -> Option<Problem> {
    let digest = match found {
        Ok(digest) => digest.hex(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound && !needed => "absent".to_owned(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
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
    fn what_is_no_file_is_named_and_not_waited_for() {
        let dir = folder();
        let pipe = dir.path().join("new_joint_vecs/b.npy");
        fs::remove_file(&pipe).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        fs::create_dir(dir.path().join("texts/c.txt")).unwrap();
        let error = folder_digest(dir.path(), DataFormat::Humanml3d).unwrap_err().to_string();
        assert!(error.contains("b.npy: is a named pipe; expected a file"), "{error}");
        assert!(error.contains("c.txt: is a folder; expected a file"), "{error}");
        assert!(files_digest(&pipe).unwrap_err().to_string().contains("is a named pipe"));
        let error = files_digest(dir.path()).unwrap_err().to_string();
        assert!(error.contains("new_joint_vecs/b.npy: is a named pipe"), "{error}");
        fs::write(dir.path().join("train.txt"), "../../../etc/passwd\na\u{1b}[31m\n").unwrap();
        let error = folder_digest(dir.path(), DataFormat::Humanml3d).unwrap_err().to_string();
        assert!(error.contains("`../../../etc/passwd` is not a clip id") && !error.contains('\u{1b}'), "{error}");
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
