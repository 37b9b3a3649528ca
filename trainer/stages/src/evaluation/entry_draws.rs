//! Common part of the evaluations in an evaluator's space: the entries of a split, a caption and a crop of each entry
//! in every repeat, and the metrics of their embeddings.
//!
//! All draws are keyed by (seed, repeat, entry) and not by the stage's name or kind. So two models of a run are
//! compared on the same captions, lengths and noise. Motions are made in blocks that depend only on the entry's number.

use std::collections::BTreeMap;
use std::ops::Range;

use motion::Stream;
use motion::dataset::{Dataset, crop};
use motion::random::permutation;
use protocol::stage::Split;
use protocol::{ArtifactKind, Digest, Seed};
use serde_json::{Value, json};

use super::report::{Repeats, joined, no_entries, publish_illustrated};
use crate::artifacts::{self, word};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::metrics::frechet::Gaussian;
use crate::metrics::retrieval::in_groups;
use crate::metrics::spread;
use crate::parts::evaluator::TrainedEvaluator;

/// Number of motions computed together.
pub(crate) const BLOCK: usize = 32;
/// Motions per dimension below which FID's covariances are unreliable.
const FEW: usize = 5;

/// A caption and a crop of an entry.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Draw {
    pub(crate) entry: usize,
    pub(crate) caption: usize,
    pub(crate) start: usize,
    /// Number of frames of the crop.
    pub(crate) len: usize,
    /// Number of the entry in its split, and the repeat: they key the other draws of this motion.
    pub(crate) number: usize,
    pub(crate) repeat: usize,
}

/// Rules for ranking a motion among those of other captions.
pub(crate) struct Ranking<'a> {
    /// Sizes of the pools.
    pub(crate) pools: &'a [usize],
    /// Number of entries that a repeat measures.
    pub(crate) kept: usize,
    /// True if the captions are assigned at random.
    pub(crate) shuffled: bool,
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
    /// Size of the largest pool.
    pool: usize,
}

impl EntryDraws {
    /// Reads the inputs `dataset` and `evaluator`. The split needs as many entries as a pool; `smaller` says in the
    /// error how pools become smaller.
    pub(crate) fn read(
        cx: &dyn AttemptContext,
        split: Split,
        all_if_small: bool,
        (pool, smaller): (usize, &str),
    ) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let dataset = artifacts::input_dataset(cx)?;
        let (evaluator, manifest) = artifacts::input(cx, "evaluator", ArtifactKind::Evaluator)?;
        let trained = TrainedEvaluator::read(&*blobs, &manifest, &cx.device())?;
        let mut entries = dataset.entries_of(split);
        let mut taken = split;
        if all_if_small && entries.len() < pool {
            (entries, taken) = (dataset.entries_of(Split::All), Split::All);
        }
        if entries.is_empty() {
            return Err(no_entries(taken));
        }
        if entries.len() < pool {
            let instead = match taken {
                Split::All => "the dataset has no more",
                Split::Test => "set `split: all`, or `all_if_small: true`",
                Split::Train | Split::Val => {
                    "set `split: all`, `split: test` (for final results only) or `all_if_small: true`"
                }
            };
            return Err(StageError::Input(format!(
                "the split `{}` has {} entries, but R-precision needs pools of {pool}; {instead}{smaller}",
                word(&taken),
                entries.len()
            )));
        }
        trained.check(&dataset, &entries)?;
        Ok(Self { seed: cx.task().seed, dataset, entries, split: taken, trained, evaluator, pool })
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
        Draw { entry: self.entries[i], caption, start, len, number: i, repeat }
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

    /// FID, R-precision, MM-Dist and diversity of one repeat from embeddings of captions, motions and real crops, one
    /// row per entry.
    pub(crate) fn in_space(
        &self,
        repeat: usize,
        (text, made, real): (&[f64], &[f64], &[f64]),
        ranking: &Ranking<'_>,
    ) -> BTreeMap<String, f64> {
        let width = self.trained.width();
        let n = self.entries.len();
        // Entries that do not fill a pool are at the end of its permutation.
        let pools = self.order("pools", repeat, n);
        let dealt = if ranking.shuffled { self.order("shuffled", repeat, n) } else { pools.clone() };
        let text = reorder(text, &dealt[..ranking.kept], width);
        let ranked = reorder(made, &pools[..ranking.kept], width);
        let mut metrics = BTreeMap::new();
        for (i, pool) in ranking.pools.iter().enumerate() {
            let suffix = if i == 0 { String::new() } else { format!("_pool{pool}") };
            let found = in_groups(&text, &ranked, width, *pool);
            for (k, top) in found.top.into_iter().enumerate() {
                metrics.insert(format!("r_precision_top{}{suffix}", k + 1), top);
            }
            metrics.insert(format!("mm_dist{suffix}"), found.matching_score);
        }
        let rows = self.kept(repeat, ranking.kept);
        let made = reorder(made, &rows, width);
        let real = reorder(real, &rows, width);
        let pairs = spread::DIVERSITY_PAIRS.min(rows.len());
        let [first, second] = ["diversity 1", "diversity 2"].map(|what| self.some(what, repeat, rows.len(), pairs));
        metrics.insert("fid".to_owned(), Gaussian::fit(&real, width).distance(&Gaussian::fit(&made, width)).max(0.0));
        metrics.insert("diversity".to_owned(), spread::diversity(&made, width, &first, &second));
        metrics
    }

    /// Numbers of the `count` entries that a repeat measures, in their order in the split.
    pub(crate) fn kept(&self, repeat: usize, count: usize) -> Vec<u32> {
        let mut rows = self.order("pools", repeat, self.entries.len());
        rows.truncate(count);
        rows.sort_unstable();
        rows
    }

    /// The first `count` items of a permutation of `n`.
    pub(crate) fn some(&self, what: &str, repeat: usize, n: usize, count: usize) -> Vec<usize> {
        self.order(what, repeat, n).into_iter().take(count).map(|i| i as usize).collect()
    }

    /// Uploads the report of `samples` motions a repeat, and ends the stage; `asked` is the split of the settings, and
    /// `meta` and `details` are the kind's own.
    pub(crate) fn publish(
        &self,
        cx: &mut dyn AttemptContext,
        asked: Split,
        samples: usize,
        (mut metrics, repeats): (BTreeMap<String, f64>, Repeats),
        (meta, details): (Value, Value),
    ) -> Result<Outcome, StageError> {
        let entries = self.entries.len();
        let width = self.trained.width();
        let few = (samples < FEW * width).then(|| {
            format!(
                "FID is taken of {samples} motions in {width} dimensions; it is then larger than of many, and compares \
                 only with FIDs of as many motions in the same evaluator"
            )
        });
        few.iter().for_each(|few| cx.log(few));
        if self.split != asked {
            cx.log(&format!(
                "the split `{}` is too small for pools of {}; all {entries} entries are measured",
                word(&asked),
                self.pool
            ));
        }
        metrics.insert("samples".to_owned(), samples as f64);
        let common = json!({
            "split": self.split,
            "evaluator": self.evaluator,
            "words": self.trained.meta().words,
        });
        let common_details = json!({
            "split": self.split,
            "seed": self.seed,
            "samples_per_repeat": samples,
            "note": few,
            "repeats": repeats,
        });
        publish_illustrated(cx, metrics, joined(common, meta), joined(common_details, details), vec![])
    }
}

/// Reorders the rows of `values` by `rows`.
pub(crate) fn reorder(values: &[f64], rows: &[u32], width: usize) -> Vec<f64> {
    rows.iter().flat_map(|row| values[*row as usize * width..(*row as usize + 1) * width].iter().copied()).collect()
}
