//! Converts recordings to a dataset: joints, features, mirrored twins, splits and statistics.
//!
//! Source of the steps: the published HumanML3D procedure (20 fps, uniform skeleton, features, `M` clips, Mean and Std
//! over all clips of all splits). KIT-ML has 12.5 fps and 21 joints, computed from the 22 by `kit_joints`. Departs:
//! clips that are too long for the loaders are cut into equal parts instead of being left out. A split takes whole
//! recordings, so that no part and no mirrored twin of a test clip is in the training data.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use motion::dataset::{Clip, Split, Unusable, statistics};
use motion::features::{extract, mirror_joints};
use motion::quaternion::{self as quat, Vec3};
use motion::random::Stream;
use motion::text::Caption;
use motion::{DataPath, Dataset, Skeleton};
use protocol::Seed;
use protocol::stage::DataFormat;
use protocol::units::counted;
use serde::{Deserialize, Serialize};

use crate::arrays;
use crate::bvh::{Bvh, MAX_SECONDS};
use crate::captions::mirrored;
use crate::detect::{Up, detect};
use crate::listing::ClipFile;
use crate::take::{Reading, Take, resample};

/// Settings of the conversion.
#[derive(Debug, Clone)]
pub struct Recipe {
    pub format: DataFormat,
    /// Joint map, unit and axis; fields that are `None` are detected for each file.
    pub reading: Reading,
    /// Frame rate of arrays without one; `None` is 20 for 22 joints and 12.5 for KIT-ML's 21, as in the published sets.
    pub rate: Option<f64>,
    /// Bone lengths `[J]` of the uniform skeleton; `None` is the format's own.
    pub target: Option<Vec<f64>>,
    /// Adds a mirrored twin of every clip.
    pub mirror: bool,
    /// Cuts clips that are too long; otherwise they are left out.
    pub cut: bool,
}

/// A clip with its features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Made {
    pub id: String,
    /// The recording that the clip belongs to.
    pub source: String,
    pub listed: Option<Split>,
    pub captions: Vec<Caption>,
    pub frames: usize,
    /// Rows `[frames, D]`, stored separately.
    #[serde(skip)]
    pub features: Vec<f32>,
}

/// Reason for leaving out a clip, a part of it or a caption.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Why {
    TooShort,
    TooLong,
    NoCaption,
    /// The span of a caption has too few or too many frames.
    CaptionSpan,
    /// The folder's own lists do not have the clip.
    NotListed,
    /// The file cannot be read.
    Broken,
}

impl Why {
    /// The reason in words, after a count.
    pub fn words(self) -> &'static str {
        match self {
            Self::TooShort => "too short to train on",
            Self::TooLong => "too long; `cut: true` cuts such recordings",
            Self::NoCaption => {
                "without a caption; `trainer data captions FOLDER` writes captions by file name to correct"
            }
            Self::CaptionSpan => "captions of a span that is too short or too long",
            Self::NotListed => "in none of train.txt, val.txt and test.txt",
            Self::Broken => "that cannot be read",
        }
    }
}

/// A clip, a part of it or a caption that was left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    pub why: Why,
    /// Its name, and numbers.
    pub what: String,
}

impl LeftOut {
    /// Creates an entry.
    pub fn new(why: Why, what: String) -> Self {
        Self { why, what }
    }
}

/// Result of one file.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct FromFile {
    pub clips: Vec<Made>,
    /// The interpretation of the file.
    pub said: String,
    /// The upward axis of the file.
    pub up: String,
    /// Parts that were left out.
    pub left_out: Vec<LeftOut>,
}

/// Reads the joints of `file` as `[T, J, 3]`, mapped to the skeleton of the recipe's format and resampled to its frame
/// rate. Also returns a description of how the file was read, and its up axis.
///
/// # Errors
/// If the file cannot be read or mapped. The message names the file.
pub fn joints(file: &DataPath, recipe: &Recipe) -> Result<(Vec<f32>, String, Up), String> {
    let skeleton = Skeleton::of(recipe.format);
    let is_bvh = file.shown().extension().is_some_and(|e| e.eq_ignore_ascii_case("bvh"));
    let (take, width) = if is_bvh {
        let bvh = Bvh::read(file).map_err(|e| e.to_string())?;
        (Take::of_bvh(&bvh, &recipe.reading).map_err(|e| format!("{}: {e}", file.display()))?, 66)
    } else {
        of_array(file, recipe)?
    };
    let joints = resample(&take.joints, width, take.rate, skeleton.fps);
    let joints: Vec<f64> = match (width / 3 == skeleton.joints, recipe.format) {
        (true, _) => joints,
        (false, DataFormat::Kit) => joints.chunks_exact(66).flat_map(kit_joints).collect(),
        (false, DataFormat::Humanml3d) => {
            return Err(format!(
                "{}: has 21 joints, as in KIT-ML; expected at least 22, or `format: kit`",
                file.display()
            ));
        }
    };
    let rate = if (take.rate - skeleton.fps).abs() < 1e-9 {
        String::new()
    } else {
        format!(", {} fps to {}", take.rate, skeleton.fps)
    };
    Ok((joints.into_iter().map(|v| v as f32).collect(), take.said + &rate, take.up))
}

/// Reads arrays unchanged from `.npy`, as metres and y up by default; the axis of `.npz` is detected.
fn of_array(file: &DataPath, recipe: &Recipe) -> Result<(Take, usize), String> {
    let found = arrays::read(file)?;
    let format = if found.joints == 21 { DataFormat::Kit } else { DataFormat::Humanml3d };
    let rate = found.rate.or(recipe.rate).unwrap_or(Skeleton::of(format).fps);
    let seconds = found.data.len() as f64 / (3 * found.joints) as f64 / rate;
    if seconds > MAX_SECONDS {
        return Err(format!(
            "{}: lasts {seconds:.0} s at {rate} fps; expected at most {MAX_SECONDS} s",
            file.display()
        ));
    }
    let wide: Vec<f64> = found.data.iter().map(|v| f64::from(*v)).collect();
    let points = |frame: &[f64]| -> Vec<Vec3> { frame.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect() };
    let zipped = file.shown().extension().is_some_and(|e| e.eq_ignore_ascii_case("npz"));
    let mut up = recipe.reading.up.unwrap_or(Up::Y);
    let mut said = format!("{} joints, {up} up", found.joints);
    if found.joints == 22 {
        let step = wide.len().div_ceil(66 * 200);
        let frames: Vec<Vec<Vec3>> = wide.chunks_exact(66).step_by(step).map(points).collect();
        let detected = detect(frames.iter().map(Vec::as_slice));
        if zipped && recipe.reading.up.is_none() && detected.sure_of_up {
            up = detected.up;
        }
        said = format!("22 joints, {up} up");
        if detected.sure_of_up && detected.up != up {
            said += &format!(" (the figure stands along {}; set `up` if that is wrong)", detected.up);
        }
    }
    let unit = recipe.reading.metres_per_unit.unwrap_or(1.0);
    let joints = wide.chunks_exact(3).flat_map(|p| up.to_y([p[0], p[1], p[2]])).map(|v| v * unit).collect();
    Ok((Take { joints, rate, up, said }, 3 * found.joints))
}

/// The 21 joints of KIT-ML's skeleton from the 22 `[22, 3]`: hip centre, spine, arms and legs with right before left.
/// The midfoot is two fifths of the way from the ankle to the foot.
fn kit_joints(frame: &[f64]) -> Vec<f64> {
    let at = |j: usize| -> Vec3 { [frame[3 * j], frame[3 * j + 1], frame[3 * j + 2]] };
    let between = |a: usize, b: usize, part: f64| quat::add(at(a), quat::scale(quat::sub(at(b), at(a)), part));
    let leg =
        |side: usize| [at(1 + side), at(4 + side), at(7 + side), between(7 + side, 10 + side, 0.4), at(10 + side)];
    let arm = |side: usize| [at(16 + side), at(18 + side), at(20 + side)];
    let body = [between(1, 2, 0.5), at(3), at(9), at(12), at(15)];
    body.into_iter().chain(arm(1)).chain(arm(0)).chain(leg(1)).chain(leg(0)).flatten().collect()
}

/// Makes the clips of a file: its parts, and the mirrored twin of each.
///
/// # Errors
/// If the file is broken, or its figure has no features.
pub fn clips_of(file: &ClipFile, recipe: &Recipe) -> Result<FromFile, String> {
    let skeleton = Skeleton::of(recipe.format);
    let (joints, said, up) = joints(&file.path, recipe)?;
    let width = 3 * skeleton.joints;
    let frames = (joints.len() / width).saturating_sub(1);
    let mut made = FromFile { said, up: up.to_string(), ..FromFile::default() };
    if frames < skeleton.min_frames {
        let what = format!("{}: {frames} frames at {} fps, needs {}", file.id, skeleton.fps, skeleton.min_frames);
        made.left_out.push(LeftOut::new(Why::TooShort, what));
        return Ok(made);
    }
    // The largest length of an example.
    let most = skeleton.max_frames - skeleton.unit;
    let parts = if frames < skeleton.max_frames { 1 } else { frames.div_ceil(most) };
    if parts > 1 && !recipe.cut {
        let what = format!("{}: {frames} frames, must be below {}", file.id, skeleton.max_frames);
        made.left_out.push(LeftOut::new(Why::TooLong, what));
        return Ok(made);
    }
    for part in 0..parts {
        let start = frames * part / parts;
        let end = frames * (part + 1) / parts;
        // The frame after the last supplies velocities.
        let part_joints = &joints[start * width..(end + 1) * width];
        let id = if parts == 1 { file.id.clone() } else { format!("{}-{}", file.id, part + 1) };
        let captions =
            captions_within(&file.captions, start as f64 / skeleton.fps, end as f64 / skeleton.fps, parts > 1);
        if captions.is_empty() {
            made.left_out.push(LeftOut::new(Why::NoCaption, format!("{id}: no caption")));
            continue;
        }
        let versions = [false, true].into_iter().filter(|twin| !twin || recipe.mirror);
        for twin in versions {
            let (id, captions, of_twin) = match twin {
                false => (id.clone(), captions.clone(), None),
                true => (
                    format!("M{id}"),
                    captions.iter().map(mirrored).collect(),
                    Some(mirror_joints(part_joints, skeleton)),
                ),
            };
            let features = extract(of_twin.as_deref().unwrap_or(part_joints), skeleton, recipe.target.as_deref())
                .map_err(|e| format!("{}: clip `{id}`: {e}", file.path.display()))?;
            let frames = features.len() / skeleton.features;
            made.clips.push(Made { id, source: file.source.clone(), listed: file.listed, captions, frames, features });
        }
    }
    Ok(made)
}

/// Captions of a part of a recording. A caption of the whole recording applies to every part; others are shifted and
/// cut to the part.
fn captions_within(captions: &[Caption], from: f64, to: f64, cut: bool) -> Vec<Caption> {
    let within = |caption: &Caption| {
        if !cut || caption.is_whole() {
            return Some(caption.clone());
        }
        let from_s = (caption.from_s - from).max(0.0);
        let to_s = caption.to_s.min(to) - from;
        (from_s < to_s).then(|| Caption { from_s, to_s, ..caption.clone() })
    };
    captions.iter().filter_map(within).collect()
}

/// Division of clips into splits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Division {
    /// By the folder's own lists.
    Lists,
    /// Whole recordings, assigned by draws that their names key.
    Sources {
        seed: Seed,
        /// Share of validation clips.
        val: f64,
        test: f64,
    },
}

/// Report on a folder.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Report {
    /// Number of files by interpretation, with an example of each.
    pub read: BTreeMap<String, (usize, String)>,
    /// Number of files by upward axis, with an example of each.
    pub axes: BTreeMap<String, (usize, String)>,
    pub left_out: Vec<LeftOut>,
    pub notes: Vec<String>,
    /// Number of recordings and clips of each split.
    pub splits: BTreeMap<Split, (usize, usize)>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (said, (files, one)) in &self.read {
            writeln!(f, "{} such as {one}: {said}", counted(*files, "file"))?;
        }
        for (split, (sources, clips)) in &self.splits {
            writeln!(f, "{split}: {} of {}", counted(*clips, "clip"), counted(*sources, "recording"))?;
        }
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        writeln!(f, "left out: {}", self.left_out.len())?;
        for (why, (count, _)) in self.reasons() {
            writeln!(f, "  {count} {}", why.words())?;
        }
        if !self.left_out.is_empty() {
            writeln!(f, "each of them:")?;
        }
        self.left_out.iter().try_for_each(|left| writeln!(f, "  {}", left.what))
    }
}

impl Report {
    /// The number of omissions by reason, with an example of each.
    pub fn reasons(&self) -> BTreeMap<Why, (usize, &str)> {
        let mut reasons = BTreeMap::new();
        for left in &self.left_out {
            reasons.entry(left.why).or_insert((0, left.what.as_str())).0 += 1;
        }
        reasons
    }

    /// Counts a file, and adds its omissions.
    pub fn add(&mut self, id: &str, file: &FromFile) {
        self.read.entry(file.said.clone()).or_insert_with(|| (0, id.to_owned())).0 += 1;
        self.axes.entry(file.up.clone()).or_insert_with(|| (0, id.to_owned())).0 += 1;
        self.left_out.extend(file.left_out.iter().cloned());
    }

    /// Reports files whose axis differs from that of most files: a lying figure is easily mistaken for a standing one.
    pub fn compare_axes(&mut self) {
        let most = self.axes.iter().max_by_key(|(_, (files, _))| *files).map(|(axis, _)| axis.clone());
        let Some(most) = most else { return };
        for (axis, (files, one)) in self.axes.iter().filter(|(axis, _)| **axis != most) {
            let few = format!("{} such as {one} read with {axis} up, most with {most}", counted(*files, "file"));
            self.notes.push(format!("{few}; set `up` if that is wrong"));
        }
    }
}

/// Makes a dataset of clips. Their order is kept; entries are sorted by split. As in the loaders, a caption with times
/// is an entry of its own if it has enough frames.
///
/// # Errors
/// If clips of one recording are in two lists, clips are in no list, or the training split is empty.
pub fn assemble(
    format: DataFormat,
    made: Vec<Made>,
    division: Division,
    report: &mut Report,
) -> Result<Dataset, String> {
    let skeleton = Skeleton::of(format);
    let splits = divide(&made, division)?;
    let mut dataset = Dataset { format, mean: vec![], std: vec![], clips: vec![], captions: vec![], entries: vec![] };
    let mut sources: BTreeMap<Split, BTreeSet<String>> = BTreeMap::new();
    for (made, split) in made.into_iter().zip(splits) {
        let Some(split) = split else {
            report.left_out.push(LeftOut::new(Why::NotListed, format!("{}: not listed", made.id)));
            continue;
        };
        let clip = dataset.clips.len();
        let lines = (1..=made.captions.len()).zip(dataset.captions.len()..).collect::<Vec<_>>();
        dataset.captions.extend(made.captions);
        dataset.clips.push(Clip { id: made.id.clone(), frames: made.frames, features: made.features.into() });
        let before = dataset.entries.len();
        for Unusable { line, start, end } in dataset.add_entries(clip, split, &lines) {
            let what = format!("{}: caption {line} describes frames {start} to {end}, too few or too many", made.id);
            report.left_out.push(LeftOut::new(Why::CaptionSpan, what));
        }
        if dataset.entries.len() == before {
            report.left_out.push(LeftOut::new(Why::NoCaption, format!("{}: no usable caption", made.id)));
            continue;
        }
        sources.entry(split).or_default().insert(made.source);
        report.splits.entry(split).or_default().1 += 1;
    }
    for (split, sources) in sources {
        report.splits.entry(split).or_default().0 = sources.len();
    }
    dataset.drop_unused();
    dataset.entries.sort_by_key(|entry| entry.split);
    if dataset.entries.first().is_none_or(|entry| entry.split != Split::Train) {
        return Err(format!("no usable training clip\n{report}"));
    }
    let (mean, std) = statistics(skeleton, dataset.clips.iter().map(|clip| &*clip.features));
    dataset.mean = mean.into_iter().map(|v| v as f32).collect();
    dataset.std = std.into_iter().map(|v| v as f32).collect();
    Ok(dataset)
}

/// Assigns a split to each clip.
fn divide(made: &[Made], division: Division) -> Result<Vec<Option<Split>>, String> {
    let Division::Sources { seed, val, test } = division else {
        let mut of: BTreeMap<&str, (Split, &str)> = BTreeMap::new();
        for clip in made {
            let Some(split) = clip.listed else { continue };
            let (other, id) = *of.entry(&clip.source).or_insert((split, &clip.id));
            if other != split {
                return Err(format!(
                    "`{id}` ({other}) and `{}` ({split}) come from the same recording, `{}`; set `splits: source`, or \
                     remove one of them from the lists",
                    clip.id, clip.source
                ));
            }
        }
        return Ok(made.iter().map(|clip| clip.listed).collect());
    };
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for clip in made {
        *counts.entry(&clip.source).or_default() += 1;
    }
    // Each recording's draw is keyed by its name, so that an additional one moves few others.
    let mut order: Vec<(u64, &str)> = counts
        .keys()
        .map(|source| (Stream::new(seed, &format!("mocap/split/{source}"), 0, 0).bits(), *source))
        .collect();
    order.sort_unstable();
    let share = |part: f64| (part * made.len() as f64).round() as usize;
    let val = share(val);
    let test = share(test);
    let mut splits = BTreeMap::new();
    let mut given = 0;
    for (_, source) in order {
        let split = match given {
            given if given < test => Split::Test,
            given if given < test + val => Split::Val,
            _ => Split::Train,
        };
        given += counts[source];
        splits.insert(source, split);
    }
    Ok(made.iter().map(|clip| splits.get(clip.source.as_str()).copied()).collect())
}

/// The scales of the published evaluators: those of the set, with turn, velocity and height of the root and the
/// contacts divided by 25, which increases their weight.
///
/// Source: the text-to-motion evaluators' `feat_bias`; the published files have ratios of 24.9 to 25.3.
pub fn evaluator_std(skeleton: &Skeleton, std: &[f32]) -> Vec<f32> {
    const BIAS: f32 = 25.0;
    let layout = skeleton.layout();
    let mut std = std.to_vec();
    for group in [layout.yaw, layout.root_velocity, layout.root_height, layout.contacts] {
        std[group].iter_mut().for_each(|v| *v /= BIAS);
    }
    std
}

/// Evenly spread indices of at most `most` of `count` clips, for a picture.
pub fn spread(count: usize, most: usize) -> Vec<usize> {
    let shown = count.min(most);
    (0..shown).map(|i| i * count / shown.max(1)).collect()
}

/// Reads a table of bone lengths: `.npy` of offsets `[J, 3]` or lengths `[J]`.
///
/// # Errors
/// A message that names the file.
pub fn read_target(file: &DataPath, skeleton: &Skeleton) -> Result<Vec<f64>, String> {
    let array = motion::npy::read_any_float(file).map_err(|e| e.to_string())?;
    let joints = skeleton.joints;
    let lengths = match array.shape[..] {
        [n, 3] if n == joints => skeleton.lengths_of_offsets(&array.data),
        [n] if n == joints => array.data.iter().map(|v| f64::from(*v)).collect(),
        _ => {
            return Err(format!(
                "{}: has shape {:?}; expected offsets [{joints}, 3] or lengths [{joints}]",
                file.display(),
                array.shape
            ));
        }
    };
    match (1..joints).find(|j| !(lengths[*j].is_finite() && lengths[*j] > 0.0)) {
        None => Ok(lengths),
        Some(j) => Err(format!(
            "{}: the bone to `{}` has length {}; expected a positive number",
            file.display(),
            skeleton.names[j],
            lengths[j]
        )),
    }
}
