//! Windows of motion for training tokenizers and decoders of their tokens.

use motion::Stream;
use motion::dataset::Dataset;
use protocol::Seed;
use protocol::stage::{Split, WindowsOf};

use crate::artifacts;
use crate::context::{AttemptContext, StageError};
use crate::train::Pick;
use crate::train::network::no_clips;

/// Windows of one length from the training split's entries. Shorter entries are left out.
pub(crate) struct TokenWindows {
    pub(crate) dataset: Dataset,
    pub(crate) seed: Seed,
    /// The stage's name, which keys the draws.
    pub(crate) purpose: String,
    frames: usize,
    of: WindowsOf,
    /// Entries of at least the window's length.
    train: Vec<usize>,
    /// Cumulative number of windows: before each entry, and in total.
    firsts: Vec<usize>,
}

impl TokenWindows {
    /// Reads the input `dataset`.
    pub(crate) fn read(cx: &dyn AttemptContext, frames: usize, of: WindowsOf) -> Result<Self, StageError> {
        let dataset = artifacts::input_dataset(cx)?;
        let all = dataset.entries_of(Split::Train);
        if all.is_empty() {
            return Err(no_clips());
        }
        let train: Vec<usize> = all.iter().copied().filter(|e| dataset.entries[*e].len >= frames).collect();
        if train.is_empty() {
            let longest = all.iter().map(|e| dataset.entries[*e].len).max().unwrap_or(0);
            return Err(StageError::Input(format!(
                "`window` is {frames} frames, but the longest clip of the training split has {longest}; set a shorter \
                 window"
            )));
        }
        let mut firsts = vec![0];
        for e in &train {
            firsts.push(firsts.last().map_or(0, |last| last + dataset.entries[*e].len - frames + 1));
        }
        Ok(Self { dataset, seed: cx.task().seed, purpose: cx.task().name.to_string(), frames, of, train, firsts })
    }

    /// Number of examples of an epoch.
    pub(crate) fn examples(&self) -> usize {
        match self.of {
            WindowsOf::Clips => self.train.len(),
            WindowsOf::Frames => self.firsts[self.train.len()],
        }
    }

    /// Entry and first frame of the window at a place.
    fn cut(&self, pick: Pick) -> (usize, usize) {
        match self.of {
            WindowsOf::Clips => {
                let entry = self.train[pick.example];
                let spare = self.dataset.entries[entry].len - self.frames;
                let mut draw = Stream::new(self.seed, &format!("{}/window", self.purpose), pick.place, 0);
                (entry, draw.below(spare + 1))
            }
            WindowsOf::Frames => {
                let at = self.firsts.partition_point(|first| *first <= pick.example) - 1;
                (self.train[at], pick.example - self.firsts[at])
            }
        }
    }

    /// Rows `[B, frames, F]` in the data's own scale.
    pub(crate) fn rows(&self, picks: &[Pick]) -> Vec<f32> {
        let width = self.dataset.mean.len();
        let mut rows = Vec::with_capacity(picks.len() * self.frames * width);
        for pick in picks {
            let (entry, start) = self.cut(*pick);
            let from = self.dataset.features(&self.dataset.entries[entry]);
            rows.extend_from_slice(&from[start * width..(start + self.frames) * width]);
        }
        rows
    }
}
