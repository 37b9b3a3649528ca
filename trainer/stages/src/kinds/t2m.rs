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

use motion::Stream;
use protocol::stage::EvaluateT2m;
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::entry_draws::{BLOCK, Draw, EntryDraws, POOL, finite, skates};
use super::{Map, REPORT_FILE};
use crate::artifacts::{self, Tensors};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::frechet::to_f64;
use crate::evaluation::interval::Interval;
use crate::evaluation::spread;
use crate::generator::{self, Batch, MotionGenerator, Texts};

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

/// What all shards and the merge agree on.
struct Plan<'a> {
    settings: &'a EvaluateT2m,
    of: EntryDraws,
}

impl<'a> Plan<'a> {
    fn read(cx: &dyn AttemptContext, settings: &'a EvaluateT2m) -> Result<Self, StageError> {
        let of = EntryDraws::read(cx, settings.split, settings.all_if_small, settings.repeats)?;
        Ok(Self { settings, of })
    }

    /// Entries whose captions MultiModality is taken over.
    fn many(&self, repeat: usize) -> Vec<usize> {
        if self.settings.real {
            return Vec::new();
        }
        let order = self.of.order("many", repeat, self.of.entries.len());
        order.into_iter().take(self.settings.multimodality.captions).map(|i| i as usize).collect()
    }

    fn units(&self) -> Vec<Unit> {
        let of = |part, repeat, blocks: usize| (0..blocks).map(move |block| Unit { part, repeat, block });
        let both =
            |repeat| of(Part::Entries, repeat, self.of.blocks()).chain(of(Part::Many, repeat, self.many(repeat).len()));
        (0..self.settings.repeats).flat_map(both).collect()
    }
}

/// What makes motions.
struct Maker<'a> {
    generator: &'a dyn MotionGenerator,
    texts: Texts<'a>,
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
        let texts = self.texts.get(&captions, |caption| plan.of.dataset.captions[caption].text.as_str())?;
        let lengths: Vec<usize> = draws.iter().map(|d| d.len).collect();
        let batch = Batch { texts: &texts, lengths: &lengths, seeds, control: None };
        generator::motions(self.generator, batch, &plan.settings.sampler, &mut |_| {})
    }
}

impl Map for EvaluateT2m {
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let generator = if self.real { None } else { Some(plan.of.open(cx, &self.sampler)?) };
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
                    let block = plan.of.block(unit.block);
                    let draws: Vec<Draw> = block.clone().map(|i| plan.of.draw(unit.repeat, i, true)).collect();
                    let crops: Vec<Vec<f32>> = draws.iter().map(|d| plan.of.crop(*d)).collect();
                    text.extend(plan.of.trained.captions(draws.iter().map(|d| &plan.of.dataset.captions[d.caption])));
                    let motions = match &maker {
                        Some(maker) => {
                            real.extend(plan.of.trained.motions(&crops));
                            maker.motions(&plan, &draws, &|k, b| {
                                plan.of.stream(&format!("noise {k}"), unit.repeat, block.start + b)
                            })?
                        }
                        None => {
                            let others = block.map(|i| plan.of.crop(plan.of.draw(unit.repeat, i, false)));
                            real.extend(plan.of.trained.motions(&others.collect::<Vec<_>>()));
                            crops
                        }
                    };
                    skating.extend(motions.iter().map(|motion| skates(motion, plan.of.dataset.skeleton())));
                    made.extend(plan.of.trained.motions(&motions));
                }
                Part::Many => {
                    let maker = maker.as_ref().ok_or_else(|| StageError::Fault("real motion has no samples".into()))?;
                    let entry = plan.many(unit.repeat)[unit.block];
                    let draw = plan.of.draw(unit.repeat, entry, true);
                    let samples = self.multimodality.samples;
                    for first in (0..samples).step_by(BLOCK) {
                        let count = BLOCK.min(samples - first);
                        let motions = maker.motions(&plan, &vec![draw; count], &|k, b| {
                            plan.of.stream(&format!("many {k}"), unit.repeat, entry * samples + first + b)
                        })?;
                        many.extend(plan.of.trained.motions(&motions));
                    }
                }
            }
            cx.progress(done as u64 + 1, units.len() as u64, "blocks", &[]);
        }
        let width = plan.of.trained.width();
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
        finite(&metrics)?;
        plan.of.log(cx, self.split);
        let samples = plan.of.entries.len();
        metrics.insert("samples".to_owned(), samples as f64);
        let drawn = super::drawn(cx)?;
        let meta = json!({
            "kind": cx.task().settings.kind(),
            "metrics": metrics,
            "drawn": drawn,
            "split": plan.of.split,
            "evaluator": plan.of.evaluator,
            "words": plan.of.trained.meta().words,
            "real": self.real,
            "shuffled": self.shuffled,
        });
        let report = json!({
            "metrics": metrics,
            "details": {
                "split": plan.of.split,
                "seed": plan.of.seed,
                "sampler": self.sampler,
                "samples_per_repeat": samples,
                "pools_per_repeat": samples / POOL,
                "diversity_pairs": spread::DIVERSITY_PAIRS.min(samples),
                "note": plan.of.few(),
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
    let (blobs, width) = (cx.blobs(), plan.of.trained.width());
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
                    let rows = row..row + plan.of.block(unit.block).len();
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

/// The metrics of one repeat.
fn measure(plan: &Plan<'_>, all: &Gathered, repeat: usize) -> BTreeMap<&'static str, f64> {
    let (width, n) = (plan.of.trained.width(), plan.of.entries.len());
    let of = |parts: &BTreeMap<Unit, Vec<f64>>| -> Vec<f64> {
        parts.iter().filter(|(unit, _)| unit.repeat == repeat).flat_map(|(_, values)| values.iter().copied()).collect()
    };
    let skating = of(&all.skating);
    let embeddings = (&of(&all.text)[..], &of(&all.made)[..], &of(&all.real)[..]);
    let mut metrics = plan.of.in_space(repeat, embeddings, plan.settings.shuffled);
    metrics.insert("skating_ratio", skating.iter().sum::<f64>() / n as f64);
    let many = of(&all.many);
    if !many.is_empty() {
        let of = plan.settings.multimodality;
        let drawn = |what: &str| -> Vec<usize> {
            plan.of.order(what, repeat, of.samples).into_iter().take(of.pairs).map(|i| i as usize).collect()
        };
        let (first, second) = (drawn("multimodality 1"), drawn("multimodality 2"));
        metrics.insert("multimodality", spread::multimodality(&many, of.samples, width, &first, &second));
    }
    metrics
}
