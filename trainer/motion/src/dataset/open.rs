//! Opens a folder in the HumanML3D or KIT-ML layout.
//!
//! Two kinds of findings are kept apart. A [`Skip`] in the report is data that the published rules leave out: a clip
//! too short or too long, a listed file that does not exist. A [`Problem`] is data that would give wrong numbers:
//! another width, NaN, a truncated file, a caption that does not parse. All problems of a folder are returned together.
//!
//! Load rules, from the published loaders, with our decisions:
//! * A clip is used if `min <= L < max` (40, or 24 for KIT, and 200).
//! * A caption whose two times are 0 belongs to the whole clip. Any other caption becomes an entry of its own over
//!   frames `trunc(from * fps) .. trunc(to * fps)`, under the same length rule. The loaders name such entries with
//!   random letters; ours are named by their frames, so that the same folder always gives the same dataset.
//! * A time range that is inverted, empty, negative or not finite cuts no frames upstream, and its caption is dropped.
//!   Fields after the times are ignored. Both are reported with file and line.
//! * KIT times are read at KIT's 12.5 fps. (Some loaders use 20 for both. Published KIT texts have no times, so no
//!   published number depends on it, and seconds should be seconds.)
//! * `007975` and `M007975` of HumanML3D are known to hold NaN in some builds. They are then skipped by name; NaN in
//!   any other clip is a problem.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt;
use std::path::{Path, PathBuf};

use protocol::stage::DataFormat;
use protocol::units::counted;
use protocol::{excerpt, limits};

use super::entries::Unusable;
use super::{Clip, Dataset, Split};
use crate::files::DataPath;
use crate::npy::{self, NpyError};
use crate::skeleton::Skeleton;
use crate::text::{self, Oddity, Texts};

/// Clips of the published HumanML3D that hold NaN in some builds.
const KNOWN_NOT_FINITE: [&str; 2] = ["007975", "M007975"];

/// A folder that cannot be used, with all of its problems.
#[derive(Debug)]
pub struct OpenError {
    pub folder: PathBuf,
    /// All problems in the order of the files.
    pub problems: Vec<Problem>,
}

/// Largest number of problems that are printed one by one.
const PRINTED: usize = 40;
/// Reading stops after this many problems.
pub(crate) const MANY_PROBLEMS: usize = 1_000;

impl fmt::Display for OpenError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {} in the dataset folder", self.folder.display(), counted(self.problems.len(), "problem"))?;
        for problem in self.problems.iter().take(PRINTED) {
            write!(f, "\n  {problem}")?;
        }
        if self.problems.len() > PRINTED {
            write!(f, "\n  ... and {} more", self.problems.len() - PRINTED)?;
        }
        Ok(())
    }
}

impl std::error::Error for OpenError {}

/// Kind of a problem; [`Problem::what`] has the text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ProblemKind {
    /// The folder, a list, or the statistics do not exist.
    Missing,
    /// A file or folder cannot be read.
    Io,
    /// A `.npy` header, element type or order that is not the format's.
    Type,
    /// A `.npy` file shorter or longer than its header declares.
    Size,
    /// An array of another shape.
    Shape,
    /// NaN or infinity.
    NotFinite,
    /// A caption line or a list line that does not parse.
    Text,
    /// Nothing is left to train on.
    Empty,
}

/// A problem that must be repaired before the folder is used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    pub kind: ProblemKind,
    /// File (and line), the value found, the value expected, and the remedy.
    pub what: String,
}

impl Problem {
    fn new(kind: ProblemKind, what: impl Into<String>) -> Self {
        Self { kind, what: what.into() }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl From<NpyError> for Problem {
    fn from(error: NpyError) -> Self {
        let kind = match &error {
            NpyError::Io { .. } if error.is_missing() => ProblemKind::Missing,
            NpyError::Io { .. } => ProblemKind::Io,
            NpyError::Size { .. } => ProblemKind::Size,
            NpyError::Header { .. } | NpyError::Type { .. } | NpyError::Order { .. } => ProblemKind::Type,
        };
        Self::new(kind, error.to_string())
    }
}

/// Reason for leaving out a clip or one of its captions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SkipReason {
    /// Fewer frames than the format's minimum.
    TooShort {
        frames: usize,
        /// The minimum, in frames.
        min: usize,
    },
    /// At least as many frames as the format's bound.
    TooLong {
        frames: usize,
        /// The bound, exclusive.
        bound: usize,
    },
    /// Listed, but without a features file.
    NoMotion,
    /// Listed, but without a text file.
    NoText,
    /// The text file has no caption, or none that covers enough frames.
    NoCaption,
    /// The part of the clip that a caption describes is too short or too long.
    CaptionRange {
        /// Line of the text file.
        line: usize,
        /// Frames in the range.
        frames: usize,
    },
    /// The time range of a caption ends before its start, or is negative or not finite.
    CaptionTimes {
        /// Line of the text file.
        line: usize,
        /// The range as written in the line, in seconds.
        range: String,
    },
    /// A caption line has fields after its times; the caption itself is used.
    ExtraFields {
        /// Line of the text file.
        line: usize,
        /// Number of fields of the line, 4 expected.
        fields: usize,
    },
    /// Listed twice in one split.
    Repeated,
    /// One of the published clips that are known to hold NaN.
    KnownNotFinite,
}

impl SkipReason {
    /// A heading for the report.
    pub fn heading(&self) -> &'static str {
        match self {
            Self::TooShort { .. } => "too short",
            Self::TooLong { .. } => "too long",
            Self::NoMotion => "no features in new_joint_vecs",
            Self::NoText => "no file in texts",
            Self::NoCaption => "no usable caption",
            Self::CaptionRange { .. } => "caption dropped: its time range is too short or too long",
            Self::CaptionTimes { .. } => "caption dropped: its time range is inverted, empty or not from 0 on",
            Self::ExtraFields { .. } => "fields behind a caption's times not looked at",
            Self::Repeated => "listed twice",
            Self::KnownNotFinite => "known to hold NaN",
        }
    }
}

/// A clip, or a caption of it, that is left out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Skip {
    /// Id of the clip.
    pub id: String,
    /// The split that lists the clip.
    pub split: Split,
    pub reason: SkipReason,
}

impl fmt::Display for Skip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let id = &self.id;
        match &self.reason {
            SkipReason::TooShort { frames, min } => write!(f, "{id} ({frames} frames, needs {min})"),
            SkipReason::TooLong { frames, bound } => write!(f, "{id} ({frames} frames, must be below {bound})"),
            SkipReason::CaptionRange { line, frames } => write!(f, "texts/{id}.txt:{line} ({frames} frames)"),
            SkipReason::CaptionTimes { line, range } => write!(f, "texts/{id}.txt:{line} ({range})"),
            SkipReason::ExtraFields { line, fields } => write!(f, "texts/{id}.txt:{line} ({fields} fields)"),
            _ => write!(f, "{id}"),
        }
    }
}

/// Summary of an opened folder, with the clips left out. Its `Display` is the report.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenReport {
    /// Format in which the folder was read.
    pub format: DataFormat,
    /// Number of ids in the lists, by split.
    pub listed: BTreeMap<Split, usize>,
    /// Number of entries, by split.
    pub entries: BTreeMap<Split, usize>,
    /// Number of clips that at least one entry uses.
    pub clips: usize,
    /// Number of frames of these clips.
    pub frames: usize,
    /// Number of captions that at least one entry uses.
    pub captions: usize,
    /// Clips and captions that were left out.
    pub skips: Vec<Skip>,
    /// Ids in more than one split; an evaluation on them uses training data.
    pub shared: Vec<String>,
}

impl fmt::Display for OpenReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.frames as f64 / Skeleton::of(self.format).fps;
        writeln!(
            f,
            "{} clips, {} frames ({:.1} minutes), {} captions",
            self.clips,
            self.frames,
            seconds / 60.0,
            self.captions
        )?;
        for (split, entries) in &self.entries {
            let listed = self.listed.get(split).copied().unwrap_or(0);
            writeln!(f, "{split}: {entries} entries from {listed} listed clips")?;
        }
        if !self.shared.is_empty() {
            writeln!(f, "warning: in more than one split: {}", self.shared.join(", "))?;
        }
        writeln!(f, "left out: {}", self.skips.len())?;
        let mut by_reason: BTreeMap<(&str, Split), Vec<&Skip>> = BTreeMap::new();
        for skip in &self.skips {
            by_reason.entry((skip.reason.heading(), skip.split)).or_default().push(skip);
        }
        for ((heading, split), skips) in by_reason {
            let names: Vec<String> = skips.iter().map(|s| s.to_string()).collect();
            writeln!(f, "  {heading}, {split} ({}): {}", names.len(), names.join(", "))?;
        }
        Ok(())
    }
}

/// Result of reading one listed clip.
enum Loaded {
    Clip { frames: usize, features: Vec<f32>, texts: Texts },
    Skip(SkipReason),
    Bad(Vec<Problem>),
}

impl Dataset {
    /// Opens a folder. Reads `train.txt`, `val.txt`, `test.txt`, `new_joint_vecs/`, `texts/`, `Mean.npy`, `Std.npy`.
    ///
    /// # Errors
    /// [`OpenError`] with every problem found.
    ///
    /// # Panics
    /// Never.
    pub fn open(path: &DataPath, format: DataFormat) -> Result<(Self, OpenReport), OpenError> {
        Self::open_while(path, format, &|_| true).map(|opened| opened.expect("reading is never stopped"))
    }

    /// Opens a folder while `go_on`, which is asked every few clips with how many are read, returns true; else `None`.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_while(
        path: &DataPath,
        format: DataFormat,
        go_on: &dyn Fn(usize) -> bool,
    ) -> Result<Option<(Self, OpenReport)>, OpenError> {
        let fail = |problems| OpenError { folder: path.shown().into(), problems };
        if !path.is_folder() {
            let what = if path.exists() { "is not a folder" } else { "no such folder" };
            return Err(fail(vec![Problem::new(
                ProblemKind::Missing,
                format!("{}: {what}; set dataset.path to the folder with new_joint_vecs/ and texts/", path.display()),
            )]));
        }
        let Parts { lists, mean, std } = Parts::read(path, format).map_err(fail)?;
        let mut ids: Vec<&str> = vec![];
        let mut seen = HashSet::new();
        for id in lists.iter().flat_map(|(_, ids)| ids) {
            if seen.insert(id.as_str()) {
                ids.push(id);
            }
        }
        let mut loaded: HashMap<&str, Loaded> = HashMap::new();
        for (part, ids) in ids.chunks(AT_ONCE).enumerate() {
            if !go_on(part * AT_ONCE) {
                return Ok(None);
            }
            loaded.extend(ids.iter().copied().zip(load_all(path, ids, Skeleton::of(format))));
        }
        let mut problems = vec![];
        for id in &ids {
            if let Loaded::Bad(found) = &loaded[id] {
                problems.extend(found.iter().cloned());
            }
        }
        if !problems.is_empty() {
            return Err(fail(problems));
        }
        let mut dataset = Self { format, mean, std, clips: vec![], captions: vec![], entries: vec![] };
        let report = dataset.collect(&lists, loaded);
        if report.entries.get(&Split::Train).copied().unwrap_or(0) == 0 {
            let what = format!("{}: no usable training clip\n{report}", path.join("train.txt").display());
            return Err(fail(vec![Problem::new(ProblemKind::Empty, what)]));
        }
        Ok(Some((dataset, report)))
    }

    /// Converts loaded clips to entries by the load rules, and records those left out.
    fn collect(&mut self, lists: &[(Split, Vec<String>)], mut loaded: HashMap<&str, Loaded>) -> OpenReport {
        let mut skips = vec![];
        let mut shared = vec![];
        // Indices of a stored clip and of its captions by line.
        let mut stored: HashMap<String, (usize, Vec<(usize, usize)>)> = HashMap::new();
        let mut odd: HashMap<String, Vec<SkipReason>> = HashMap::new();
        for (split, ids) in lists {
            let mut listed = HashSet::new();
            for id in ids {
                let mut skip = |reason| skips.push(Skip { id: id.clone(), split: *split, reason });
                if !listed.insert(id) {
                    skip(SkipReason::Repeated);
                    continue;
                }
                if let Some(Loaded::Skip(reason)) = loaded.get(id.as_str()) {
                    skip(reason.clone());
                    continue;
                }
                if let Some(Loaded::Clip { frames, features, texts }) = loaded.remove(id.as_str()) {
                    let lines = texts.captions.iter().map(|(line, _)| *line);
                    let lines = lines.zip(self.captions.len()..).collect();
                    self.captions.extend(texts.captions.into_iter().map(|(_, caption)| caption));
                    odd.insert(id.clone(), texts.odd.into_iter().map(left_out).collect());
                    stored.insert(id.clone(), (self.clips.len(), lines));
                    self.clips.push(Clip { id: id.clone(), frames, features: features.into() });
                } else {
                    shared.push(id.clone());
                }
                let Some((clip, lines)) = stored.get(id) else { continue };
                odd.get(id).into_iter().flatten().cloned().for_each(&mut skip);
                let before = self.entries.len();
                for Unusable { line, start, end } in self.add_entries(*clip, *split, lines) {
                    skip(SkipReason::CaptionRange { line, frames: end.saturating_sub(start) });
                }
                if self.entries.len() == before {
                    skip(SkipReason::NoCaption);
                }
            }
        }
        self.drop_unused();
        let count = |split| self.entries.iter().filter(|e| e.split == split).count();
        OpenReport {
            format: self.format,
            listed: lists.iter().map(|(split, ids)| (*split, ids.len())).collect(),
            entries: Split::ALL.into_iter().map(|split| (split, count(split))).collect(),
            clips: self.clips.len(),
            frames: self.clips.iter().map(|c| c.frames).sum(),
            captions: self.captions.len(),
            skips,
            shared,
        }
    }
}

/// The parts of a folder besides its clips.
struct Parts {
    /// The ids of each split.
    lists: Vec<(Split, Vec<String>)>,
    mean: Vec<f32>,
    std: Vec<f32>,
}

impl Parts {
    fn read(path: &DataPath, format: DataFormat) -> Result<Self, Vec<Problem>> {
        let mut problems = vec![];
        let mut lists = vec![];
        for split in Split::ALL {
            match read_list(&path.join(format!("{split}.txt"))) {
                Ok(ids) => lists.push((split, ids)),
                Err(found) => problems.extend(found),
            }
        }
        for folder in ["new_joint_vecs", "texts"] {
            let file = path.join(folder);
            if !file.is_folder() {
                problems.push(Problem::new(ProblemKind::Missing, format!("{}: no such folder", file.display())));
            }
        }
        let mut statistic = |name: &str, positive: bool| {
            read_statistic(&path.join(name), Skeleton::of(format), positive).unwrap_or_else(|problem| {
                problems.push(problem);
                vec![]
            })
        };
        let mean = statistic("Mean.npy", false);
        let std = statistic("Std.npy", true);
        let listed: usize = lists.iter().map(|(_, ids)| ids.len()).sum();
        if listed > limits::CLIPS {
            let what = format!("{}: its lists have {listed} clips; expected at most {}", path.display(), limits::CLIPS);
            problems.push(Problem::new(ProblemKind::Text, what));
        }
        if problems.is_empty() { Ok(Self { lists, mean, std }) } else { Err(problems) }
    }
}

/// Reads the ids of a list, trimmed, without blank lines.
fn read_list(file: &DataPath) -> Result<Vec<String>, Vec<Problem>> {
    let content = file.read(limits::CLIP_LIST_BYTES).map_err(|e| {
        let (kind, hint) = match e.kind() {
            std::io::ErrorKind::NotFound => (ProblemKind::Missing, "; expected a list with one clip id per line"),
            _ => (ProblemKind::Io, ""),
        };
        vec![Problem::new(kind, format!("{}: {e}{hint}", file.display()))]
    })?;
    let content = String::from_utf8(content)
        .map_err(|_| vec![Problem::new(ProblemKind::Text, format!("{}: not UTF-8 text", file.display()))])?;
    let lines = || content.lines().enumerate().map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.is_empty());
    let bad: Vec<Problem> = lines()
        .filter(|(_, id)| !is_clip_id(id))
        .take(MANY_PROBLEMS)
        .map(|(n, id)| {
            let what = format!(
                "{}:{n}: `{}` is not a clip id; expected a file name without a folder",
                file.display(),
                excerpt(id)
            );
            Problem::new(ProblemKind::Text, what)
        })
        .collect();
    if bad.is_empty() { Ok(lines().map(|(_, id)| id.to_owned()).collect()) } else { Err(bad) }
}

/// Returns true if `id` with an extension is a file name that is safe to print.
pub fn is_clip_id(id: &str) -> bool {
    id.len() <= limits::CLIP_NAME_BYTES
        && !id.starts_with('.')
        && !id.contains(|c: char| matches!(c, '/' | '\\') || c.is_control())
}

/// The report's reason for an unusual line.
fn left_out((line, oddity): (usize, Oddity)) -> SkipReason {
    match oddity {
        Oddity::Times(range) => SkipReason::CaptionTimes { line, range },
        Oddity::ExtraFields(fields) => SkipReason::ExtraFields { line, fields },
    }
}

fn read_statistic(file: &DataPath, skeleton: &Skeleton, positive: bool) -> Result<Vec<f32>, Problem> {
    let array = npy::read_any_float(file).map_err(|e| {
        let mut problem = Problem::from(e);
        if problem.kind == ProblemKind::Missing {
            problem.what += "; a HumanML3D or KIT-ML folder has Mean.npy and Std.npy of its features";
        }
        problem
    })?;
    if array.shape != [skeleton.features] {
        let what = format!("{}: has shape {:?}; expected [{}]", file.display(), array.shape, skeleton.features);
        return Err(Problem::new(ProblemKind::Shape, what));
    }
    let wanted = if positive { "a positive number" } else { "a finite number" };
    if let Some(i) = array.data.iter().position(|v| !v.is_finite() || (positive && *v <= 0.0)) {
        let what = format!("{}: has value {} at index {i}; expected {wanted}", file.display(), array.data[i]);
        return Err(Problem::new(ProblemKind::NotFinite, what));
    }
    Ok(array.data)
}

/// Clips that are read between two looks at whether to go on.
const AT_ONCE: usize = 256;

/// Loads all clips, a contiguous part of the list on each core. The result has the order of `ids`.
fn load_all(root: &DataPath, ids: &[&str], skeleton: &Skeleton) -> Vec<Loaded> {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get()).min(8);
    let part = ids.len().div_ceil(threads).max(1);
    std::thread::scope(|scope| {
        let handles: Vec<_> = ids
            .chunks(part)
            .map(|ids| scope.spawn(move || ids.iter().map(|id| load(root, id, skeleton)).collect::<Vec<_>>()))
            .collect();
        handles.into_iter().flat_map(|h| h.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

fn load(root: &DataPath, id: &str, skeleton: &Skeleton) -> Loaded {
    let (motion_file, text_file) =
        (root.join("new_joint_vecs").join(format!("{id}.npy")), root.join("texts").join(format!("{id}.txt")));
    let motion = match npy::read(&motion_file) {
        Err(e) if e.is_missing() => return Loaded::Skip(SkipReason::NoMotion),
        motion => motion.map_err(Problem::from),
    };
    let text = match text_file.read(limits::CAPTIONS_BYTES) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Loaded::Skip(SkipReason::NoText),
        text => parse_text(text_file.shown(), text),
    };
    let motion = motion.and_then(|array| check_motion(motion_file.shown(), array, skeleton));
    let (array, texts) = match (motion, text) {
        (Ok(motion), Ok(texts)) => (motion, texts),
        (motion, text) => {
            return Loaded::Bad(motion.err().into_iter().chain(text.err().into_iter().flatten()).collect());
        }
    };
    let frames = array.shape[0];
    if frames < skeleton.min_frames {
        return Loaded::Skip(SkipReason::TooShort { frames, min: skeleton.min_frames });
    }
    if frames >= skeleton.max_frames {
        return Loaded::Skip(SkipReason::TooLong { frames, bound: skeleton.max_frames });
    }
    if let Some(at) = array.data.iter().position(|v| !v.is_finite()) {
        if KNOWN_NOT_FINITE.contains(&id) && skeleton.format == DataFormat::Humanml3d {
            return Loaded::Skip(SkipReason::KnownNotFinite);
        }
        return Loaded::Bad(vec![Problem::new(
            ProblemKind::NotFinite,
            format!(
                "{}: has {} in frame {}, column {}; compute the clip's features again, or remove the clip from the \
                 lists",
                motion_file.display(),
                array.data[at],
                at / skeleton.features,
                at % skeleton.features
            ),
        )]);
    }
    Loaded::Clip { frames, features: array.data, texts }
}

fn parse_text(file: &Path, content: std::io::Result<Vec<u8>>) -> Result<Texts, Vec<Problem>> {
    let content = content.map_err(|e| vec![Problem::new(ProblemKind::Io, format!("{}: {e}", file.display()))])?;
    let content = String::from_utf8(content).map_err(|e| {
        let line = e.as_bytes()[..e.utf8_error().valid_up_to()].iter().filter(|b| **b == b'\n').count() + 1;
        vec![Problem::new(ProblemKind::Text, format!("{}:{line}: not UTF-8 text", file.display()))]
    })?;
    text::parse_file(file, &content)
        .map_err(|errors| errors.iter().map(|e| Problem::new(ProblemKind::Text, e.to_string())).collect())
}

fn check_motion(file: &Path, array: npy::Array, skeleton: &Skeleton) -> Result<npy::Array, Problem> {
    let expected = skeleton.features;
    match array.shape[..] {
        [_, width] if width == expected => Ok(array),
        [_, width] => {
            let other = if width == 251 || width == 263 { "; check dataset.format" } else { "" };
            let what = format!("{}: has {width} features per frame; expected {expected}{other}", file.display());
            Err(Problem::new(ProblemKind::Shape, what))
        }
        _ => {
            let what = format!("{}: has shape {:?}; expected [frames, {expected}]", file.display(), array.shape);
            Err(Problem::new(ProblemKind::Shape, what))
        }
    }
}
