//! Common part of the evaluations in an evaluator's space: the entries of a split, a caption and a crop of each entry
//! in every repeat, and the metrics of their embeddings.
//!
//! All draws are keyed by (seed, repeat, entry) and not by the stage's name or kind. So two models of a run are
//! compared on the same captions, lengths and noise. Motions are made in blocks that depend only on the entry's number.

use std::collections::BTreeMap;
use std::ops::Range;

use motion::dataset::{Dataset, crop};
use motion::features::recover_joints;
use motion::random::permutation;
use motion::{Skeleton, Stream};
use protocol::stage::{Sampler, Split};
use protocol::{ArtifactKind, Digest, Seed};

use super::report::no_entries;
use crate::artifacts::{self, word};
use crate::context::{AttemptContext, StageError};
use crate::generate::generator::{self, MotionGenerator};
use crate::metrics::frechet::Gaussian;
use crate::metrics::retrieval::in_groups;
use crate::metrics::{skating, spread};
use crate::parts::evaluator::TrainedEvaluator;

/// Number of motions computed together.
pub(crate) const BLOCK: usize = 32;
/// Size of the pool in which a caption's own motion is ranked.
pub(crate) const POOL: usize = 32;
/// Motions per dimension below which FID's covariances are unreliable.
const FEW: usize = 5;

/// A caption and a crop of an entry.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Draw {
    pub(crate) entry: usize,
    pub(crate) caption: usize,
    pub(crate) start: usize,
    pub(crate) len: usize,
}

/// The entries of a split, and their evaluator.
pub(crate) struct EntryDraws {
    pub(crate) seed: Seed,
    pub(crate) dataset: Dataset,
    pub(crate) entries: Vec<usize>,
    pub(crate) trained: TrainedEvaluator,
    pub(crate) evaluator: Digest,
    /// The split of the entries.
    pub(crate) split: Split,
}

impl EntryDraws {
    /// Reads the inputs `dataset` and `evaluator`.
    pub(crate) fn read(
        cx: &dyn AttemptContext,
        split: Split,
        all_if_small: bool,
        repeats: usize,
    ) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let refuse = |text: String| Err(StageError::Input(text));
        let dataset = artifacts::input_dataset(cx)?;
        let (evaluator, manifest) = artifacts::input(cx, "evaluator", ArtifactKind::Evaluator)?;
        let trained = TrainedEvaluator::read(&*blobs, &manifest, &cx.device())?;
        let (mut entries, mut taken) = (dataset.entries_of(split), split);
        if all_if_small && entries.len() < POOL {
            (entries, taken) = (dataset.entries_of(Split::All), Split::All);
        }
        if entries.is_empty() {
            return Err(no_entries(taken));
        }
        if entries.len() < POOL {
            let instead = match taken {
                Split::All => "the dataset has no more",
                Split::Test => "set `split: all`, or `all_if_small: true`",
                Split::Train | Split::Val => {
                    "set `split: all`, `split: test` (for final results only) or `all_if_small: true`"
                }
            };
            return refuse(format!(
                "the split `{}` has {} entries, but R-precision needs pools of {POOL}; {instead}",
                word(&taken),
                entries.len()
            ));
        }
        trained.check(&dataset, &entries)?;
        if repeats == 0 {
            return refuse("`repeats` is 0; expected at least 1".into());
        }
        Ok(Self { seed: cx.task().seed, dataset, entries, split: taken, trained, evaluator })
    }

    pub(crate) fn stream(&self, what: &str, repeat: usize, index: usize) -> Stream {
        Stream::new(self.seed, &format!("evaluate.t2m/{what}"), repeat as u64, index as u64)
    }

    /// A permutation of `n` items for one repeat.
    pub(crate) fn order(&self, what: &str, repeat: usize, n: usize) -> Vec<u32> {
        permutation(self.seed, &format!("evaluate.t2m/{what}"), repeat as u64, n)
    }

    /// Draws a caption and a crop of entry number `i` of the split, for the motions (`main`) or for real ones to
    /// compare with.
    pub(crate) fn draw(&self, repeat: usize, i: usize, main: bool) -> Draw {
        let entry = &self.dataset.entries[self.entries[i]];
        let mut stream = self.stream(if main { "entry" } else { "other" }, repeat, i);
        let caption = entry.captions[stream.below(entry.captions.len())];
        let (start, len) = crop(&mut stream, entry.len, self.dataset.skeleton());
        Draw { entry: self.entries[i], caption, start, len }
    }

    pub(crate) fn blocks(&self) -> usize {
        self.entries.len().div_ceil(BLOCK)
    }

    /// Entries of a block, by number in the split.
    pub(crate) fn block(&self, block: usize) -> Range<usize> {
        block * BLOCK..((block + 1) * BLOCK).min(self.entries.len())
    }

    pub(crate) fn crop(&self, draw: Draw) -> Vec<f32> {
        let width = self.dataset.mean.len();
        let rows = self.dataset.features(&self.dataset.entries[draw.entry]);
        rows[draw.start * width..(draw.start + draw.len) * width].to_vec()
    }

    /// Opens the model to be measured, and checks its format and sampler.
    pub(crate) fn open(
        &self,
        cx: &dyn AttemptContext,
        sampler: &Sampler,
    ) -> Result<Box<dyn MotionGenerator>, StageError> {
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let generator = generator::open(&manifest, &*cx.blobs(), &cx.device())?;
        let (ours, theirs) = (generator.format(), self.dataset.format);
        if ours != theirs {
            return Err(StageError::Input(format!(
                "`model` generates motions in format `{}`, but the dataset has format `{}`; use a dataset in the \
                 model's format",
                ours.name(),
                theirs.name()
            )));
        }
        generator::check_sampler(&*generator, sampler)?;
        Ok(generator)
    }

    /// FID, R-precision, MM-Dist and diversity of one repeat from embeddings of captions, motions and real crops, one
    /// row per entry. `shuffled` assigns the captions at random.
    pub(crate) fn in_space(
        &self,
        repeat: usize,
        (text, made, real): (&[f64], &[f64], &[f64]),
        shuffled: bool,
    ) -> BTreeMap<&'static str, f64> {
        let (width, n) = (self.trained.width(), self.entries.len());
        let pools = self.order("pools", repeat, n);
        let dealt = if shuffled { self.order("shuffled", repeat, n) } else { pools.clone() };
        let found = in_groups(&reorder(text, &dealt, width), &reorder(made, &pools, width), width, POOL);
        let pairs = spread::DIVERSITY_PAIRS.min(n);
        let drawn = |what: &str| -> Vec<usize> {
            self.order(what, repeat, n).into_iter().take(pairs).map(|i| i as usize).collect()
        };
        BTreeMap::from([
            ("fid", Gaussian::fit(real, width).distance(&Gaussian::fit(made, width)).max(0.0)),
            ("r_precision_top1", found.top[0]),
            ("r_precision_top2", found.top[1]),
            ("r_precision_top3", found.top[2]),
            ("mm_dist", found.matching_score),
            ("diversity", spread::diversity(made, width, &drawn("diversity 1"), &drawn("diversity 2"))),
        ])
    }

    /// A warning if FID is unreliable with so few motions.
    pub(crate) fn few(&self) -> Option<String> {
        let (samples, width) = (self.entries.len(), self.trained.width());
        (samples < FEW * width).then(|| {
            format!(
                "FID is taken of {samples} motions in {width} dimensions; it is then larger than of many, and compares \
                 only with FIDs of as many motions in the same evaluator"
            )
        })
    }

    /// Logs what a reader of the metrics needs: the split, and warnings about it.
    pub(crate) fn log(&self, cx: &mut dyn AttemptContext, asked: Split) {
        if let Some(few) = self.few() {
            cx.log(&few);
        }
        if self.split != asked {
            cx.log(&format!(
                "the split `{}` is too small for pools of {POOL}; all {} entries are measured",
                word(&asked),
                self.entries.len()
            ));
        }
    }
}

/// Share of a motion's steps in which a foot skates.
pub(crate) fn skates(features: &[f32], skeleton: &Skeleton) -> f32 {
    let joints = recover_joints(features, skeleton);
    let metres: Vec<f64> = joints.iter().map(|v| f64::from(*v) * skeleton.metres_per_unit).collect();
    skating::ratio(&metres, skeleton.joints, skating::feet(skeleton.format), skeleton.fps) as f32
}

/// Refuses metrics that are not finite.
pub(crate) fn finite(metrics: &BTreeMap<String, f64>) -> Result<(), StageError> {
    match metrics.iter().find(|(_, value)| !value.is_finite()) {
        Some((name, value)) => Err(StageError::Input(format!(
            "`{name}` is {value}: the embeddings are not finite; train the evaluator again"
        ))),
        None => Ok(()),
    }
}

/// Reorders the rows of `values` by `rows`.
fn reorder(values: &[f64], rows: &[u32], width: usize) -> Vec<f64> {
    rows.iter().flat_map(|row| values[*row as usize * width..(*row as usize + 1) * width].iter().copied()).collect()
}
