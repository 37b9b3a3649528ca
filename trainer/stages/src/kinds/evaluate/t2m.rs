//! `evaluate.t2m`: the papers' metrics, in an evaluator's space. Source: Guo et al. (text-to-motion) and MotionLCM's
//! protocol.
//!
//! A repeat draws a caption and a crop for every entry of the split, and generates a motion for the caption, of the
//! crop's length or of a length estimator's. The metrics are R-precision in pools and MM-Dist against the captions, FID
//! against the crops, Diversity, MultiModality over more motions for some captions, and the measures of
//! [`crate::metrics::physics`]. `real` measures the crops themselves, and FID against a second draw of captions and
//! crops. It adds `fid_halves`, one half of the clips against the other: the distance of two sets of other clips, at
//! half the count. A `vae` or a `tokenizer` measures its reconstructions of the crops, and FID against these.
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

use protocol::Digest;
use protocol::stage::{EvaluateT2m, PHYSICS, Split};
use serde_json::json;

use self::maker::{Maker, Source, reconstruct};
use self::measure::{gather, measure};
use self::plan::{EMBEDDINGS_FILE, Part, Plan, Unit};
use crate::artifacts::Tensors;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::entry_draws::{BLOCK, Draw};
use crate::evaluation::report::over_repeats;
use crate::kinds::shape::Map;
use crate::metrics::physics::physics_of_features;
use crate::metrics::spread;
use crate::shards::{self, Units, in_turn};
use crate::stand_in::CLIPS;

/// Embeddings of all samples for the caption of a unit of [`Part::Many`].
fn samples_of_one(plan: &Plan<'_>, maker: &Maker<'_>, unit: Unit) -> Result<Vec<f32>, StageError> {
    let entry = plan.many(unit.repeat)[unit.block];
    let draw = plan.of.draw(unit.repeat, entry, true);
    let samples = plan.settings.multimodality.samples;
    let mut embeddings = Vec::new();
    for first in (0..samples).step_by(BLOCK) {
        let count = BLOCK.min(samples - first);
        let motions = maker.motions(plan, &vec![draw; count], &|k, b| {
            plan.of.stream(&format!("many {k}"), unit.repeat, entry * samples + first + b)
        })?;
        embeddings.extend(plan.of.trained.motions(&motions));
    }
    Ok(embeddings)
}

/// Embeddings of a shard's captions and motions, and the physics of its motions.
#[derive(Default)]
struct Measured {
    text: Vec<f32>,
    made: Vec<f32>,
    /// The motions that FID compares with.
    real: Vec<f32>,
    physics: Vec<f32>,
    /// Samples for [`Part::Many`].
    many: Vec<f32>,
}

impl Measured {
    /// Adds a block of entries: generated, reconstructed, or the crops themselves.
    fn add_entries(
        &mut self,
        plan: &Plan<'_>,
        source: &Source,
        maker: Option<&Maker<'_>>,
        unit: Unit,
    ) -> Result<(), StageError> {
        let block = plan.of.block(unit.block);
        let draws: Vec<Draw> = block.clone().map(|i| plan.of.draw(unit.repeat, i, true)).collect();
        let crops: Vec<Vec<f32>> = draws.iter().map(|d| plan.of.crop(*d)).collect();
        self.text.extend(plan.of.trained.captions(draws.iter().map(|d| &plan.of.dataset.captions[d.caption])));
        let motions = match (source, maker) {
            (_, Some(maker)) => {
                self.real.extend(plan.of.trained.motions(&crops));
                let noise = |k, b| plan.of.stream(&format!("noise {k}"), unit.repeat, block.start + b);
                maker.motions(plan, &draws, &noise)?
            }
            (Source::Reconstructed(reconstructor), _) => {
                self.real.extend(plan.of.trained.motions(&crops));
                let both = draws.iter().zip(&crops);
                both.map(|(draw, crop)| reconstruct(plan, reconstructor, *draw, crop)).collect::<Result<Vec<_>, _>>()?
            }
            _ => {
                let others = block.map(|i| plan.of.crop(plan.of.draw(unit.repeat, i, false)));
                self.real.extend(plan.of.trained.motions(&others.collect::<Vec<_>>()));
                crops
            }
        };
        let skeleton = plan.of.dataset.skeleton();
        let physics = motions.iter().flat_map(|motion| physics_of_features(motion, skeleton));
        self.physics.extend(physics.map(|value| value as f32));
        self.made.extend(plan.of.trained.motions(&motions));
        Ok(())
    }

    fn into_tensors(self, width: usize) -> Tensors {
        Tensors::default()
            .with_rows("text", width, self.text)
            .with_rows("made", width, self.made)
            .with_rows("real", width, self.real)
            .with_rows("many", width, self.many)
            .with_rows("physics", PHYSICS.len(), self.physics)
    }
}

impl Map for EvaluateT2m {
    fn repetitions(&self, entries: &dyn Fn(Split) -> f64) -> f64 {
        let many = if self.generates() { self.multimodality.captions * self.multimodality.samples } else { 0 };
        self.repeats as f64 * (entries(self.split) + many as f64) / CLIPS as f64
    }

    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let source = Source::open(cx, &plan)?;
        let maker = match &source {
            Source::Generated(generated) => Some(Maker::new(generated)),
            Source::Real | Source::Reconstructed(_) => None,
        };
        // Every `of`-th unit of either part, since the parts have different costs.
        let mine = |part| in_turn(plan.units().into_iter().filter(move |unit| unit.part == part), index, of);
        let units: Vec<Unit> = mine(Part::Entries).chain(mine(Part::Many)).collect();
        let mut measured = Measured::default();
        for (done, unit) in units.iter().enumerate() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            match unit.part {
                Part::Entries => measured.add_entries(&plan, &source, maker.as_ref(), *unit)?,
                Part::Many => {
                    let maker = maker.as_ref().ok_or_else(|| StageError::Fault("only a model has samples".into()))?;
                    measured.many.extend(samples_of_one(&plan, maker, *unit)?);
                }
            }
            cx.progress(done as u64 + 1, units.len() as u64, "blocks", &[]);
        }
        let tensors = measured.into_tensors(plan.of.trained.width());
        shards::publish(cx, &Units { units }, EMBEDDINGS_FILE, &tensors, BTreeMap::new())
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let all = gather(cx, &plan, shards)?;
        let measured = over_repeats(self.repeats, |_| true, |repeat| measure(&plan, &all, repeat))?;
        let samples = plan.kept();
        let entries = plan.of.entries.len();
        let pool = self.first_pool();
        if samples < entries {
            cx.log(&format!(
                "{} of {entries} entries do not fill a pool of {pool}; each repeat leaves out different ones",
                entries - samples
            ));
        }
        let meta = json!({
            "real": self.real,
            "reconstructed": self.reconstructs(),
            "shuffled": self.shuffled,
            "perturbed": self.perturbed,
            "perturbed_texts": self.perturbed_texts,
            "pools": self.pools,
            "drop_last": self.drop_last,
            "drawn_lengths": cx.task().inputs.contains_key("length"),
        });
        let details = json!({
            "sampler": self.generates().then_some(&self.sampler),
            "entries": entries,
            "pools_per_repeat": self.pools.iter().map(|pool| samples / pool).collect::<Vec<_>>(),
            "multimodality": self.generates().then_some(self.multimodality),
            "diversity_pairs": spread::DIVERSITY_PAIRS.min(samples),
        });
        plan.of.publish(cx, self.split, samples, measured, (meta, details))
    }
}
