//! `evaluate.control`: accuracy of motions at target positions, and its cost in quality. Source: OmniControl, MotionLCM
//! (tables 3 and 4).
//!
//! Captions, crops and noise are those of `evaluate.t2m`. In every case (joints and density) the model gets positions of
//! every crop, and its motion is compared with them: trajectory, location and average error, each a mean over motions. The
//! motion is also measured by FID, R-precision, MM-Dist, Diversity and the measures of [`crate::metrics::physics`].
//! Without its control part the same model, with the same noise, is measured against the same positions as
//! `uncontrolled_...`.
//!
//! Departs: upstream measures 1,024 random entries in its spatial setting; here it is the whole split, as in its
//! temporal setting. A motion without targets has no error.

use std::collections::BTreeMap;

use motion::Stream;
use protocol::Digest;
use protocol::stage::{DataFormat, EvaluateControl, PHYSICS};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::artifacts::Tensors;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::entry_draws::{Draw, EntryDraws, Ranking};
use crate::evaluation::measured;
use crate::evaluation::report::over_repeats;
use crate::generate::generator::{self, Batch, ControlRequest, MotionGenerator, Texts};
use crate::kinds::shape::Map;
use crate::metrics::frechet::to_f64;
use crate::metrics::physics::{mean_physics, physics_of_features};
use crate::parts::control::ControlOptions;
use crate::parts::hint::{Hint, metres, share, told_frames};
use crate::shards::{self, Units, in_turn};

/// Size of the pool in which a caption's own motion is ranked.
const POOL: usize = 32;
/// File of a shard's values.
const VALUES_FILE: &str = "values.safetensors";
/// Errors of one motion against its targets.
const ERRORS: [&str; 3] = ["trajectory_error", "location_error", "average_error"];

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
struct Unit {
    repeat: usize,
    block: usize,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Density {
    Percent(f64),
    Frames(usize),
}

/// Joints with targets, and the density of frames with targets.
#[derive(Debug, Clone, PartialEq)]
struct Case {
    name: String,
    joints: Vec<usize>,
    density: Density,
}

fn cases(settings: &EvaluateControl, format: DataFormat) -> Result<Vec<Case>, StageError> {
    let percents = settings.percent.iter().map(|p| (format!("{p}pct"), Density::Percent(*p)));
    let frames = settings.frames.iter().map(|n| (format!("{n}frames"), Density::Frames(*n)));
    let densities: Vec<(String, Density)> = percents.chain(frames).collect();
    let mut all = Vec::new();
    for word in &settings.joints {
        let joints = format.joints_of(word).map_err(StageError::Input)?;
        for (name, density) in &densities {
            all.push(Case { name: format!("{word}/{name}"), joints: joints.clone(), density: *density });
        }
    }
    Ok(all)
}

/// The common plan of all shards and the merge.
struct Plan<'a> {
    settings: &'a EvaluateControl,
    of: EntryDraws,
    cases: Vec<Case>,
}

impl<'a> Plan<'a> {
    fn read(cx: &dyn AttemptContext, settings: &'a EvaluateControl) -> Result<Self, StageError> {
        if settings.repeats == 0 {
            return Err(StageError::Input("`repeats` is 0; expected at least 1".into()));
        }
        let of = EntryDraws::read(cx, settings.split, settings.all_if_small, (POOL, ""))?;
        let cases = cases(settings, of.dataset.format)?;
        Ok(Self { settings, of, cases })
    }

    fn units(&self) -> impl Iterator<Item = Unit> {
        let blocks = self.of.blocks();
        (0..self.settings.repeats).flat_map(move |repeat| (0..blocks).map(move |block| Unit { repeat, block }))
    }

    /// Draws the targets of entry number `i` of the split, whose crop has the joints `motion` in metres.
    fn hint(&self, case: &Case, repeat: usize, i: usize, motion: &[f32]) -> Hint {
        let joints = self.of.dataset.skeleton().joints;
        let length = motion.len() / (3 * joints);
        let count = match case.density {
            // A clip too short for the percentage gets one.
            Density::Percent(percent) => share(percent, length).max(1),
            Density::Frames(count) => count,
        };
        let mut draw = self.of.stream(&format!("told {}", case.name), repeat, i);
        let frames = told_frames(self.settings.setting, count, length, &mut draw);
        Hint::of(motion, joints, &case.joints, &frames)
    }
}

/// The generator of motions, and its captions.
struct Maker<'a> {
    generator: &'a dyn MotionGenerator,
    texts: Texts<'a>,
}

impl Maker<'_> {
    fn motions(
        &self,
        plan: &Plan<'_>,
        draws: &[Draw],
        hints: Option<&[Hint]>,
        seeds: &dyn Fn(usize, usize) -> Stream,
    ) -> Result<Vec<Vec<f32>>, StageError> {
        let captions: Vec<usize> = draws.iter().map(|d| d.caption).collect();
        let texts = self.texts.get(&captions, |caption| plan.of.dataset.captions[caption].text.as_str())?;
        let lengths: Vec<usize> = draws.iter().map(|d| d.len).collect();
        let EvaluateControl { scale, feedback, refine, .. } = *plan.settings;
        let options = ControlOptions { scale, feedback, refine };
        let control = hints.map(|hints| ControlRequest { hints, options });
        let batch = Batch { texts: &texts, lengths: &lengths, seeds, control };
        generator::motions(self.generator, batch, &plan.settings.sampler, &mut |_| {})
    }
}

/// Values of some motions, one after the other: without the control part, and with it for each case.
#[derive(Debug, Default)]
struct Values {
    text: Vec<f32>,
    real: Vec<f32>,
    /// Embeddings by unit; within a unit by variant, without the control part first.
    made: Vec<f32>,
    /// Physics of the motions in the same order.
    physics: Vec<f32>,
    /// [`ERRORS`] by unit and case, of each motion without the control part, then with it; NaN for a motion without
    /// targets.
    errors: Vec<f32>,
}

impl Values {
    fn measure(&mut self, plan: &Plan<'_>, motions: &[Vec<f32>]) {
        let skeleton = plan.of.dataset.skeleton();
        let physics = motions.iter().flat_map(|motion| physics_of_features(motion, skeleton));
        self.physics.extend(physics.map(|value| value as f32));
        self.made.extend(plan.of.trained.motions(motions));
    }

    fn compare(&mut self, plan: &Plan<'_>, motions: &[Vec<f32>], hints: &[Hint]) {
        let skeleton = plan.of.dataset.skeleton();
        for (motion, hint) in motions.iter().zip(hints) {
            let errors = hint.errors(&metres(motion, skeleton), plan.settings.threshold);
            let each = errors.map_or([f64::NAN; 3], |e| [e.trajectory, e.location, e.average]);
            self.errors.extend(each.map(|value| value as f32));
        }
    }

    fn unit(&mut self, plan: &Plan<'_>, maker: &Maker<'_>, unit: Unit) -> Result<(), StageError> {
        let of = &plan.of;
        let skeleton = plan.of.dataset.skeleton();
        let block = of.block(unit.block);
        let draws: Vec<Draw> = block.clone().map(|i| of.draw(unit.repeat, i, true)).collect();
        let crops: Vec<Vec<f32>> = draws.iter().map(|d| of.crop(*d)).collect();
        self.text.extend(of.trained.captions(draws.iter().map(|d| &of.dataset.captions[d.caption])));
        self.real.extend(of.trained.motions(&crops));
        let real: Vec<Vec<f32>> = crops.iter().map(|crop| metres(crop, skeleton)).collect();
        let seeds = |k: usize, b: usize| of.stream(&format!("noise {k}"), unit.repeat, block.start + b);
        let free = maker.motions(plan, &draws, None, &seeds)?;
        self.measure(plan, &free);
        for case in &plan.cases {
            let hints: Vec<Hint> =
                real.iter().zip(block.clone()).map(|(motion, i)| plan.hint(case, unit.repeat, i, motion)).collect();
            let motions = maker.motions(plan, &draws, Some(&hints), &seeds)?;
            self.measure(plan, &motions);
            self.compare(plan, &free, &hints);
            self.compare(plan, &motions, &hints);
        }
        Ok(())
    }
}

impl Map for EvaluateControl {
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let (_, generator) = measured::model(cx, plan.of.dataset.format, &self.sampler)?;
        if generator.control().is_none() {
            return Err(StageError::Input("`model` has no control part; expected a `train.control` stage".into()));
        }
        let maker = Maker { generator: &*generator, texts: Texts::new(&*generator) };
        let units: Vec<Unit> = in_turn(plan.units(), index, of).collect();
        let mut values = Values::default();
        for (done, unit) in units.iter().enumerate() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            values.unit(&plan, &maker, *unit)?;
            cx.progress(done as u64 + 1, units.len() as u64, "blocks", &[]);
        }
        let width = plan.of.trained.width();
        let tensors = Tensors::default()
            .with_rows("text", width, values.text)
            .with_rows("real", width, values.real)
            .with_rows("made", width, values.made)
            .with_rows("physics", PHYSICS.len(), values.physics)
            .with_rows("errors", ERRORS.len(), values.errors);
        shards::publish(cx, &Units { units }, VALUES_FILE, &tensors, BTreeMap::new())
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let all = gather(cx, &plan, shards)?;
        // The mean of a case is enough here; the report has every repeat.
        let bounded = |name: &str| !name.contains('/');
        let measured = over_repeats(self.repeats, bounded, |repeat| measure(&plan, &all, repeat))?;
        let meta = json!({
            "scale": self.scale,
            "feedback": self.feedback,
            "refine": self.refine,
            "threshold": self.threshold,
        });
        let names: Vec<&str> = plan.cases.iter().map(|case| case.name.as_str()).collect();
        let details = json!({"sampler": self.sampler, "setting": self.setting, "cases": names});
        plan.of.publish(cx, self.split, plan.of.entries.len(), measured, (meta, details))
    }
}

/// All values of the shards by repeat, with entries in order.
#[derive(Debug, Clone, Default)]
struct Gathered {
    text: Vec<f64>,
    real: Vec<f64>,
    /// Embeddings by variant, without the control part first.
    made: Vec<Vec<f64>>,
    physics: Vec<Vec<f64>>,
    /// Errors by case, without the control part and with it.
    errors: Vec<[Vec<f64>; 2]>,
}

fn gather(cx: &dyn AttemptContext, plan: &Plan<'_>, digests: &[Digest]) -> Result<Vec<Gathered>, StageError> {
    let width = plan.of.trained.width();
    let ways = plan.cases.len() + 1;
    let mut parts: BTreeMap<Unit, Gathered> = BTreeMap::new();
    for shard in shards::read::<Units<Unit>>(cx, digests, "evaluation", VALUES_FILE) {
        let (Units { units }, mut tensors) = shard?;
        let mut take = |name: &str, rank| Ok::<_, StageError>(to_f64(&tensors.take(name, rank, VALUES_FILE)?.values));
        let text = take("text", 2)?;
        let real = take("real", 2)?;
        let made = take("made", 2)?;
        let physics = take("physics", 2)?;
        let errors = take("errors", 2)?;
        let mut row = 0;
        for unit in units {
            let n = plan.of.block(unit.block).len();
            let cut = |values: &[f64], from: usize, size: usize| values[from * size..(from + n) * size].to_vec();
            let way = |w: usize| row * ways + w * n;
            let compared = |case: usize, with: usize| 2 * (row * plan.cases.len() + case * n) + with * n;
            let part = Gathered {
                text: cut(&text, row, width),
                real: cut(&real, row, width),
                made: (0..ways).map(|w| cut(&made, way(w), width)).collect(),
                physics: (0..ways).map(|w| cut(&physics, way(w), PHYSICS.len())).collect(),
                errors: (0..plan.cases.len())
                    .map(|case| [0, 1].map(|with| cut(&errors, compared(case, with), ERRORS.len())))
                    .collect(),
            };
            parts.insert(unit, part);
            row += n;
        }
    }
    shards::expect_units(parts.keys().copied(), plan.units())?;
    let empty = Gathered {
        made: vec![Vec::new(); ways],
        physics: vec![Vec::new(); ways],
        errors: vec![Default::default(); plan.cases.len()],
        ..Gathered::default()
    };
    let mut all = vec![empty; plan.settings.repeats];
    for (unit, part) in parts {
        let whole = &mut all[unit.repeat];
        whole.text.extend(part.text);
        whole.real.extend(part.real);
        let both = |to: &mut Vec<Vec<f64>>, from: Vec<Vec<f64>>| to.iter_mut().zip(from).for_each(|(t, f)| t.extend(f));
        both(&mut whole.made, part.made);
        both(&mut whole.physics, part.physics);
        for (to, from) in whole.errors.iter_mut().zip(part.errors) {
            to.iter_mut().zip(from).for_each(|(t, f)| t.extend(f));
        }
    }
    Ok(all)
}

/// The metrics of one repeat: of each case, and means over the cases.
fn measure(plan: &Plan<'_>, all: &[Gathered], repeat: usize) -> BTreeMap<String, f64> {
    let all = &all[repeat];
    let ranking = Ranking { pools: &[POOL], kept: plan.of.entries.len(), shuffled: false };
    let space = |way: usize| -> BTreeMap<String, f64> {
        let mut metrics = plan.of.in_space(repeat, (&all.text, &all.made[way], &all.real), &ranking);
        metrics.extend(mean_physics(&all.physics[way]));
        metrics
    };
    let errors = |case: usize, with: usize| -> Vec<(&'static str, f64)> {
        let rows = all.errors[case][with].chunks_exact(ERRORS.len()).filter(|row| row.iter().all(|v| !v.is_nan()));
        let rows: Vec<&[f64]> = rows.collect();
        let mean = |k: usize| rows.iter().map(|row| row[k]).sum::<f64>() / rows.len() as f64;
        ERRORS.iter().enumerate().map(|(k, name)| (*name, mean(k))).collect()
    };
    let mut each: Vec<BTreeMap<String, f64>> = Vec::new();
    for case in 0..plan.cases.len() {
        let mut metrics = space(case + 1);
        metrics.extend(errors(case, 1).into_iter().map(|(name, value)| (name.to_owned(), value)));
        metrics.extend(errors(case, 0).into_iter().map(|(name, value)| (format!("uncontrolled_{name}"), value)));
        each.push(metrics);
    }
    let mut metrics = BTreeMap::new();
    for (case, own) in plan.cases.iter().zip(&each) {
        for (name, value) in own {
            *metrics.entry(name.clone()).or_insert(0.0) += value / each.len() as f64;
            if each.len() > 1 {
                metrics.insert(format!("{name}/{}", case.name), *value);
            }
        }
    }
    metrics.extend(space(0).into_iter().map(|(name, value)| (format!("uncontrolled_{name}"), value)));
    metrics
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_set_of_joints_meets_every_density() {
        let settings = EvaluateControl {
            joints: vec!["six".into(), "head".into()],
            percent: vec![100.0, 25.0],
            frames: vec![2],
            ..EvaluateControl::default()
        };
        let found = cases(&settings, DataFormat::Humanml3d).unwrap();
        let names: Vec<&str> = found.iter().map(|case| case.name.as_str()).collect();
        let expected = ["six/100pct", "six/25pct", "six/2frames", "head/100pct", "head/25pct", "head/2frames"];
        assert_eq!(names, expected);
        assert_eq!((&found[5].joints[..], found[5].density), (&[15][..], Density::Frames(2)));
        assert!(cases(&settings, DataFormat::Kit).unwrap_err().to_string().contains("`head`"));
    }
}
