//! A dataset: clips, captions, and the entries that examples are drawn from.
//!
//! An entry is a clip, or the part of a clip that one time-tagged caption describes, in one split. Features are stored
//! as in the files; a caller that needs the network's scale calls [`Dataset::normalise`] on a copy.
//!
//! [`open`](Dataset::open) reads a folder, and [`Dataset::to_files`] writes the artifact's files.

mod entries;
mod folds;
mod open;
mod pack;
mod statistics;

use std::fmt;

use protocol::stage::DataFormat;
use serde::{Deserialize, Serialize};

pub use entries::Unusable;
pub use folds::{DivideError, Divided, Fold, FoldError};
pub(crate) use open::MANY_PROBLEMS;
pub use open::{OpenError, OpenReport, Problem, ProblemKind, Skip, SkipReason, is_clip_id};
pub use pack::{INDEX, PackError};
pub use statistics::statistics;

use crate::Floats;
use crate::random::Stream;
use crate::skeleton::Skeleton;
pub use crate::text::Caption;
use crate::vocabulary;

/// The list that contains an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Entries of `train.txt`.
    Train,
    /// Entries of `val.txt`.
    Val,
    /// Entries of `test.txt`.
    Test,
}

impl Split {
    /// All three splits, in the order in which entries are stored.
    pub const ALL: [Split; 3] = [Split::Train, Split::Val, Split::Test];

    /// The name in settings: `train`, `val` or `test`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Val => "val",
            Self::Test => "test",
        }
    }

    fn is_in(self, wanted: protocol::stage::Split) -> bool {
        use protocol::stage::Split as Wanted;
        matches!(
            (wanted, self),
            (Wanted::All, _) | (Wanted::Train, Self::Train) | (Wanted::Val, Self::Val) | (Wanted::Test, Self::Test)
        )
    }
}

impl fmt::Display for Split {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The features of one motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Clip {
    /// Name of its files.
    pub id: String,
    /// Number of frames L.
    pub frames: usize,
    /// `[L, D]`, not normalised.
    pub features: Floats,
}

/// The frames that an example is cropped from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// The clip's id; a part of a clip is `<id>@<first frame>-<frame after the last>`.
    pub id: String,
    /// Index into [`Dataset::clips`].
    pub clip: usize,
    pub start: usize,
    /// Number of frames.
    pub len: usize,
    /// Indices into [`Dataset::captions`]; at least one.
    pub captions: Vec<usize>,
    /// The split that lists the clip.
    pub split: Split,
}

/// Clips, captions and entries of one folder.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// The format, which decides skeleton and rules.
    pub format: DataFormat,
    /// Mean of each feature, `[D]`.
    pub mean: Vec<f32>,
    /// Scale of each feature, `[D]`, positive.
    pub std: Vec<f32>,
    /// Clips that the entries refer to.
    pub clips: Vec<Clip>,
    /// Captions that the entries refer to.
    pub captions: Vec<Caption>,
    /// Train entries, then validation, then test; inside a split in the order of its list.
    pub entries: Vec<Entry>,
}

impl Dataset {
    /// The skeleton of its format.
    pub fn skeleton(&self) -> &'static Skeleton {
        Skeleton::of(self.format)
    }

    /// The rows `[len, D]` of an entry, not normalised.
    pub fn features(&self, entry: &Entry) -> &[f32] {
        let width = self.skeleton().features;
        &self.clips[entry.clip].features[entry.start * width..(entry.start + entry.len) * width]
    }

    /// Indices of the entries of a split, in order.
    pub fn entries_of(&self, split: protocol::stage::Split) -> Vec<usize> {
        (0..self.entries.len()).filter(|i| self.entries[*i].split.is_in(split)).collect()
    }

    /// The number of times that an epoch draws each entry: see [`vocabulary::draws`]. 1 for all outside the training split.
    pub fn draws(&self, exponent: f64) -> Vec<usize> {
        let mut draws = vec![1; self.entries.len()];
        if exponent > 0.0 {
            let train = self.entries_of(protocol::stage::Split::Train);
            let texts = |e: &usize| self.entries[*e].captions.iter().map(|c| self.captions[*c].text.as_str()).collect();
            let captions: Vec<Vec<&str>> = train.iter().map(texts).collect();
            for (e, times) in train.into_iter().zip(vocabulary::draws(&captions, exponent)) {
                draws[e] = times;
            }
        }
        draws
    }

    /// The deviations [D], those of root and contacts divided by `bias`, which increases their weight.
    pub fn biased_std(&self, bias: f64) -> Vec<f32> {
        let layout = self.skeleton().layout();
        let is_biased = |i: usize| i < layout.positions.start || layout.contacts.contains(&i);
        let divided = |(i, std): (usize, &f32)| if is_biased(i) { (f64::from(*std) / bias) as f32 } else { *std };
        self.std.iter().enumerate().map(divided).collect()
    }

    /// Computes `(x - mean) / std` on rows of D values, in place.
    pub fn normalise(&self, rows: &mut [f32]) {
        normalise(rows, &self.mean, &self.std);
    }

    /// The inverse of [`Dataset::normalise`].
    pub fn denormalise(&self, rows: &mut [f32]) {
        denormalise(rows, &self.mean, &self.std);
    }
}

/// Computes `(x - mean) / std` on rows of as many values as `mean` has, in place.
pub fn normalise(rows: &mut [f32], mean: &[f32], std: &[f32]) {
    for row in rows.chunks_exact_mut(mean.len()) {
        for ((value, mean), std) in row.iter_mut().zip(mean).zip(std) {
            *value = (*value - mean) / std;
        }
    }
}

/// The inverse of [`normalise`].
pub fn denormalise(rows: &mut [f32], mean: &[f32], std: &[f32]) {
    for row in rows.chunks_exact_mut(mean.len()) {
        for ((value, mean), std) in row.iter_mut().zip(mean).zip(std) {
            *value = *value * std + mean;
        }
    }
}

/// Draws the published crop: with probability 2/3 the longest multiple of the unit length, else one unit less; random
/// start. Returns first frame and length.
pub fn crop(stream: &mut Stream, len: usize, skeleton: &Skeleton) -> (usize, usize) {
    let unit = skeleton.unit;
    let shorter = stream.below(3) == 2;
    let units = (len / unit).saturating_sub(usize::from(shorter)).max(1);
    let wanted = (units * unit).min(len);
    (stream.below(len - wanted + 1), wanted)
}

/// Draws a random window for training on short pieces: a multiple of the unit length in `[min, max]`, at most `len`, at
/// a random start. An entry shorter than `min` gives its longest multiple. Returns first frame and length.
pub fn window(stream: &mut Stream, min: usize, max: usize, len: usize, skeleton: &Skeleton) -> (usize, usize) {
    let unit = skeleton.unit;
    let most = (max.min(len) / unit).max(1);
    let least = min.div_ceil(unit).clamp(1, most);
    let wanted = ((least + stream.below(most - least + 1)) * unit).min(len);
    (stream.below(len - wanted + 1), wanted)
}

#[cfg(test)]
mod tests {
    use protocol::Seed;

    use super::*;

    #[test]
    fn crops_follow_the_published_rule() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let mut stream = Stream::new(Seed(1), "crop", 0, 0);
        let mut shorter = 0;
        for _ in 0..3000 {
            let (start, len) = crop(&mut stream, 43, skeleton);
            assert!((len == 40 || len == 36) && start + len <= 43);
            shorter += usize::from(len == 36);
        }
        assert!((900..1100).contains(&shorter), "{shorter}");
        for len in [1, 3, 4, 5, 40] {
            let (start, cropped) = crop(&mut stream, len, skeleton);
            assert!(cropped > 0 && start + cropped <= len);
        }
        for _ in 0..1000 {
            let (start, len) = window(&mut stream, 40, 64, 90, skeleton);
            assert!(len % 4 == 0 && (40..=64).contains(&len) && start + len <= 90);
            assert_eq!(window(&mut stream, 40, 64, 31, skeleton).1, 28);
        }
    }
}
