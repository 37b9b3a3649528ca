//! The common plan of the shards and the merge: captions for the model, units of work, and the entries that a repeat
//! leaves out.

use motion::Stream;
use motion::dataset::Caption;
use protocol::stage::EvaluateT2m;
use serde::{Deserialize, Serialize};

use super::perturbed::said_otherwise;
use crate::context::{AttemptContext, StageError};
use crate::evaluation::entry_draws::EntryDraws;

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

pub(super) struct Plan<'a> {
    pub(super) settings: &'a EvaluateT2m,
    pub(super) of: EntryDraws,
    /// Paraphrased captions for the model; empty if it gets the dataset's.
    told: Vec<String>,
}

impl<'a> Plan<'a> {
    pub(super) fn read(cx: &dyn AttemptContext, settings: &'a EvaluateT2m) -> Result<Self, StageError> {
        if settings.repeats == 0 || settings.pools.is_empty() {
            return Err(StageError::Input("`repeats` and `pools` must be at least 1".into()));
        }
        let pool = (settings.largest_pool(), ", or smaller `pools`");
        let of = EntryDraws::read(cx, settings.split, settings.all_if_small, pool)?;
        let written = |caption: &Caption| {
            let text = caption.perturbed.clone();
            text.ok_or_else(|| {
                StageError::Input(
                    "`perturbed_texts`: a caption has no fifth field; expected \
                     `caption#word/POS ...#from#to#perturbed caption` in each line of `texts/`"
                        .into(),
                )
            })
        };
        let tell = |(i, caption): (usize, &Caption)| {
            let mut stream = Stream::new(of.seed, "evaluate.t2m/perturbed", 0, i as u64);
            said_otherwise(&caption.text, settings.perturbed, &mut stream)
        };
        let captions = &of.dataset.captions;
        let told = if settings.perturbed_texts {
            captions.iter().map(written).collect::<Result<_, _>>()?
        } else if settings.perturbed > 0.0 {
            captions.iter().enumerate().map(tell).collect()
        } else {
            Vec::new()
        };
        Ok(Self { settings, of, told })
    }

    /// The text that a model gets for a caption.
    pub(super) fn told(&self, caption: usize) -> &str {
        self.told.get(caption).unwrap_or(&self.of.dataset.captions[caption].text)
    }

    /// Number of entries that a repeat measures.
    pub(super) fn kept(&self) -> usize {
        let n = self.of.entries.len();
        if self.settings.drop_last { n - n % self.settings.first_pool() } else { n }
    }

    /// Entries whose captions MultiModality uses; none for motions that are not a model's.
    pub(super) fn many(&self, repeat: usize) -> Vec<usize> {
        match self.settings.generates() {
            true => self.of.some("many", repeat, self.of.entries.len(), self.settings.multimodality.captions),
            false => Vec::new(),
        }
    }

    pub(super) fn units(&self) -> Vec<Unit> {
        let blocks = self.of.blocks();
        let of = |part, repeat, blocks: usize| (0..blocks).map(move |block| Unit { part, repeat, block });
        (0..self.settings.repeats)
            .flat_map(|repeat| of(Part::Entries, repeat, blocks).chain(of(Part::Many, repeat, self.many(repeat).len())))
            .collect()
    }
}
