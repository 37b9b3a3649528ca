//! `evaluate.t2m`: the papers' metrics, in an evaluator's space. Source: Guo et al. (text-to-motion) and MotionLCM's
//! protocol.
//!
//! A repeat draws a caption and a crop for every entry of the split, and generates a motion for the caption, of the
//! crop's length or of a length estimator's. The metrics are R-precision in pools and MM-Dist against the captions, FID
//! against the crops, Diversity, MultiModality over more motions for some captions, and the skating ratio. `real`
//! measures the crops themselves, and FID against a second draw of captions and crops. It adds `fid_halves`, one half
//! of the clips against the other: the distance of two sets of other clips, at half the count. A `vae` or a `tokenizer`
//! measures its reconstructions of the crops, and FID against these.
//!
//! All draws are keyed by (seed, repeat, entry) and not by the stage's name, so that two models of a run are compared
//! on the same captions, lengths and noise. Motions are made in blocks that depend only on the entry's number, and
//! shards take blocks in turn. So a motion's batch does not depend on the number of shards.
//!
//! Departs: Diversity uses as many pairs as there are entries if there are fewer than 300.

mod maker;
mod measure;
mod perturbed;
mod plan;

use std::collections::BTreeMap;

use protocol::stage::EvaluateT2m;
use protocol::{ArtifactKind, Digest};
use serde_json::json;

use self::maker::{Maker, Source, reconstruct};
use self::measure::{gather, measure};
use self::plan::{BLOCK, Draw, EMBEDDINGS_FILE, Part, Plan, Unit};
use crate::artifacts::{self, Tensors, word};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::entry_draws::{finite, skates};
use crate::evaluation::report::{REPORT_FILE, drawn};
use crate::kinds::shape::Map;
use crate::metrics::interval::Interval;
use crate::metrics::spread;

/// Motions per dimension below which FID's covariances are unreliable.
const FEW: usize = 5;

impl Map for EvaluateT2m {
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let source = Source::open(cx, &plan)?;
        let maker = match &source {
            Source::Generated(generated) => Some(Maker::new(generated)),
            Source::Real | Source::Reconstructed(_) => None,
        };
        // Every `of`-th unit of either part, since the parts have different costs.
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
                    let motions = match (&source, &maker) {
                        (_, Some(maker)) => {
                            real.extend(plan.trained.motions(&crops));
                            maker.motions(&plan, &draws, &|k, b| {
                                plan.stream(&format!("noise {k}"), unit.repeat, block.start + b)
                            })?
                        }
                        (Source::Reconstructed(reconstructor), _) => {
                            real.extend(plan.trained.motions(&crops));
                            let both = draws.iter().zip(&crops);
                            both.map(|(draw, crop)| reconstruct(&plan, reconstructor, *draw, crop))
                                .collect::<Result<Vec<_>, _>>()?
                        }
                        _ => {
                            let others = block.map(|i| plan.crop(plan.draw(unit.repeat, i, false)));
                            real.extend(plan.trained.motions(&others.collect::<Vec<_>>()));
                            crops
                        }
                    };
                    skating.extend(motions.iter().map(|motion| skates(motion, plan.dataset.skeleton())));
                    made.extend(plan.trained.motions(&motions));
                }
                Part::Many => {
                    let maker = maker.as_ref().ok_or_else(|| StageError::Fault("only a model has samples".into()))?;
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
        let mut values: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        for repeat in 0..self.repeats {
            for (name, value) in measure(&plan, &all, repeat) {
                values.entry(name).or_default().push(value);
            }
        }
        let mut metrics = BTreeMap::new();
        for (name, values) in &values {
            let interval = Interval::of(values);
            metrics.insert(name.clone(), interval.mean);
            metrics.insert(format!("{name}.lower"), interval.lower());
            metrics.insert(format!("{name}.upper"), interval.upper());
        }
        finite(&metrics)?;
        let (samples, entries, pool) = (plan.kept(), plan.entries.len(), self.first_pool());
        let few = few(samples, plan.trained.width());
        few.iter().for_each(|few| cx.log(few));
        if plan.split != self.split {
            cx.log(&format!(
                "the split `{}` is too small for pools of {}; all {entries} entries are measured",
                word(&self.split),
                self.largest_pool()
            ));
        }
        if samples < entries {
            cx.log(&format!(
                "{} of {entries} entries do not fill a pool of {pool}; each repeat leaves out different ones",
                entries - samples
            ));
        }
        metrics.insert("samples".to_owned(), samples as f64);
        let drawn = drawn(cx)?;
        let meta = json!({
            "kind": cx.task().settings.kind(),
            "metrics": metrics,
            "drawn": drawn,
            "split": plan.split,
            "evaluator": plan.evaluator,
            "words": plan.trained.meta().words,
            "real": self.real,
            "reconstructed": self.reconstructs(),
            "shuffled": self.shuffled,
            "perturbed": self.perturbed,
            "pools": self.pools,
            "drop_last": self.drop_last,
            "drawn_lengths": cx.task().inputs.contains_key("length"),
        });
        let report = json!({
            "metrics": metrics,
            "details": {
                "split": plan.split,
                "seed": plan.seed,
                "sampler": self.generates().then_some(&self.sampler),
                "entries": entries,
                "samples_per_repeat": samples,
                "pools_per_repeat": self.pools.iter().map(|pool| samples / pool).collect::<Vec<_>>(),
                "multimodality": self.generates().then_some(self.multimodality),
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

/// A warning if FID is unreliable with so few motions.
fn few(samples: usize, width: usize) -> Option<String> {
    let text = format!(
        "FID is taken of {samples} motions in {width} dimensions; it is then larger than of many, and compares only \
         with FIDs of as many motions in the same evaluator"
    );
    (samples < FEW * width).then_some(text)
}
