//! `evaluate.t2m`: the papers' metrics, in an evaluator's space. Source: Guo et al. (text-to-motion) and MotionLCM's protocol.
//!
//! A repeat draws a caption and a crop for every entry of the split, and a motion of the crop's length for the caption. Measured are R-precision in
//! pools of 32 and MM-Dist against the captions, FID against the crops, Diversity, MultiModality over more motions for some captions, and the
//! skating ratio. `real` measures the crops themselves, FID against a second draw of captions and crops.
//!
//! All draws are keyed by (seed, repeat, entry) and not by the stage's name, so that two models of a run are compared on the same captions, lengths
//! and noise. Motions are made in blocks that are cut from the entry's number alone, and blocks are dealt to shards in turn: what a motion is computed
//! together with does not depend on the number of shards.
//!
//! Departs: Diversity takes as many pairs as there are entries where there are fewer than 300.

use std::collections::{BTreeMap, BTreeSet};

use motion::dataset::{Dataset, crop};
use motion::features::recover_joints;
use motion::random::permutation;
use motion::{Skeleton, Stream};
use protocol::stage::{EvaluateT2m, Split};
use protocol::{ArtifactKind, Digest, Seed};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::{Map, REPORT_FILE, no_entries, word};
use crate::artifacts::{self, Tensors};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::frechet::{Gaussian, to_f64};
use crate::evaluation::interval::Interval;
use crate::evaluation::retrieval::in_groups;
use crate::evaluation::{skating, spread};
use crate::evaluator::TrainedEvaluator;
use crate::generator::{self, Batch, MotionGenerator, Texts};

/// Motions computed together.
const BLOCK: usize = 32;
/// Motions that a caption's own is ranked among.
const POOL: usize = 32;
/// Below this many motions a dimension, FID's covariances say little.
const FEW: usize = 5;
/// Where a shard's embeddings are.
const EMBEDDINGS_FILE: &str = "embeddings.safetensors";

/// What a unit of work makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Part {
    /// A block of the split's entries.
    Entries,
    /// More motions for one caption.
    Many,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
struct Unit {
    part: Part,
    repeat: usize,
    block: usize,
}

/// A caption and a crop of an entry.
#[derive(Debug, Clone, Copy)]
struct Draw {
    entry: usize,
    caption: usize,
    start: usize,
    len: usize,
}

/// What all shards and the merge agree on.
struct Plan<'a> {
    settings: &'a EvaluateT2m,
    seed: Seed,
    dataset: Dataset,
    entries: Vec<usize>,
    trained: TrainedEvaluator,
    evaluator: Digest,
    /// What they are of.
    split: Split,
}

impl<'a> Plan<'a> {
    fn read(cx: &dyn AttemptContext, settings: &'a EvaluateT2m) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let refuse = |text: String| Err(StageError::Input(text));
        let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let dataset = artifacts::dataset(&*blobs, &manifest)?;
        let (evaluator, manifest) = artifacts::input(cx, "evaluator", ArtifactKind::Evaluator)?;
        let trained = TrainedEvaluator::read(&*blobs, &manifest, &cx.device())?;
        let (mut entries, mut taken) = (dataset.entries_of(settings.split), settings.split);
        if settings.all_if_small && entries.len() < POOL {
            (entries, taken) = (dataset.entries_of(Split::All), Split::All);
        }
        if entries.is_empty() {
            return Err(no_entries(taken));
        }
        if entries.len() < POOL {
            let instead = match taken {
                Split::All => "there are no more in the dataset",
                Split::Test => "set `split: all`, or `all_if_small: true`",
                Split::Train | Split::Val => "set `split: all`, `split: test` for a last look, or `all_if_small: true`",
            };
            return refuse(format!(
                "the split `{}` has {} entries, R-precision ranks a motion among {POOL}; {instead}",
                word(&taken),
                entries.len()
            ));
        }
        trained.check(&dataset, &entries)?;
        if settings.repeats == 0 {
            return refuse("`repeats` is 0, expected at least 1".into());
        }
        Ok(Self { settings, seed: cx.task().seed, dataset, entries, split: taken, trained, evaluator })
    }

    fn stream(&self, what: &str, repeat: usize, index: usize) -> Stream {
        Stream::new(self.seed, &format!("evaluate.t2m/{what}"), repeat as u64, index as u64)
    }

    /// A caption and a crop of entry number `i` of the split, for the motions (`main`) or for real ones to compare with.
    fn draw(&self, repeat: usize, i: usize, main: bool) -> Draw {
        let entry = &self.dataset.entries[self.entries[i]];
        let mut stream = self.stream(if main { "entry" } else { "other" }, repeat, i);
        let caption = entry.captions[stream.below(entry.captions.len())];
        let (start, len) = crop(&mut stream, entry.len, self.dataset.skeleton());
        Draw { entry: self.entries[i], caption, start, len }
    }

    /// Entries whose captions MultiModality is taken over.
    fn many(&self, repeat: usize) -> Vec<usize> {
        if self.settings.real {
            return Vec::new();
        }
        let order = permutation(self.seed, "evaluate.t2m/many", repeat as u64, self.entries.len());
        order.into_iter().take(self.settings.multimodality.captions).map(|i| i as usize).collect()
    }

    fn units(&self) -> Vec<Unit> {
        let blocks = self.entries.len().div_ceil(BLOCK);
        let of = |part, repeat, blocks: usize| (0..blocks).map(move |block| Unit { part, repeat, block });
        (0..self.settings.repeats)
            .flat_map(|repeat| of(Part::Entries, repeat, blocks).chain(of(Part::Many, repeat, self.many(repeat).len())))
            .collect()
    }

    /// Entries, by number in the split, of a block.
    fn block(&self, block: usize) -> std::ops::Range<usize> {
        block * BLOCK..((block + 1) * BLOCK).min(self.entries.len())
    }

    fn crop(&self, draw: Draw) -> Vec<f32> {
        let width = self.dataset.mean.len();
        let rows = self.dataset.features(&self.dataset.entries[draw.entry]);
        rows[draw.start * width..(draw.start + draw.len) * width].to_vec()
    }
}

/// What makes motions.
struct Maker<'a> {
    generator: &'a dyn MotionGenerator,
    texts: Texts<'a>,
}

/// The model that is measured.
fn open(cx: &dyn AttemptContext, plan: &Plan<'_>) -> Result<Box<dyn MotionGenerator>, StageError> {
    let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
    let generator = generator::open(&manifest, &*cx.blobs(), &cx.device())?;
    let (ours, theirs) = (generator.format(), plan.dataset.format);
    if ours != theirs {
        return Err(StageError::Input(format!(
            "`model` draws motions of `{}`, the dataset has `{}`; measure it on the format that it was trained on",
            ours.name(),
            theirs.name()
        )));
    }
    generator::check_sampler(&*generator, &plan.settings.sampler)?;
    Ok(generator)
}

impl Maker<'_> {
    /// A motion for each draw, in the data's own scale; `seeds(k, b)` is the k-th stream of motion b, 0 for the sampler's start.
    fn motions(
        &self,
        plan: &Plan<'_>,
        draws: &[Draw],
        seeds: &dyn Fn(usize, usize) -> Stream,
    ) -> Result<Vec<Vec<f32>>, StageError> {
        let captions: Vec<usize> = draws.iter().map(|d| d.caption).collect();
        let texts = self.texts.get(&captions, |caption| plan.dataset.captions[caption].text.as_str())?;
        let lengths: Vec<usize> = draws.iter().map(|d| d.len).collect();
        let batch = Batch { texts: &texts, lengths: &lengths, seeds };
        generator::motions(self.generator, batch, &plan.settings.sampler, &mut |_| {})
    }
}

/// Share of skating steps of a motion.
fn skates(features: &[f32], skeleton: &Skeleton) -> f32 {
    let joints = recover_joints(features, skeleton);
    let metres: Vec<f64> = joints.iter().map(|v| f64::from(*v) * skeleton.metres_per_unit).collect();
    skating::ratio(&metres, skeleton.joints, skating::feet(skeleton.format), skeleton.fps) as f32
}

impl Map for EvaluateT2m {
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let generator = if self.real { None } else { Some(open(cx, &plan)?) };
        let maker = generator.as_deref().map(|generator| Maker { generator, texts: Texts::new(generator) });
        // Of either part every `of`-th, since they cost differently.
        let mine = |part: Part| -> Vec<Unit> {
            let all = plan.units().into_iter().filter(|u| u.part == part).enumerate();
            all.filter(|(i, _)| i % of == index).map(|(_, unit)| unit).collect()
        };
        let units: Vec<Unit> = mine(Part::Entries).into_iter().chain(mine(Part::Many)).collect();
        let (mut text, mut made, mut real, mut skating) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut many = Vec::new();
        for (done, unit) in units.iter().enumerate() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            match unit.part {
                Part::Entries => {
                    let block = plan.block(unit.block);
                    let draws: Vec<Draw> = block.clone().map(|i| plan.draw(unit.repeat, i, true)).collect();
                    let crops: Vec<Vec<f32>> = draws.iter().map(|d| plan.crop(*d)).collect();
                    text.extend(plan.trained.captions(draws.iter().map(|d| &plan.dataset.captions[d.caption])));
                    let motions = match &maker {
                        Some(maker) => {
                            real.extend(plan.trained.motions(&crops));
                            maker.motions(&plan, &draws, &|k, b| {
                                plan.stream(&format!("noise {k}"), unit.repeat, block.start + b)
                            })?
                        }
                        None => {
                            let others = block.map(|i| plan.crop(plan.draw(unit.repeat, i, false)));
                            real.extend(plan.trained.motions(&others.collect::<Vec<_>>()));
                            crops
                        }
                    };
                    skating.extend(motions.iter().map(|motion| skates(motion, plan.dataset.skeleton())));
                    made.extend(plan.trained.motions(&motions));
                }
                Part::Many => {
                    let maker = maker.as_ref().ok_or_else(|| StageError::Fault("real motion has no samples".into()))?;
                    let entry = plan.many(unit.repeat)[unit.block];
                    let draw = plan.draw(unit.repeat, entry, true);
                    let samples = self.multimodality.samples;
                    for first in (0..samples).step_by(BLOCK) {
                        let count = BLOCK.min(samples - first);
                        let motions = maker.motions(&plan, &vec![draw; count], &|k, b| {
                            plan.stream(&format!("many {k}"), unit.repeat, entry * samples + first + b)
                        })?;
                        many.extend(plan.trained.motions(&motions));
                    }
                }
            }
            cx.progress(done as u64 + 1, units.len() as u64, "blocks", &[]);
        }
        let width = plan.trained.width();
        let rows = |values: &[f32]| [values.len() / width, width];
        let skated = skating.len();
        let bytes = Tensors::default()
            .with("text", rows(&text), text)
            .with("made", rows(&made), made)
            .with("real", rows(&real), real)
            .with("many", rows(&many), many)
            .with("skating", [skated], skating)
            .to_bytes()?;
        let output = artifacts::publish(cx, ArtifactKind::Shard, json!({"units": units}), EMBEDDINGS_FILE, bytes)?;
        Ok(Outcome::Finished { output, metrics: BTreeMap::new() })
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let all = gather(cx, &plan, shards)?;
        let mut values: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        for repeat in 0..self.repeats {
            for (name, value) in measure(&plan, &all, repeat) {
                values.entry(name).or_default().push(value);
            }
        }
        let mut metrics = BTreeMap::new();
        for (name, values) in &values {
            let interval = Interval::of(values);
            metrics.insert((*name).to_owned(), interval.mean);
            metrics.insert(format!("{name}.lower"), interval.lower());
            metrics.insert(format!("{name}.upper"), interval.upper());
        }
        if let Some((name, value)) = metrics.iter().find(|(_, value)| !value.is_finite()) {
            return Err(StageError::Input(format!(
                "`{name}` is {value}: embeddings are not finite; train the evaluator anew"
            )));
        }
        let (samples, width) = (plan.entries.len(), plan.trained.width());
        let few = (samples < FEW * width).then(|| {
        format!(
            "FID is taken of {samples} motions in {width} dimensions; it is then larger than of many, and compares only with FIDs of as many \
             motions in the same evaluator"
        )
    });
        if let Some(few) = &few {
            cx.log(few);
        }
        if plan.split != self.split {
            cx.log(&format!(
                "the split `{}` is too small for pools of {POOL}: measured on all {samples} entries",
                word(&self.split)
            ));
        }
        metrics.insert("samples".to_owned(), samples as f64);
        let drawn = super::drawn(cx)?;
        let meta = json!({
            "kind": cx.task().settings.kind(),
            "metrics": metrics,
            "drawn": drawn,
            "split": plan.split,
            "evaluator": plan.evaluator,
            "words": plan.trained.meta().words,
            "real": self.real,
            "shuffled": self.shuffled,
        });
        let report = json!({
            "metrics": metrics,
            "details": {
                "split": plan.split,
                "seed": plan.seed,
                "sampler": self.sampler,
                "samples_per_repeat": samples,
                "pools_per_repeat": samples / POOL,
                "diversity_pairs": spread::DIVERSITY_PAIRS.min(samples),
                "note": few,
                "repeats": values,
            },
        });
        let bytes = protocol::canonical::to_bytes(&report);
        let output = artifacts::publish(cx, ArtifactKind::Report, meta, REPORT_FILE, bytes)?;
        Ok(Outcome::Finished { output, metrics })
    }
}

/// Everything that the shards made, by unit.
#[derive(Default)]
struct Gathered {
    text: BTreeMap<Unit, Vec<f64>>,
    made: BTreeMap<Unit, Vec<f64>>,
    real: BTreeMap<Unit, Vec<f64>>,
    many: BTreeMap<Unit, Vec<f64>>,
    skating: BTreeMap<Unit, Vec<f64>>,
}

fn gather(cx: &dyn AttemptContext, plan: &Plan<'_>, shards: &[Digest]) -> Result<Gathered, StageError> {
    #[derive(Deserialize)]
    struct ShardMeta {
        units: Vec<Unit>,
    }
    let (blobs, width) = (cx.blobs(), plan.trained.width());
    let mut all = Gathered::default();
    for digest in shards {
        let manifest = cx.manifest(*digest)?;
        let ShardMeta { units } = artifacts::meta(&manifest, "a shard of the evaluation")?;
        let bytes = artifacts::mapped(&*blobs, &manifest, EMBEDDINGS_FILE)?;
        let mut tensors = Tensors::from_bytes(bytes, EMBEDDINGS_FILE)?;
        let mut take =
            |name: &str, rank| Ok::<_, StageError>(to_f64(&tensors.take(name, rank, EMBEDDINGS_FILE)?.values));
        let (text, made, real) = (take("text", 2)?, take("made", 2)?, take("real", 2)?);
        let (many, skating) = (take("many", 2)?, take("skating", 1)?);
        let (mut row, mut extra) = (0, 0);
        for unit in units {
            match unit.part {
                Part::Entries => {
                    let rows = row..row + plan.block(unit.block).len();
                    let cut = |values: &[f64]| values[rows.start * width..rows.end * width].to_vec();
                    all.text.insert(unit, cut(&text));
                    all.made.insert(unit, cut(&made));
                    all.real.insert(unit, cut(&real));
                    all.skating.insert(unit, skating[rows.clone()].to_vec());
                    row = rows.end;
                }
                Part::Many => {
                    let end = extra + plan.settings.multimodality.samples;
                    all.many.insert(unit, many[extra * width..end * width].to_vec());
                    extra = end;
                }
            }
        }
    }
    let found: BTreeSet<Unit> = all.made.keys().chain(all.many.keys()).copied().collect();
    let expected: BTreeSet<Unit> = plan.units().into_iter().collect();
    if found != expected {
        return Err(StageError::Fault(format!("{} blocks of motions, expected {}", found.len(), expected.len())));
    }
    Ok(all)
}

/// The rows of `values` in the order of `rows`.
fn reorder(values: &[f64], rows: &[u32], width: usize) -> Vec<f64> {
    rows.iter().flat_map(|row| values[*row as usize * width..(*row as usize + 1) * width].iter().copied()).collect()
}

/// The metrics of one repeat.
fn measure(plan: &Plan<'_>, all: &Gathered, repeat: usize) -> BTreeMap<&'static str, f64> {
    let (width, n) = (plan.trained.width(), plan.entries.len());
    let of = |parts: &BTreeMap<Unit, Vec<f64>>| -> Vec<f64> {
        parts.iter().filter(|(unit, _)| unit.repeat == repeat).flat_map(|(_, values)| values.iter().copied()).collect()
    };
    let order = |what: &str| permutation(plan.seed, &format!("evaluate.t2m/{what}"), repeat as u64, n);
    let (text, made, real, skating) = (of(&all.text), of(&all.made), of(&all.real), of(&all.skating));
    let pools = order("pools");
    let dealt = if plan.settings.shuffled { order("shuffled") } else { pools.clone() };
    let found = in_groups(&reorder(&text, &dealt, width), &reorder(&made, &pools, width), width, POOL);
    let pairs = spread::DIVERSITY_PAIRS.min(n);
    let drawn = |what: &str| order(what).into_iter().take(pairs).map(|i| i as usize).collect::<Vec<_>>();
    let mut metrics = BTreeMap::from([
        ("fid", Gaussian::fit(&real, width).distance(&Gaussian::fit(&made, width)).max(0.0)),
        ("r_precision_top1", found.top[0]),
        ("r_precision_top2", found.top[1]),
        ("r_precision_top3", found.top[2]),
        ("mm_dist", found.matching_score),
        ("diversity", spread::diversity(&made, width, &drawn("diversity 1"), &drawn("diversity 2"))),
        ("skating_ratio", skating.iter().sum::<f64>() / n as f64),
    ]);
    let many = of(&all.many);
    if !many.is_empty() {
        let of = plan.settings.multimodality;
        let drawn = |what: &str| -> Vec<usize> {
            let order = permutation(plan.seed, &format!("evaluate.t2m/{what}"), repeat as u64, of.samples);
            order.into_iter().take(of.pairs).map(|i| i as usize).collect()
        };
        let (first, second) = (drawn("multimodality 1"), drawn("multimodality 2"));
        metrics.insert("multimodality", spread::multimodality(&many, of.samples, width, &first, &second));
    }
    metrics
}
