//! The examples in a step's batch: a function of (seed, step), never of an iterator.
//!
//! Each epoch takes the examples in a keyed permutation. If they have lengths, a pool of several batches is sorted by
//! length and cut into batches again. So a batch and its slices have little padding and even cost. The batches of a pool
//! are in a keyed order. Each place in the sequence of examples has a number that keys all other draws of the example.

use std::collections::HashMap;
use std::ops::Range;

use motion::random::permutation;
use protocol::Seed;

/// One example of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pick {
    /// Place in the sequence of all examples of the phase; keys every draw about the example.
    pub place: u64,
    /// Index of the example in the data set.
    pub example: usize,
}

/// The order of the examples of one phase of a stage.
#[derive(Debug)]
pub struct Order {
    seed: Seed,
    purpose: String,
    examples: usize,
    batch: usize,
    pool: usize,
    epochs: HashMap<u64, Vec<u32>>,
}

impl Order {
    /// Takes `batch` of `examples` examples per step; `pool` batches are sorted by length together.
    pub fn new(seed: Seed, purpose: &str, examples: usize, batch: usize, pool: usize) -> Self {
        Self { seed, purpose: purpose.to_owned(), examples, batch, pool, epochs: HashMap::new() }
    }

    /// Returns true if several batches are sorted together.
    pub fn is_pooled(&self) -> bool {
        self.pool > 1
    }

    fn at(&mut self, place: u64) -> Pick {
        let n = self.examples as u64;
        let epoch = place / n;
        if !self.epochs.contains_key(&epoch) {
            self.epochs.retain(|e, _| e + 2 > epoch);
            let order = permutation(self.seed, &format!("{}/order", self.purpose), epoch, self.examples);
            self.epochs.insert(epoch, order);
        }
        #[expect(clippy::cast_possible_truncation, reason = "below the number of examples")]
        let example = self.epochs[&epoch][(place % n) as usize] as usize;
        Pick { place, example }
    }

    /// The batch of the phase's step `step`, shortest first. `length` returns an example's length at its place.
    pub fn batch(&mut self, step: u64, mut length: impl FnMut(Pick) -> usize) -> Vec<Pick> {
        let batch = self.batch as u64;
        let pool = self.pool as u64;
        let first = step / pool * pool * batch;
        let mut picks: Vec<(usize, Pick)> = (first..first + pool * batch)
            .map(|place| {
                let pick = self.at(place);
                (length(pick), pick)
            })
            .collect();
        picks.sort_by_key(|(len, pick)| (*len, pick.place));
        let turns = permutation(self.seed, &format!("{}/pool", self.purpose), step / pool, self.pool);
        #[expect(clippy::cast_possible_truncation, reason = "below the pool's size")]
        let turn = turns[(step % pool) as usize] as usize;
        picks[turn * self.batch..(turn + 1) * self.batch].iter().map(|(_, pick)| *pick).collect()
    }

    /// The range of slice `slice` of `slices` in a batch.
    pub fn slice(&self, slice: usize, slices: usize) -> Range<usize> {
        self.batch * slice / slices..self.batch * (slice + 1) / slices
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_shows_each_example_once_whatever_the_lengths() {
        let mut order = Order::new(Seed(7), "vae", 24, 6, 2);
        let mut seen: Vec<usize> = (0..4).flat_map(|s| order.batch(s, |p| p.example % 5)).map(|p| p.example).collect();
        seen.sort_unstable();
        assert_eq!(seen, (0..24).collect::<Vec<_>>());
        assert_eq!(order.batch(9, |_| 1), Order::new(Seed(7), "vae", 24, 6, 2).batch(9, |_| 1), "no memory");
        let lengths: Vec<usize> = order.batch(3, |p| p.example % 5).iter().map(|p| p.example % 5).collect();
        assert!(lengths.is_sorted());
    }

    #[test]
    fn slices_cover_the_batch() {
        let order = Order::new(Seed(7), "vae", 24, 10, 1);
        let all: Vec<usize> = (0..4).flat_map(|s| order.slice(s, 4)).collect();
        assert_eq!(all, (0..10).collect::<Vec<_>>());
    }
}
