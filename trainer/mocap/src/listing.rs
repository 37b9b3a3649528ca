//! Listing of a folder of recordings: clips, their captions, and the recording of each.
//!
//! Clips are the `.bvh`, `.npy` and `.npz` files of the folder and below it. A folder with `joints/` (else
//! `new_joints/`), such as a HumanML3D folder, has only the clips there. A clip's id is its path without the extension,
//! folders joined by `_`. Captions come from `texts/ID.txt`, from the file of the same name with the extension `.txt`,
//! and from tables: the given one, else `captions.csv` or `captions.json`. A table, or `index.csv`, may name each
//! clip's source; a file without one is a recording of its own.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use motion::DataPath;
use motion::dataset::{Split, is_clip_id};
use motion::text::Caption;
use protocol::units::counted;
use protocol::{excerpt, excerpts, limits};

use crate::captions;

/// Extensions of clips.
const ENDINGS: [&str; 3] = ["bvh", "npy", "npz"];
/// Arrays of a HumanML3D folder that are not clips.
const NO_CLIPS: [&str; 4] = ["Mean", "Std", "mean", "std"];
/// Largest number of mistakes shown.
const SHOWN: usize = 40;

/// A clip that is not read yet.
#[derive(Debug, Clone)]
pub struct ClipFile {
    pub id: String,
    pub path: DataPath,
    /// The recording that the clip belongs to.
    pub source: String,
    pub captions: Vec<Caption>,
    /// Split in the folder's own lists, if it has them.
    pub listed: Option<Split>,
}

/// The clips of a folder.
#[derive(Debug, Clone)]
pub struct Listing {
    /// Clips sorted by id.
    pub clips: Vec<ClipFile>,
    /// Messages about skipped files.
    pub notes: Vec<String>,
    /// True if the folder has `train.txt`, `val.txt` and `test.txt`.
    pub has_lists: bool,
}

/// All mistakes of a folder.
#[derive(Debug)]
pub struct ListError {
    pub folder: PathBuf,
    pub problems: Vec<String>,
}

impl fmt::Display for ListError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{}: {} in the folder of recordings",
            self.folder.display(),
            counted(self.problems.len(), "problem")
        )?;
        for problem in self.problems.iter().take(SHOWN) {
            write!(f, "\n  {problem}")?;
        }
        if self.problems.len() > SHOWN {
            write!(f, "\n  ... and {} more", self.problems.len() - SHOWN)?;
        }
        Ok(())
    }
}

impl std::error::Error for ListError {}

/// Looks through a folder; `table` is a file of captions, which need not be in it.
///
/// # Errors
/// All mistakes of the folder together.
pub fn list(folder: &DataPath, table: Option<&DataPath>) -> Result<Listing, ListError> {
    let fail = |problems| ListError { folder: folder.shown().into(), problems };
    let root = ["joints", "new_joints"].iter().map(|name| folder.join(name)).find(DataPath::is_folder);
    let root = root.unwrap_or_else(|| folder.clone());
    let found = root.tree().map_err(|e| fail(vec![e.to_string()]))?;
    let mut problems = vec![];
    let mut clips = BTreeMap::new();
    for path in found {
        let shown = path.shown();
        let ending = shown.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).unwrap_or_default();
        let id = id_of(shown.strip_prefix(root.shown()).unwrap_or(shown));
        if !ENDINGS.contains(&ending.as_str()) || NO_CLIPS.contains(&id.as_str()) || id == "tgt_offsets" {
            continue;
        }
        if !is_clip_id(&id) {
            problems.push(format!(
                "{}: not a valid clip name; rename it without control characters and leading dots",
                path.display()
            ));
            continue;
        }
        let clip = ClipFile { source: id.clone(), id: id.clone(), path, captions: vec![], listed: None };
        if let Some(other) = clips.insert(id.clone(), clip) {
            problems.push(format!(
                "{}: another file has the same clip id `{id}`; rename one of them",
                other.path.display()
            ));
        }
    }
    if clips.is_empty() && problems.is_empty() {
        problems.push(format!("no .bvh, .npy or .npz file in {}", root.display()));
    }
    if clips.len() > limits::CLIPS {
        problems.push(format!("the folder has {} clips; expected at most {}", clips.len(), limits::CLIPS));
        return Err(fail(problems));
    }
    let mut notes = vec![];
    for clip in clips.values_mut() {
        if let Err(problem) = texts(folder, clip) {
            problems.push(problem);
        }
    }
    for (file, required) in tables(folder, table) {
        match read_text(&file, limits::CLIP_LIST_BYTES) {
            Ok(Some(text)) => match captions::of_table(file.shown(), &text) {
                Ok(rows) => apply(file.shown(), rows, &mut clips, &mut notes, &mut problems),
                Err(problem) => problems.push(problem),
            },
            Ok(None) if required => problems.push(format!("{}: no such file", file.display())),
            Ok(None) => {}
            Err(problem) => problems.push(problem),
        }
    }
    let has_lists = lists(folder, &mut clips, &mut problems);
    if problems.is_empty() {
        Ok(Listing { clips: clips.into_values().collect(), notes, has_lists })
    } else {
        Err(fail(problems))
    }
}

/// The path without extension, folders joined by `_`.
fn id_of(path: &Path) -> String {
    let parts = path.with_extension("");
    parts.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("_")
}

fn read_text(file: &DataPath, most: u64) -> Result<Option<String>, String> {
    match file.read(most) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(format!("{}: {e}", file.display())),
        Ok(bytes) => String::from_utf8(bytes).map(Some).map_err(|_| format!("{}: not UTF-8 text", file.display())),
    }
}

/// Reads the captions in a clip's own file.
fn texts(folder: &DataPath, clip: &mut ClipFile) -> Result<(), String> {
    for file in [folder.join("texts").join(format!("{}.txt", clip.id)), clip.path.with_extension("txt")] {
        if let Some(text) = read_text(&file, limits::CAPTIONS_BYTES)? {
            clip.captions = captions::of_text(file.shown(), &text)?;
            break;
        }
    }
    Ok(())
}

fn tables(folder: &DataPath, table: Option<&DataPath>) -> Vec<(DataPath, bool)> {
    let own = match table {
        Some(table) => vec![(table.clone(), true)],
        None => vec![(folder.join("captions.csv"), false), (folder.join("captions.json"), false)],
    };
    own.into_iter().chain([(folder.join("index.csv"), false)]).collect()
}

/// Adds each row's captions and source to its clip, which the row names by id, by path, or by a file name that is
/// unique.
fn apply(
    file: &Path,
    rows: Vec<captions::Row>,
    clips: &mut BTreeMap<String, ClipFile>,
    notes: &mut Vec<String>,
    problems: &mut Vec<String>,
) {
    let mut by_stem: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for clip in clips.values() {
        let stem = clip.path.shown().file_stem().unwrap_or_default().to_string_lossy().into_owned();
        by_stem.entry(stem).or_default().push(clip.id.clone());
    }
    let mut unknown = BTreeSet::new();
    for row in rows {
        let path = Path::new(&row.clip);
        let known = path.extension().is_some_and(|e| ENDINGS.iter().any(|ending| e.eq_ignore_ascii_case(ending)));
        let bare = if known { path.with_extension("") } else { path.to_owned() };
        let id = bare.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("_");
        let stem = bare.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let id = match by_stem.get(&stem) {
            _ if clips.contains_key(&id) => id,
            Some(ids) if ids.len() == 1 => ids[0].clone(),
            Some(ids) => {
                problems.push(format!(
                    "{}: `{}` is ambiguous: it may be {}; write the path",
                    file.display(),
                    excerpt(&row.clip),
                    ids.join(" or ")
                ));
                continue;
            }
            None => {
                unknown.insert(row.clip);
                continue;
            }
        };
        if let Some(clip) = clips.get_mut(&id) {
            for caption in row.captions {
                if !clip.captions.contains(&caption) {
                    clip.captions.push(caption);
                }
            }
            clip.source = row.source.unwrap_or_else(|| clip.source.clone());
        }
    }
    if !unknown.is_empty() {
        notes.push(format!(
            "{}: {} rows name clips that are not in the folder, such as {}",
            file.display(),
            unknown.len(),
            excerpts(unknown.iter().map(String::as_str), 5)
        ));
    }
}

/// Reads the folder's own lists. Returns false if one of the three is missing.
fn lists(folder: &DataPath, clips: &mut BTreeMap<String, ClipFile>, problems: &mut Vec<String>) -> bool {
    let mut texts = vec![];
    for split in Split::ALL {
        match read_text(&folder.join(format!("{split}.txt")), limits::CLIP_LIST_BYTES) {
            Ok(Some(text)) => texts.push((split, text)),
            Ok(None) => return false,
            Err(problem) => problems.push(problem),
        }
    }
    for (split, text) in texts {
        for id in text.lines().map(str::trim).filter(|id| !id.is_empty()) {
            if let Some(clip) = clips.get_mut(id) {
                if clip.listed.is_some_and(|listed| listed != split) {
                    problems.push(format!("`{id}` is in more than one of train.txt, val.txt and test.txt"));
                }
                clip.listed = Some(split);
            }
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn local(path: impl Into<PathBuf>) -> DataPath {
        DataPath::local(path)
    }

    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, content) in files {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        }
        folder
    }

    #[test]
    fn captions_and_sources_find_their_clips() {
        protocol::show_excerpts();
        let folder = folder(&[
            ("a/walk.bvh", ""),
            ("a/run.BVH", ""),
            ("b/walk.npz", ""),
            ("Mean.npy", ""),
            ("notes.md", ""),
            ("a/walk.txt", "someone walks\n"),
            ("texts/a_run.txt", "a man runs#a/DET#0.0#0.0\n"),
            ("captions.csv", "file,caption,source\nb/walk.npz,walks on,take\nrun,runs,take\nnone,x,\n"),
        ]);
        let listing = list(&local(folder.path()), None).unwrap();
        let ids: Vec<&str> = listing.clips.iter().map(|clip| clip.id.as_str()).collect();
        assert_eq!(ids, ["a_run", "a_walk", "b_walk"]);
        let captions: Vec<Vec<&str>> =
            listing.clips.iter().map(|c| c.captions.iter().map(|c| c.text.as_str()).collect()).collect();
        assert_eq!(captions, [vec!["a man runs", "runs"], vec!["someone walks"], vec!["walks on"]]);
        let sources: Vec<&str> = listing.clips.iter().map(|clip| clip.source.as_str()).collect();
        assert_eq!(sources, ["take", "a_walk", "take"]);
        assert!(listing.notes[0].contains("1 rows") && listing.notes[0].contains("none") && !listing.has_lists);
        let said = list(&local(folder.path()), Some(&local("gone.csv"))).unwrap_err().to_string();
        assert!(said.contains("gone.csv: no such file"), "{said}");
    }

    #[test]
    fn all_mistakes_of_a_folder_come_together() {
        protocol::show_excerpts();
        let folder = folder(&[
            ("a/b.bvh", ""),
            ("a_b.npy", ""),
            ("c/b.npz", ""),
            ("d/b.npz", ""),
            ("a_b.txt", "x\ny#z\n"),
            ("captions.json", "{\"b\": \"x\"}"),
            ("train.txt", "c_b"),
            ("val.txt", "c_b"),
            ("test.txt", ""),
        ]);
        let said = list(&local(folder.path()), None).unwrap_err();
        let text = said.to_string();
        for part in [
            "has the same clip id `a_b`",
            "a_b.txt:1: the line has 1 field",
            "it may be c_b or d_b",
            "`c_b` is in more than one",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        let empty = tempfile::tempdir().unwrap();
        assert!(list(&local(empty.path()), None).unwrap_err().to_string().contains("no .bvh, .npy or .npz file"));
        assert!(list(&local(empty.path().join("gone")), None).unwrap_err().to_string().contains("gone"));
    }
}
