//! `evaluate.latent_fid`: distance of a model's latents from real latents, from their captions, and from its teacher's
//! latents.
//!
//! Sample `i` of a repeat belongs to entry `i mod n`. Its caption and noise are keyed by (seed, repeat, i) and not by
//! the stage's name, so that two models of a run are compared on the same noise. Samples are made in blocks that depend
//! only on the sample's number, and shards take blocks in turn. So a sample's batch does not depend on the number of
//! shards.
//!
//! `match` compares repeat 0 with the teacher's 50-step DDIM from the same noise and captions, at g = w + 1 for a
//! student. Its reference value is `match_other_noise`: a teacher's sample against the teacher's next sample for the
//! same entry.
//!
//! A comparison with all splits has additional values for each, such as `latent_fid_test`: samples for its captions
//! against its clips. They are needed because a model has seen most of all captions in its training. The principal
//! components are those of the train latents in either case. Definitions:
//! [`evaluation::latent_fid`](crate::metrics::latent_fid).

use std::collections::BTreeMap;

use motion::Stream;
use motion::dataset::{Caption, Split};
use motion::text::words;
use protocol::stage::{EvaluateLatentFid, Sampler, Split as Wanted};
use protocol::{ArtifactKind, Digest, Seed};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::artifacts::{self, Latents, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::report::{no_entries, publish_report};
use crate::generate::generator::{self, LatentGenerator, MotionGenerator, Texts};
use crate::kinds::shape::Map;
use crate::metrics::latent_fid::{
    Real, Reference, Target, mean_and_spread, relative_distance, same_captions, standard_deviation, top,
};
use crate::shards::{self, Units, in_turn};
use crate::stand_in::CLIPS;

/// Samples computed together. Measured with 5 blocks of width 128 on one core: with 32 each takes a tenth less time
/// than with 64, which with guidance are 128 sequences and do not fit the cache.
const BLOCK: usize = 32;
/// Steps of the teacher that `match` compares with.
const TEACHER_STEPS: usize = 50;
/// File of a shard's samples.
const SAMPLES_FILE: &str = "samples.safetensors";

/// The model that generates a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Maker {
    Model,
    Teacher,
}

/// One block of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
struct Unit {
    maker: Maker,
    repeat: usize,
    block: usize,
}

/// The common plan of all shards and the merge.
struct Plan<'a> {
    settings: &'a EvaluateLatentFid,
    seed: Seed,
    latents: Latents,
    captions: Vec<Caption>,
    model: Box<dyn MotionGenerator>,
    /// Entries to generate samples for.
    entries: Vec<usize>,
    /// The teacher, if its samples are needed in addition to the model's.
    teacher: Option<Box<dyn MotionGenerator>>,
    /// True if `match` is measured.
    matched: bool,
}

impl<'a> Plan<'a> {
    fn read(cx: &dyn AttemptContext, settings: &'a EvaluateLatentFid) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let refuse = |text: String| Err(StageError::Input(text));
        let latents = Latents::read(&*blobs, &artifacts::input(cx, "latents", ArtifactKind::Latents)?.1)?;
        let captions = artifacts::captions(&*blobs, &artifacts::input(cx, "dataset", ArtifactKind::Dataset)?.1)?;
        let (model_digest, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let model = generator::open(&manifest, &*blobs, &cx.device())?;
        generator::check_sampler(&*model, &settings.sampler)?;
        fits("model", &*model, &latents)?;
        let wanted = |split: Split| match settings.split {
            Wanted::All => true,
            Wanted::Train => split == Split::Train,
            Wanted::Val => split == Split::Val,
            Wanted::Test => split == Split::Test,
        };
        let entries: Vec<usize> = (0..latents.entries()).filter(|&e| wanted(latents.meta.splits[e])).collect();
        if entries.is_empty() {
            return Err(no_entries(settings.split));
        }
        if entries.len() * settings.samples < 2 || entries.len() * latents.meta.crops < 2 {
            return refuse(format!(
                "the split has {} entries; a comparison needs at least two latents and two samples",
                entries.len()
            ));
        }
        if settings.repeats == 0 || settings.components == 0 {
            return refuse("`repeats` and `components` must be at least 1".into());
        }
        if let Some(c) = latents.meta.captions.iter().flatten().find(|c| **c >= captions.len()) {
            let have = captions.len();
            return refuse(format!(
                "`latents` refers to caption {c}, but `dataset` has {have} captions; use latents of this dataset"
            ));
        }
        let matched = cx.task().inputs.contains_key("teacher");
        let teacher = if matched {
            let (digest, manifest) = artifacts::input(cx, "teacher", ArtifactKind::Model)?;
            let teacher = generator::open(&manifest, &*blobs, &cx.device())?;
            if teacher.family().is_student() {
                return refuse("`teacher` is a student; expected a `train.mld` stage".into());
            }
            fits("teacher", &*teacher, &latents)?;
            // A teacher that is compared with itself is not sampled twice.
            (digest != model_digest || settings.sampler.steps != TEACHER_STEPS).then_some(teacher)
        } else {
            None
        };
        let seed = cx.task().seed;
        Ok(Self { settings, seed, latents, captions, model, entries, teacher, matched })
    }

    /// Number of samples of one repeat.
    fn samples(&self) -> usize {
        self.entries.len() * self.settings.samples
    }

    fn width(&self) -> usize {
        self.latents.mu.row_len()
    }

    fn block(&self, block: usize) -> std::ops::Range<usize> {
        block * BLOCK..((block + 1) * BLOCK).min(self.samples())
    }

    fn entry(&self, sample: usize) -> usize {
        self.entries[sample % self.entries.len()]
    }

    /// All blocks. Shard `index` of `of` takes every `of`-th one of each maker, since a teacher's block costs a hundred
    /// of a student's.
    fn units(&self) -> Vec<Unit> {
        let blocks = self.samples().div_ceil(BLOCK);
        let of = |maker, repeat| (0..blocks).map(move |block| Unit { maker, repeat, block });
        let model = (0..self.settings.repeats).flat_map(|repeat| of(Maker::Model, repeat));
        let teacher = self.teacher.as_ref().map(|_| of(Maker::Teacher, 0));
        model.chain(teacher.into_iter().flatten()).collect()
    }

    fn stream(&self, what: &str, unit: Unit, sample: usize) -> Stream {
        Stream::new(self.seed, &format!("evaluate.latent_fid/{what}"), unit.repeat as u64, sample as u64)
    }

    /// Index of the caption of each sample of a block.
    fn block_captions(&self, unit: Unit) -> Vec<usize> {
        let caption = |sample| {
            let captions = &self.latents.meta.captions[self.entry(sample)];
            captions[self.stream("caption", unit, sample).below(captions.len())]
        };
        self.block(unit.block).map(caption).collect()
    }

    /// Generates the samples of a block.
    fn sample(
        &self,
        unit: Unit,
        generator: &dyn MotionGenerator,
        texts: &Texts<'_>,
        sampler: &Sampler,
    ) -> Result<Vec<f32>, StageError> {
        let texts = texts.get(&self.block_captions(unit), |caption| self.captions[caption].text.as_str())?;
        let first = self.block(unit.block).start;
        let seeds = |k: usize, b: usize| match k.checked_sub(1) {
            None => self.stream("noise", unit, first + b),
            Some(step) => self.stream(&format!("noise {step}"), unit, first + b),
        };
        latents_of("model", generator)?.sample(&texts, &seeds, sampler)
    }

    /// The sampler of the teacher for `match`.
    fn teacher_sampler(&self) -> Sampler {
        let shift = if self.model.family().is_student() { 1.0 } else { 0.0 };
        Sampler { steps: TEACHER_STEPS, guidance: self.settings.sampler.guidance + shift, ..Sampler::default() }
    }
}

/// The latent generator of a model, or an error naming the input `field`.
fn latents_of<'g>(field: &str, generator: &'g dyn MotionGenerator) -> Result<&'g dyn LatentGenerator, StageError> {
    generator.latents().ok_or_else(|| {
        let text = format!("`{field}` generates no latents, but this stage measures latents; use `evaluate.t2m`");
        StageError::Input(text)
    })
}

/// Refuses a model that does not generate these latents.
fn fits(field: &str, generator: &dyn MotionGenerator, latents: &Latents) -> Result<(), StageError> {
    let refuse = |text: String| Err(StageError::Input(format!("`{field}` does not fit: {text}")));
    let model = latents_of(field, generator)?;
    let a = model.shape();
    let b = latents.meta.latent;
    if a != b {
        return refuse(format!(
            "its latent is {}x{}, but that of `latents` is {}x{}",
            a.tokens, a.dim, b.tokens, b.dim
        ));
    }
    if model.vae() != latents.meta.vae {
        return refuse("its VAE is not the VAE of `latents`".into());
    }
    Ok(())
}

impl Map for EvaluateLatentFid {
    fn repetitions(&self, entries: &dyn Fn(Wanted) -> f64) -> f64 {
        (self.repeats * self.samples) as f64 * entries(self.split) / CLIPS as f64
    }

    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let mine = |maker| in_turn(plan.units().into_iter().filter(move |unit| unit.maker == maker), index, of);
        let units: Vec<Unit> = mine(Maker::Model).chain(mine(Maker::Teacher)).collect();
        let texts = Texts::new(&*plan.model);
        let teacher_sampler = plan.teacher_sampler();
        let teacher = plan.teacher.as_deref().map(|teacher| (teacher, Texts::new(teacher)));

        // Cost in network evaluations, so that progress is even.
        let cost = |unit: &Unit| match unit.maker {
            Maker::Model => self.sampler.steps as u64,
            Maker::Teacher => TEACHER_STEPS as u64,
        };
        let total = units.iter().map(cost).sum();
        let mut done = 0;
        let mut values = Vec::new();
        for unit in &units {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let z = match (&teacher, unit.maker) {
                (Some((teacher, texts)), Maker::Teacher) => plan.sample(*unit, *teacher, texts, &teacher_sampler)?,
                _ => plan.sample(*unit, &*plan.model, &texts, &self.sampler)?,
            };
            values.extend(z);
            done += cost(unit);
            cx.progress(done, total, "evaluations", &[]);
        }
        let tensors = Tensors::default().with_rows("z", plan.width(), values);
        shards::publish(cx, &Units { units }, SAMPLES_FILE, &tensors, BTreeMap::new())
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let plan = Plan::read(cx, self)?;
        let blocks = gather(cx, &plan, shards)?;
        let of = |maker: Maker, repeat: usize| -> Vec<f32> {
            let mine = blocks.iter().filter(|(u, _)| u.maker == maker && u.repeat == repeat);
            mine.flat_map(|(_, values)| values.iter().copied()).collect()
        };

        let z = draw(&plan, 0);
        let reference = reference(&plan, &z);
        let sampled: Vec<usize> = (0..plan.samples()).map(|i| plan.entry(i)).collect();
        let splits = SplitTarget::all(&plan, &reference, real(&plan, &z));
        let mut values: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        for repeat in 0..self.repeats {
            let samples = of(Maker::Model, repeat);
            let found = reference.measure(&samples, &sampled, plan.seed, repeat as u64);
            let mut put = |name: &str, value| values.entry(name.to_owned()).or_default().push(value);
            put("latent_fid", found.latent_fid);
            put("latent_std", found.latent_std);
            put("latent_r_precision_top1", top(found.ranks.iter().copied(), 1));
            put("latent_r_precision_top3", top(found.ranks.iter().copied(), 3));
            for SplitTarget { split, samples: rows, target } in &splits {
                put(&format!("latent_fid_{split}"), reference.distance(target, &taken(&samples, rows, plan.width())));
                let ranks = rows.iter().map(|i| found.ranks[*i]);
                put(&format!("latent_r_precision_top3_{split}"), top(ranks, 3));
            }
            if repeat == 0 && plan.matched {
                let teacher = if plan.teacher.is_some() { of(Maker::Teacher, 0) } else { samples.clone() };
                put("match", relative_distance(&samples, &teacher, plan.width()));
                if self.samples > 1 {
                    // The samples of one entry are a whole number of entries apart.
                    let mut others = teacher.clone();
                    others.rotate_left(plan.entries.len() * plan.width());
                    put("match_other_noise", relative_distance(&others, &teacher, plan.width()));
                }
            }
        }
        let mut metrics = BTreeMap::new();
        let mut spread = BTreeMap::new();
        for (name, values) in &values {
            let (mean, sd) = mean_and_spread(values);
            metrics.insert(name.clone(), mean);
            spread.extend(sd.map(|sd| (name.clone(), sd)));
        }
        let of_distance = |name: &str| name == "latent_fid" || name.starts_with("latent_fid_");
        metrics
            .extend(spread.iter().filter(|(name, _)| of_distance(name)).map(|(name, sd)| (format!("{name}_sd"), *sd)));
        metrics.extend(floors(&plan, &reference, real(&plan, &z), &splits));
        metrics.insert("latent_std_real".into(), standard_deviation(&compared(&plan, &z)));
        publish_report(cx, metrics, details(&plan, &reference, &values, &spread))
    }
}

/// The samples of every unit.
fn gather(
    cx: &mut dyn AttemptContext,
    plan: &Plan<'_>,
    shards: &[Digest],
) -> Result<BTreeMap<Unit, Vec<f32>>, StageError> {
    let mut blocks: BTreeMap<Unit, Vec<f32>> = BTreeMap::new();
    for shard in shards::read::<Units<Unit>>(cx, shards, "samples", SAMPLES_FILE) {
        let (Units { units }, mut tensors) = shard?;
        let rows = tensors.take("z", 2, SAMPLES_FILE)?;
        let mut at = 0;
        for unit in units {
            let end = at + plan.block(unit.block).len() * plan.width();
            blocks.insert(unit, rows.values[at..end].to_vec());
            at = end;
        }
    }
    shards::expect_units(blocks.keys().copied(), plan.units())?;
    if !blocks.values().flatten().all(|v| v.is_finite()) {
        return Err(StageError::Input("samples are not finite; the denoiser is not trained well enough".into()));
    }
    Ok(blocks)
}

/// Details for the report beside the metrics.
fn details(
    plan: &Plan<'_>,
    reference: &Reference,
    values: &BTreeMap<String, Vec<f64>>,
    spread: &BTreeMap<String, f64>,
) -> Value {
    json!({
        "sampler": plan.settings.sampler,
        "model": to_meta(plan.model.family()),
        "samples_per_repeat": plan.samples(),
        "explained_variance": reference.explained(),
        "real_variance": reference.whole().total_variance(),
        "repeats": values,
        "sd": spread,
    })
}

/// Draws z from the posterior of every crop, `[rows, width]`.
fn draw(plan: &Plan<'_>, repeat: u64) -> Vec<f32> {
    let mut z = plan.latents.sigma.values.to_vec();
    for (row, (z, mu)) in
        z.chunks_exact_mut(plan.width()).zip(plan.latents.mu.values.chunks_exact(plan.width())).enumerate()
    {
        let mut stream = Stream::new(plan.seed, "evaluate.latent_fid/real", repeat, row as u64);
        for (z, mu) in z.iter_mut().zip(mu) {
            *z = mu + *z * stream.normal();
        }
    }
    z
}

/// The real latents, with one draw `z` of each.
fn real<'p>(plan: &'p Plan<'_>, z: &'p [f32]) -> Real<'p> {
    Real { z, mu: &plan.latents.mu.values, crops: plan.latents.meta.crops, width: plan.width() }
}

/// The target of one split, when all splits are compared.
struct SplitTarget {
    split: Split,
    /// Samples for the split's entries.
    samples: Vec<usize>,
    target: Target,
}

impl SplitTarget {
    /// The targets of every split with two entries or more, if all splits are compared; otherwise none.
    fn all(plan: &Plan<'_>, reference: &Reference, real: Real<'_>) -> Vec<Self> {
        if plan.settings.split != Wanted::All {
            return Vec::new();
        }
        let of = |split: Split| {
            let entries = entries_of(plan, split);
            let samples = (0..plan.samples()).filter(|i| plan.latents.meta.splits[plan.entry(*i)] == split).collect();
            (entries.len() > 1).then(|| Self { split, samples, target: reference.target(real, &entries) })
        };
        Split::ALL.into_iter().filter_map(of).collect()
    }
}

fn entries_of(plan: &Plan<'_>, split: Split) -> Vec<usize> {
    plan.entries.iter().copied().filter(|e| plan.latents.meta.splits[*e] == split).collect()
}

/// Reference values of real latents, for the whole target and each split: another draw of the same clips, and one half
/// of the clips against the other.
fn floors(plan: &Plan<'_>, reference: &Reference, real: Real<'_>, splits: &[SplitTarget]) -> Vec<(String, f64)> {
    let fresh = fresh(plan);
    let mut found = vec![("latent_fid_floor".to_owned(), reference.distance(reference.whole(), &fresh))];
    found.extend(reference.halves(real, &plan.entries, plan.seed).map(|apart| ("latent_fid_halves".to_owned(), apart)));
    for SplitTarget { split, samples, target } in splits {
        let floor = reference.distance(target, &taken(&fresh, samples, plan.width()));
        found.push((format!("latent_fid_{split}_floor"), floor));
        let halves = reference.halves(real, &entries_of(plan, *split), plan.seed);
        found.extend(halves.map(|apart| (format!("latent_fid_{split}_halves"), apart)));
    }
    found
}

/// Selects the rows `rows` of `values`.
fn taken(values: &[f32], rows: &[usize], width: usize) -> Vec<f32> {
    rows.iter().flat_map(|row| values[row * width..(row + 1) * width].iter().copied()).collect()
}

fn reference(plan: &Plan<'_>, z: &[f32]) -> Reference {
    let train: Vec<usize> =
        (0..plan.latents.entries()).filter(|&e| plan.latents.meta.splits[e] == Split::Train).collect();
    let numbers = same_captions(plan.captions.iter().map(|caption| words(&caption.text)));
    let captions =
        plan.latents.meta.captions.iter().map(|captions| captions.iter().map(|c| numbers[*c]).collect()).collect();
    Reference::new(real(plan, z), &train, &plan.entries, captions, plan.settings.components)
}

/// Rows of the compared entries.
fn compared(plan: &Plan<'_>, z: &[f32]) -> Vec<f32> {
    let size = plan.latents.meta.crops * plan.width();
    plan.entries.iter().flat_map(|e| z[e * size..(e + 1) * size].iter().copied()).collect()
}

/// Another draw of real latents, as many of each entry as there are samples. It scores like a perfect sampler.
fn fresh(plan: &Plan<'_>) -> Vec<f32> {
    let z = draw(plan, 1);
    let crops = plan.latents.meta.crops;
    let width = plan.width();
    (0..plan.samples())
        .flat_map(|i| {
            let crop = Stream::new(plan.seed, "evaluate.latent_fid/floor", 0, i as u64).below(crops);
            let row = plan.entry(i) * crops + crop;
            z[row * width..(row + 1) * width].iter().copied()
        })
        .collect()
}
