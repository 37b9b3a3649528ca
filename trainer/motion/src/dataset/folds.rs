//! Folds of a dataset for cross-validation, which differ in their lists alone.

use std::collections::{BTreeMap, BTreeSet};

use protocol::Seed;

use super::pack::{INDEX, Index, PackError};
use super::{Dataset, Split};
use crate::random::Stream;

/// A dataset that cannot be divided so often.
#[derive(Debug, thiserror::Error)]
#[error("the train and validation splits have {groups} recordings; expected at least one for each of {folds} folds")]
pub struct FoldError {
    groups: usize,
    folds: usize,
}

/// One of several divisions of train and validation entries.
#[derive(Debug, Clone, Copy)]
pub struct Fold<'a> {
    /// Keys the order of recordings, so that all folds of a run divide the same order.
    pub seed: Seed,
    /// The recording of each clip. A clip that is not listed is a recording of its own, with its mirrored twin.
    pub sources: &'a BTreeMap<String, String>,
    /// Number of folds.
    pub folds: usize,
    /// The fold that becomes the validation split, from 1.
    pub fold: usize,
}

/// The index of a dataset with other splits.
#[derive(Debug)]
pub struct Divided {
    /// Content of [`INDEX`].
    pub index: Vec<u8>,
    /// Number of entries of train, validation and test.
    pub counts: [usize; 3],
}

/// A dataset that cannot be divided into folds.
#[derive(Debug, thiserror::Error)]
pub enum DivideError {
    #[error(transparent)]
    Pack(#[from] PackError),
    #[error(transparent)]
    Fold(#[from] FoldError),
}

impl Dataset {
    /// Divides the dataset with this index into folds, without a clip.
    ///
    /// # Errors
    /// If the index does not read, has an entry of a clip that it does not list, or has too few recordings.
    pub fn divided(index: &[u8], fold: &Fold<'_>) -> Result<Divided, DivideError> {
        let bad = |what: String| PackError::Content { file: INDEX.into(), what };
        let mut index: Index = serde_json::from_slice(index).map_err(|e| bad(e.to_string()))?;
        if let Some(entry) = index.entries.iter().find(|entry| entry.clip >= index.clips.len()) {
            return Err(bad(format!("entry {} is of clip {}, which is not listed", entry.id, entry.clip)).into());
        }
        index.divide(fold)?;
        let counts = Split::ALL.map(|split| index.entries.iter().filter(|entry| entry.split == split).count());
        let index = serde_json::to_vec(&index).map_err(|e| bad(e.to_string()))?;
        Ok(Divided { index, counts })
    }
}

impl Index {
    /// Moves the entries of a fold to the validation split and all others of train and validation to the train split.
    fn divide(&mut self, fold: &Fold<'_>) -> Result<(), FoldError> {
        let mut sizes: BTreeMap<String, usize> = BTreeMap::new();
        for entry in self.entries.iter().filter(|entry| entry.split != Split::Test) {
            *sizes.entry(source(&self.clips[entry.clip].id, fold.sources).to_owned()).or_default() += 1;
        }
        if sizes.len() < fold.folds {
            return Err(FoldError { groups: sizes.len(), folds: fold.folds });
        }
        let held = held_out(&sizes, fold);
        for entry in self.entries.iter_mut().filter(|entry| entry.split != Split::Test) {
            let is_held = held.contains(source(&self.clips[entry.clip].id, fold.sources));
            entry.split = if is_held { Split::Val } else { Split::Train };
        }
        self.entries.sort_by_key(|entry| entry.split);
        Ok(())
    }
}

/// The recordings of a fold. Recordings in a random order fill the folds one after the other, each up to its share of the
/// entries, but with one recording at least.
fn held_out(sizes: &BTreeMap<String, usize>, fold: &Fold<'_>) -> BTreeSet<String> {
    let draw = |source: &str| Stream::new(fold.seed, &format!("data/fold/{source}"), 0, 0).bits();
    let mut order: Vec<(u64, &String, usize)> =
        sizes.iter().map(|(source, size)| (draw(source), source, *size)).collect();
    order.sort_unstable();
    let total: usize = sizes.values().sum();
    let mut current = 1;
    let mut before = 0;
    let mut begun = false;
    let mut held = BTreeSet::new();
    for (i, (_, source, size)) in order.iter().enumerate() {
        // A fold is full at its share, or if every recording left is needed for the folds behind it.
        let full = before * fold.folds >= total * current || order.len() - i <= fold.folds - current;
        if begun && full && current < fold.folds {
            current += 1;
        }
        begun = true;
        before += size;
        if current == fold.fold {
            held.insert((*source).clone());
        }
    }
    held
}

/// The recording of a clip. The published sets and ours name the mirrored twin of `000021` `M000021`.
fn source<'a>(id: &'a str, sources: &'a BTreeMap<String, String>) -> &'a str {
    sources.get(id).map_or_else(|| id.strip_prefix('M').unwrap_or(id), String::as_str)
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;

    use super::*;
    use crate::dataset::Entry;
    use crate::dataset::pack::ClipRow;

    /// Ten recordings of two parts and their twins; the last two are for the test.
    fn index() -> (Index, BTreeMap<String, String>) {
        let mut clips = Vec::new();
        let mut sources = BTreeMap::new();
        for take in 0..10 {
            for id in [format!("{take}a"), format!("{take}b"), format!("M{take}a"), format!("M{take}b")] {
                sources.insert(id.clone(), format!("take {take}"));
                clips.push(ClipRow { id, frames: 60, shard: 0 });
            }
        }
        let entry = |clip: usize| {
            let split = if clip >= 32 { Split::Test } else { Split::Train };
            Entry { id: clips[clip].id.clone(), clip, start: 0, len: 60, captions: vec![0], split }
        };
        let entries = (0..40).map(entry).collect();
        let format = DataFormat::Humanml3d;
        let index = Index { version: 1, format, mean: vec![], std: vec![], clips, captions: vec![], entries };
        (index, sources)
    }

    #[test]
    fn each_recording_is_held_out_once_and_the_test_split_stays() {
        let mut all = BTreeSet::new();
        for fold in 1..=4 {
            let (mut index, sources) = index();
            index.divide(&Fold { seed: Seed(5), sources: &sources, folds: 4, fold }).unwrap();
            let of = |split: Split| {
                let own = index.entries.iter().filter(move |entry| entry.split == split);
                own.map(|entry| sources[&entry.id].clone()).collect::<BTreeSet<_>>()
            };
            let (train, val, test) = (of(Split::Train), of(Split::Val), of(Split::Test));
            assert_eq!((train.len(), val.len(), test.len()), (6, 2, 2));
            assert!(train.is_disjoint(&val) && test.is_disjoint(&train) && test.is_disjoint(&val));
            assert!(index.entries.is_sorted_by_key(|entry| entry.split));
            all.extend(val);
        }
        assert_eq!(all.len(), 8);
    }

    #[test]
    fn a_twin_of_a_published_set_is_in_the_fold_of_its_clip() {
        let (mut index, _) = index();
        index.divide(&Fold { seed: Seed(5), sources: &BTreeMap::new(), folds: 3, fold: 2 }).unwrap();
        let split: BTreeMap<&str, Split> = index.entries.iter().map(|entry| (entry.id.as_str(), entry.split)).collect();
        assert!((0..10).all(|take| split[&*format!("{take}a")] == split[&*format!("M{take}a")]));
    }

    #[test]
    fn every_fold_has_a_recording_even_if_one_has_most_entries() {
        let sizes = BTreeMap::from([("a".to_owned(), 100), ("b".to_owned(), 1), ("c".to_owned(), 1)]);
        let none = BTreeMap::new();
        let fold = |fold| held_out(&sizes, &Fold { seed: Seed(1), sources: &none, folds: 3, fold });
        assert!((1..=3).all(|number| fold(number).len() == 1));
    }

    #[test]
    fn too_few_recordings_are_refused() {
        let (mut index, sources) = index();
        let refused = index.divide(&Fold { seed: Seed(5), sources: &sources, folds: 9, fold: 1 }).unwrap_err();
        assert!(refused.to_string().contains("have 8 recordings"), "{refused}");
    }
}
