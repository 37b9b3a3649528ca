//! `data.features`: converts a folder of recordings to a dataset.
//!
//! A shard reads a part of the folder's clips, in the order of their ids. The merge divides them into splits, computes
//! the statistics and draws a sheet. The result for a clip depends on its file alone, so the dataset does not depend on
//! the division into shards.
//!
//! Files besides the dataset's: `report.txt` (the interpretation of files, and the reasons for those left out),
//! `contact-sheet.png`, and `evaluator-mean.npy` and `evaluator-std.npy`, the statistics in the form of the published
//! evaluators.

use std::collections::BTreeMap;

use mocap::corpus::{self, Division, FromFile, LeftOut, Made, Recipe, Report, Why};
use mocap::detect::Up;
use mocap::joint_map::{JointMap, MapError};
use mocap::listing::{Listing, list};
use mocap::take::Reading;
use motion::features::recover_joints;
use motion::{Dataset, Skeleton, draw, npy};
use protocol::stage::{DataFeatures, Splits, UpAxis};
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, Draft, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::dataset::{Extra, SOURCES_FILE, pack};
use crate::external::{self, Given};
use crate::kinds::shape::Map;
use crate::shards::shard_range;
use crate::stand_in;

/// File of a shard's features, all clips one after the other.
const FEATURES_FILE: &str = "features.safetensors";
/// File of the other data of a shard's clips.
const CLIPS_FILE: &str = "clips.json";
/// File of the picture of some clips.
const SHEET_FILE: &str = "contact-sheet.png";
/// Number of motions and poses on the sheet.
const SHEET: (usize, usize) = (24, 10);

/// Meta of a shard.
#[derive(Debug, Serialize, Deserialize)]
struct ShardMeta {
    /// Index of the shard's first file.
    first: usize,
    files: usize,
}

/// Result of reading one file.
#[derive(Debug, Serialize, Deserialize)]
struct File {
    id: String,
    /// Clips without their features, or the error.
    read: Result<FromFile, String>,
}

impl Map for DataFeatures {
    fn stand_in(&self, cx: &mut dyn AttemptContext) -> Option<Result<Digest, StageError>> {
        Some(stand_in::dataset(cx, self.format))
    }

    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        external::read(cx, |cx, given| read_shard(self, cx, given, (index, of)))
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let notes = external::read(cx, |_, given| Ok(listing(given)?.notes))?;
        let mut report = Report { notes, ..Report::default() };
        let mut made = Vec::new();
        let mut broken = Vec::new();
        let mut have = 0;
        for digest in shards {
            let manifest = cx.manifest(*digest)?;
            let ShardMeta { first, files } = artifacts::meta(&manifest, "a shard of the recordings")?;
            if first != have {
                return Err(StageError::Fault(format!(
                    "a shard begins at file {first}, but the previous shard ended at file {have}"
                )));
            }
            have += files;
            collect(cx, &manifest, self, &mut made, &mut report, &mut broken)?;
        }
        if !broken.is_empty() && !self.skip_broken {
            let all = Broken { count: have, broken: &broken };
            return Err(StageError::Input(all.to_string()));
        }
        report.left_out.extend(broken.into_iter().map(|what| LeftOut::new(Why::Broken, what)));
        report.compare_axes();
        let division = match self.splits {
            Splits::Lists => Division::Lists,
            Splits::Source => Division::Sources { seed: cx.task().seed, val: self.val, test: self.test },
        };
        let sources: BTreeMap<String, String> =
            made.iter().map(|clip| (clip.id.clone(), clip.source.clone())).collect();
        let dataset = corpus::assemble(self.format, made, division, &mut report).map_err(StageError::Input)?;
        let mut extras = extras(&dataset)?;
        let sources = serde_json::to_vec(&sources).map_err(|e| StageError::Fault(e.to_string()))?;
        extras.push((SOURCES_FILE, sources));
        for note in &report.notes {
            cx.log(&format!("warning: {note}"));
        }
        for (why, (count, one)) in report.reasons() {
            cx.log(&format!("left out: {count} {}; such as {one}", why.words()));
        }
        let skipped = report.left_out.len();
        pack(cx, &dataset, skipped, report.to_string(), extras)
    }
}

/// The clips of a shard's files.
fn read_shard(
    settings: &DataFeatures,
    cx: &mut dyn AttemptContext,
    given: &Given,
    (index, of): (usize, usize),
) -> Result<Outcome, StageError> {
    let recipe = recipe(settings, given)?;
    let listing = listing(given)?;
    let range = shard_range(listing.clips.len(), index, of);
    let mut files = Vec::new();
    let mut features = Vec::new();
    for (done, clip) in listing.clips[range.clone()].iter().enumerate() {
        if cx.interrupted() {
            return Ok(Outcome::Yielded { at: 0 });
        }
        let mut read = corpus::clips_of(clip, &recipe);
        if let Ok(read) = &mut read {
            read.clips.iter_mut().for_each(|clip| features.append(&mut clip.features));
        }
        files.push(File { id: clip.id.clone(), read });
        cx.progress(done as u64 + 1, range.len() as u64, "recordings", &[]);
    }
    let width = Skeleton::of(settings.format).features;
    let metrics = BTreeMap::from([("frames".to_owned(), (features.len() / width) as f64)]);
    let meta = ShardMeta { first: range.start, files: files.len() };
    let mut draft = Draft::new(cx, ArtifactKind::Shard, to_meta(&meta));
    let clips = serde_json::to_vec(&files).map_err(|e| StageError::Fault(e.to_string()))?;
    draft.add(CLIPS_FILE, clips)?;
    let shape = [features.len() / width, width];
    draft.add(FEATURES_FILE, Tensors::default().with("features", shape, features).to_bytes()?)?;
    Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
}

/// Adds a shard's clips with their features, and its broken files.
fn collect(
    cx: &mut dyn AttemptContext,
    manifest: &protocol::Manifest,
    settings: &DataFeatures,
    made: &mut Vec<Made>,
    report: &mut Report,
    broken: &mut Vec<String>,
) -> Result<(), StageError> {
    let blobs = cx.blobs();
    let damaged = |what: String| StageError::Fault(format!("{CLIPS_FILE}: {what}"));
    let clips = artifacts::file(&*blobs, manifest, CLIPS_FILE)?;
    let files: Vec<File> = serde_json::from_slice(&clips).map_err(|e| damaged(e.to_string()))?;
    let bytes = artifacts::mapped(&*blobs, manifest, FEATURES_FILE)?;
    let features = Tensors::from_bytes(bytes, FEATURES_FILE)?.take("features", 2, FEATURES_FILE)?;
    let width = Skeleton::of(settings.format).features;
    let mut rest: &[f32] = &features.values;
    for File { id, read } in files {
        match read {
            Ok(read) => {
                report.add(&id, &read);
                for mut clip in read.clips {
                    let (own, others) = rest
                        .split_at_checked(clip.frames * width)
                        .ok_or_else(|| damaged(format!("`{}` has more frames than the file of features", clip.id)))?;
                    clip.features = own.to_vec();
                    rest = others;
                    made.push(clip);
                }
            }
            Err(what) => broken.push(what),
        }
    }
    Ok(())
}

/// Messages about files that cannot be read.
struct Broken<'a> {
    count: usize,
    broken: &'a [String],
}

impl std::fmt::Display for Broken<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        const SHOWN: usize = 40;
        write!(f, "{} of {} recordings cannot be read", self.broken.len(), self.count)?;
        for what in self.broken.iter().take(SHOWN) {
            write!(f, "\n  {what}")?;
        }
        if self.broken.len() > SHOWN {
            write!(f, "\n  ... and {} more", self.broken.len() - SHOWN)?;
        }
        write!(f, "\nrepair them, or set `skip_broken: true` to leave them out")
    }
}

fn listing(given: &Given) -> Result<Listing, StageError> {
    list(given.path("path")?, given.get("captions")).map_err(|e| StageError::Input(e.to_string()))
}

fn recipe(settings: &DataFeatures, given: &Given) -> Result<Recipe, StageError> {
    let skeleton = Skeleton::of(settings.format);
    let map = match (given.get("map"), settings.map.as_str()) {
        (Some(file), _) => Some(JointMap::read(file)),
        (None, "") => None,
        (None, name) => Some(JointMap::shipped(name).ok_or_else(|| MapError::Unknown { name: name.to_owned() })),
    };
    let map = map.transpose();
    let target = given.get("target").map(|file| corpus::read_target(file, skeleton));
    let up = match settings.up {
        UpAxis::Auto => None,
        UpAxis::X => Some(Up::X),
        UpAxis::Y => Some(Up::Y),
        UpAxis::Z => Some(Up::Z),
        UpAxis::NegativeX => Some(Up::NegativeX),
        UpAxis::NegativeY => Some(Up::NegativeY),
        UpAxis::NegativeZ => Some(Up::NegativeZ),
    };
    let given = |value: f64| (value > 0.0).then_some(value);
    Ok(Recipe {
        format: settings.format,
        reading: Reading {
            map: map.map_err(|e| StageError::Input(e.to_string()))?,
            metres_per_unit: given(settings.metres_per_unit),
            up,
        },
        rate: given(settings.fps),
        target: target.transpose().map_err(StageError::Input)?,
        mirror: settings.mirror,
        cut: settings.cut,
    })
}

/// The sheet, and the statistics for evaluators.
fn extras(dataset: &Dataset) -> Result<Vec<Extra>, StageError> {
    let skeleton = dataset.skeleton();
    let fault = |e: std::io::Error| StageError::Fault(e.to_string());
    let motions: Vec<draw::Row> = corpus::spread(dataset.entries.len(), SHEET.0)
        .into_iter()
        .map(|i| {
            let entry = &dataset.entries[i];
            let title = dataset.captions[entry.captions[0]].text.clone();
            let joints = recover_joints(dataset.features(entry), skeleton);
            draw::Row { title, note: entry.id.clone(), joints }
        })
        .collect();
    let mut sheet = Vec::new();
    draw::sheet_to(&motions, SHEET.1, skeleton, draw::Given::default(), &mut sheet).map_err(fault)?;
    let std = corpus::evaluator_std(skeleton, &dataset.std);
    let array = |values: &[f32]| npy::to_bytes(&[skeleton.features], values);
    Ok(vec![(SHEET_FILE, sheet), ("evaluator-mean.npy", array(&dataset.mean)), ("evaluator-std.npy", array(&std))])
}
