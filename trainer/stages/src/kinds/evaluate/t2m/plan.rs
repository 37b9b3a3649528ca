//! The common plan of an evaluation's shards and merge: clips, captions, crops, and the entries that a repeat leaves
//! out.

use motion::Stream;
use motion::dataset::{Caption, Dataset, crop};
use motion::random::permutation;
use protocol::stage::{EvaluateT2m, Split};
use protocol::{ArtifactKind, Digest, Seed};
use serde::{Deserialize, Serialize};

use super::perturbed::said_otherwise;
use crate::artifacts::{self, word};
use crate::context::{AttemptContext, StageError};
use crate::evaluation::report::no_entries;
use crate::parts::evaluator::TrainedEvaluator;

/// Number of motions computed together.
pub(super) const BLOCK: usize = 32;
/// File of a shard's embeddings.
pub(super) const EMBEDDINGS_FILE: &str = "embeddings.safetensors";

/// Kinds of work units.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Part {
    /// A block of the split's entries.
    Entries,
    /// Additional motions for one caption.
    Many,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Unit {
    pub(super) part: Part,
    pub(super) repeat: usize,
    pub(super) block: usize,
}

/// A caption and a crop of an entry.
#[derive(Debug, Clone, Copy)]
pub(super) struct Draw {
    pub(super) entry: usize,
    pub(super) caption: usize,
    pub(super) start: usize,
    /// Number of frames of the crop.
    pub(super) len: usize,
    /// Number of the entry in its split, and the repeat: they key the other draws of this motion.
    pub(super) number: usize,
    pub(super) repeat: usize,
}

pub(super) struct Plan<'a> {
    pub(super) settings: &'a EvaluateT2m,
    pub(super) seed: Seed,
    pub(super) dataset: Dataset,
    pub(super) entries: Vec<usize>,
    pub(super) trained: TrainedEvaluator,
    pub(super) evaluator: Digest,
    /// The split of the entries.
    pub(super) split: Split,
    /// Paraphrased captions for the model; empty if it gets the dataset's.
    told: Vec<String>,
}

impl<'a> Plan<'a> {
    pub(super) fn read(cx: &dyn AttemptContext, settings: &'a EvaluateT2m) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let refuse = |text: String| Err(StageError::Input(text));
        if settings.repeats == 0 || settings.pools.is_empty() {
            return refuse("`repeats` and `pools` must be at least 1".into());
        }
        let dataset = artifacts::input_dataset(cx)?;
        let (evaluator, manifest) = artifacts::input(cx, "evaluator", ArtifactKind::Evaluator)?;
        let trained = TrainedEvaluator::read(&*blobs, &manifest, &cx.device())?;
        let pool = settings.largest_pool();
        let (mut entries, mut taken) = (dataset.entries_of(settings.split), settings.split);
        if settings.all_if_small && entries.len() < pool {
            (entries, taken) = (dataset.entries_of(Split::All), Split::All);
        }
        if entries.is_empty() {
            return Err(no_entries(taken));
        }
        if entries.len() < pool {
            let instead = match taken {
                Split::All => "the dataset has no more; use smaller `pools`",
                Split::Test => "set `split: all`, or `all_if_small: true`, or smaller `pools`",
                Split::Train | Split::Val => {
                    "set `split: all`, `split: test` (for final results only), `all_if_small: true`, or smaller `pools`"
                }
            };
            return refuse(format!(
                "the split `{}` has {} entries, but R-precision needs pools of {pool}; {instead}",
                word(&taken),
                entries.len()
            ));
        }
        trained.check(&dataset, &entries)?;
        let seed = cx.task().seed;
        let tell = |(i, caption): (usize, &Caption)| {
            let mut stream = Stream::new(seed, "evaluate.t2m/perturbed", 0, i as u64);
            said_otherwise(&caption.text, settings.perturbed, &mut stream)
        };
        let told = match settings.perturbed > 0.0 {
            true => dataset.captions.iter().enumerate().map(tell).collect(),
            false => Vec::new(),
        };
        Ok(Self { settings, seed, dataset, entries, split: taken, trained, evaluator, told })
    }

    /// The text that a model gets for a caption.
    pub(super) fn told(&self, caption: usize) -> &str {
        self.told.get(caption).unwrap_or(&self.dataset.captions[caption].text)
    }

    pub(super) fn stream(&self, what: &str, repeat: usize, index: usize) -> Stream {
        Stream::new(self.seed, &format!("evaluate.t2m/{what}"), repeat as u64, index as u64)
    }

    /// A permutation of the split's entries.
    pub(super) fn order(&self, what: &str, repeat: usize, count: usize) -> Vec<u32> {
        permutation(self.seed, &format!("evaluate.t2m/{what}"), repeat as u64, count)
    }

    /// Number of entries that a repeat measures.
    pub(super) fn kept(&self) -> usize {
        let n = self.entries.len();
        if self.settings.drop_last { n - n % self.settings.first_pool() } else { n }
    }

    /// Draws a caption and a crop of entry number `i` of the split, for the motions (`main`) or for real ones to
    /// compare with.
    pub(super) fn draw(&self, repeat: usize, i: usize, main: bool) -> Draw {
        let entry = &self.dataset.entries[self.entries[i]];
        let mut stream = self.stream(if main { "entry" } else { "other" }, repeat, i);
        let caption = entry.captions[stream.below(entry.captions.len())];
        let (start, len) = crop(&mut stream, entry.len, self.dataset.skeleton());
        Draw { entry: self.entries[i], caption, start, len, number: i, repeat }
    }

    /// Entries whose captions MultiModality uses; none for motions that are not a model's.
    pub(super) fn many(&self, repeat: usize) -> Vec<usize> {
        if !self.settings.generates() {
            return Vec::new();
        }
        let order = self.order("many", repeat, self.entries.len());
        order.into_iter().take(self.settings.multimodality.captions).map(|i| i as usize).collect()
    }

    pub(super) fn units(&self) -> Vec<Unit> {
        let blocks = self.entries.len().div_ceil(BLOCK);
        let of = |part, repeat, blocks: usize| (0..blocks).map(move |block| Unit { part, repeat, block });
        (0..self.settings.repeats)
            .flat_map(|repeat| of(Part::Entries, repeat, blocks).chain(of(Part::Many, repeat, self.many(repeat).len())))
            .collect()
    }

    /// Entries of a block, by number in the split.
    pub(super) fn block(&self, block: usize) -> std::ops::Range<usize> {
        block * BLOCK..((block + 1) * BLOCK).min(self.entries.len())
    }

    pub(super) fn crop(&self, draw: Draw) -> Vec<f32> {
        let width = self.dataset.mean.len();
        let rows = self.dataset.features(&self.dataset.entries[draw.entry]);
        rows[draw.start * width..(draw.start + draw.len) * width].to_vec()
    }
}
