//! Agreement of sampled latents with real ones and with their captions, without an evaluator network.
//!
//! Source: our own definitions, made to rank students on sets that are too small for a learned evaluator.
//! * `latent_fid`: Frechet distance between samples and real latents in the first principal components of the train
//!   latents, divided by the total variance of the real ones there. 0 is perfect, 1 is every sample at the data's mean.
//!   With few clips it is not 0 even for real motion, so two values of real latents accompany it. The `floor` is
//!   another draw from the posteriors of the same clips, as many as there are samples: the score of a model that
//!   redraws these clips. `halves` compares one half of the clips with the other: the distance of two sets of other
//!   clips, at half the count.
//! * R-precision: each sample ranks the mean latent of its own entry among those of 31 random entries without a common
//!   caption.
//! * `match`: squared distance to another model's samples from the same noise and captions, as a share of their
//!   variance.

use std::collections::{BTreeSet, HashMap};

use motion::Stream;
use motion::random::permutation;
use protocol::Seed;

use super::frechet::{Gaussian, PrincipalComponents, to_f64};
use super::retrieval;

/// Size of the pool in which a sample's own entry is ranked, itself included.
pub const POOL: usize = 32;

/// The real latents of some entries, projected on the components.
#[derive(Debug)]
pub struct Target {
    gaussian: Gaussian,
    total_variance: f64,
}

impl Target {
    fn of(components: &PrincipalComponents, real: Real<'_>, entries: &[usize]) -> Self {
        let size = real.crops * real.width;
        let rows = |e: &usize| components.project(&to_f64(&real.z[e * size..(e + 1) * size]));
        let gaussian = Gaussian::fit(&entries.iter().flat_map(rows).collect::<Vec<f64>>(), components.len());
        Self { total_variance: gaussian.total_variance(), gaussian }
    }

    /// Trace of the covariance.
    pub fn total_variance(&self) -> f64 {
        self.total_variance
    }
}

/// Real data to compare samples with.
#[derive(Debug)]
pub struct Reference {
    components: PrincipalComponents,
    target: Target,
    /// Mean latent of each entry on the components, `[entries, components]`.
    anchors: Vec<f64>,
    /// Captions of each entry; equal captions have equal numbers.
    captions: Vec<BTreeSet<usize>>,
}

/// Real latents, all `[entries, crops, width]`.
#[derive(Debug, Clone, Copy)]
pub struct Real<'a> {
    /// One draw of z from each posterior.
    pub z: &'a [f32],
    pub mu: &'a [f32],
    /// Number of crops per entry.
    pub crops: usize,
    /// Values of a latent, N d.
    pub width: usize,
}

/// Metrics of one set of samples.
#[derive(Debug, Clone, PartialEq)]
pub struct SetMetrics {
    /// Frechet distance divided by the real variance.
    pub latent_fid: f64,
    /// Rank of each sample's own entry, 0 for the nearest.
    pub ranks: Vec<usize>,
    /// Standard deviation over all values of all samples.
    pub latent_std: f64,
}

impl Reference {
    /// Fits the components to the entries `train` and the real distribution to the entries `compared`.
    pub fn new(
        real: Real<'_>,
        train: &[usize],
        compared: &[usize],
        captions: Vec<BTreeSet<usize>>,
        components: usize,
    ) -> Self {
        let entry = real.crops * real.width;
        let rows = |entries: &[usize]| -> Vec<f64> {
            entries.iter().flat_map(|e| to_f64(&real.z[e * entry..(e + 1) * entry])).collect()
        };
        let components = PrincipalComponents::fit(&rows(train), real.width, components);
        let target = Target::of(&components, real, compared);
        let mut means = Vec::with_capacity(real.mu.len() / real.crops);
        for crops in real.mu.chunks_exact(entry) {
            let sum = |i: usize| crops.iter().skip(i).step_by(real.width).map(|v| f64::from(*v)).sum::<f64>();
            means.extend((0..real.width).map(|i| sum(i) / real.crops as f64));
        }
        let anchors = components.project(&means);
        Self { components, target, anchors, captions }
    }

    /// Share of the train latents' variance that the components hold.
    pub fn explained(&self) -> f64 {
        self.components.explained()
    }

    /// The target of all entries to compare with.
    pub fn whole(&self) -> &Target {
        &self.target
    }

    /// Fits the target of `entries` alone.
    pub fn target(&self, real: Real<'_>, entries: &[usize]) -> Target {
        Target::of(&self.components, real, entries)
    }

    /// Frechet distance of `samples`, rows of the latents' width, to `target`, over its variance.
    pub fn distance(&self, target: &Target, samples: &[f32]) -> f64 {
        self.projected_distance(target, &self.components.project(&to_f64(samples)))
    }

    fn projected_distance(&self, target: &Target, projected: &[f64]) -> f64 {
        target.gaussian.distance(&Gaussian::fit(projected, self.components.len())) / target.total_variance
    }

    /// Distance of one half of `entries` to the other, divided by the variance of all of them; a mean over five
    /// divisions into halves. `None` for fewer than four entries.
    pub fn halves(&self, real: Real<'_>, entries: &[usize], seed: Seed) -> Option<f64> {
        const WAYS: u64 = 5;
        if entries.len() < 4 {
            return None;
        }
        let whole = self.target(real, entries);
        let apart = |way: u64| {
            let order = permutation(seed, "evaluate.latent_fid/halves", way, entries.len());
            let (one, other) = order.split_at(entries.len() / 2);
            let half = |of: &[u32]| self.target(real, &of.iter().map(|i| entries[*i as usize]).collect::<Vec<_>>());
            half(one).gaussian.distance(&half(other).gaussian) / whole.total_variance
        };
        Some((0..WAYS).map(apart).sum::<f64>() / WAYS as f64)
    }

    /// The metrics of `samples`, one row for each of `entries`; pools are drawn for `repeat`.
    pub fn measure(&self, samples: &[f32], entries: &[usize], seed: Seed, repeat: u64) -> SetMetrics {
        let dim = self.components.len();
        let projected = self.components.project(&to_f64(samples));
        let rank = |(i, &entry): (usize, &usize)| {
            let mut stream = Stream::new(seed, "evaluate.latent_fid/pool", repeat, i as u64);
            let others = self.pool(entry, &mut stream);
            let anchor = |e: usize| retrieval::row(&self.anchors, e, dim);
            let others = others.into_iter().map(anchor);
            retrieval::rank(retrieval::row(&projected, i, dim), anchor(entry), others)
        };
        SetMetrics {
            latent_fid: self.projected_distance(&self.target, &projected),
            ranks: entries.iter().enumerate().map(rank).collect(),
            latent_std: standard_deviation(samples),
        }
    }

    /// Draws up to 31 different entries without a caption in common with `entry`; fewer on tiny sets.
    fn pool(&self, entry: usize, stream: &mut Stream) -> Vec<usize> {
        let count = self.captions.len();
        // A shuffle that stores only the swapped positions, since most of a large set is never read.
        let mut swapped: HashMap<usize, usize> = HashMap::new();
        let mut pool = Vec::with_capacity(POOL - 1);
        for first in 0..count {
            let drawn = first + stream.below(count - first);
            let candidate = swapped.get(&drawn).copied().unwrap_or(drawn);
            let displaced = swapped.get(&first).copied().unwrap_or(first);
            swapped.insert(drawn, displaced);
            if candidate != entry && self.captions[candidate].is_disjoint(&self.captions[entry]) {
                pool.push(candidate);
            }
            if pool.len() == POOL - 1 {
                break;
            }
        }
        pool
    }
}

/// Share of `ranks` below `k`.
pub fn top(ranks: impl Iterator<Item = usize>, k: usize) -> f64 {
    let (hits, count) =
        ranks.fold((0, 0), |(hits, count): (usize, usize), rank| (hits + usize::from(rank < k), count + 1));
    hits as f64 / count as f64
}

/// Numbers captions so that those with the same words have equal numbers.
pub fn same_captions(captions: impl Iterator<Item = Vec<String>>) -> Vec<usize> {
    let mut known: HashMap<Vec<String>, usize> = HashMap::new();
    captions
        .map(|words| {
            let next = known.len();
            *known.entry(words).or_insert(next)
        })
        .collect()
}

/// Squared distance of `samples` to `others`, row by row, as a share of the variance of `others`; rows of `width` values.
pub fn relative_distance(samples: &[f32], others: &[f32], width: usize) -> f64 {
    let rows = others.len() / width;
    let mut mean = vec![0.0; width];
    for row in others.chunks_exact(width) {
        for (sum, value) in mean.iter_mut().zip(row) {
            *sum += f64::from(*value) / rows as f64;
        }
    }
    let spread: f64 = others.chunks_exact(width).map(|row| squared(row, mean.iter().copied())).sum();
    let apart: f64 = others
        .chunks_exact(width)
        .zip(samples.chunks_exact(width))
        .map(|(row, sample)| squared(row, sample.iter().map(|v| f64::from(*v))))
        .sum();
    apart / spread
}

fn squared(row: &[f32], other: impl Iterator<Item = f64>) -> f64 {
    row.iter().zip(other).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum()
}

/// Standard deviation over all values.
pub fn standard_deviation(values: &[f32]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / count;
    (values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / count).sqrt()
}

/// Mean, and standard deviation with n - 1 when there are two values or more.
pub fn mean_and_spread(values: &[f64]) -> (f64, Option<f64>) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    (mean, (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 6;
    const CROPS: usize = 4;

    /// `entries` distant clusters, two entries per caption.
    fn clusters(entries: usize) -> (Vec<f32>, Vec<BTreeSet<usize>>) {
        let mut stream = Stream::new(Seed(1), "test", 0, 0);
        let mut z = vec![];
        for _ in 0..entries {
            let centre: Vec<f32> = (0..WIDTH).map(|_| 10.0 * stream.normal()).collect();
            for _ in 0..CROPS {
                z.extend(centre.iter().map(|c| c + 0.1 * stream.normal()));
            }
        }
        (z, (0..entries).map(|e| BTreeSet::from([e / 2])).collect())
    }

    #[test]
    fn real_latents_are_close_to_themselves_and_find_their_entry() {
        let (z, captions) = clusters(60);
        let all: Vec<usize> = (0..60).collect();
        let real = Real { z: &z, mu: &z, crops: CROPS, width: WIDTH };
        let reference = Reference::new(real, &all[..50], &all, captions, 4);
        let entries: Vec<usize> = (0..60 * CROPS).map(|row| row / CROPS).collect();
        let found = reference.measure(&z, &entries, Seed(3), 0);
        assert!(found.latent_fid.abs() < 1e-9, "{found:?}");
        assert_eq!(top(found.ranks.into_iter(), 1), 1.0);

        let (mean, _) = mean_and_spread(&z.iter().map(|v| f64::from(*v)).collect::<Vec<_>>());
        assert!(mean.is_finite());
        // With every sample at the data's mean, all of the variance is missing.
        let middle: Vec<f32> =
            (0..WIDTH).map(|i| z.iter().skip(i).step_by(WIDTH).sum::<f32>() / (60 * CROPS) as f32).collect();
        assert!((reference.distance(reference.whole(), &middle.repeat(20)) - 1.0).abs() < 1e-3);
        // Against only their own entries, half of the rows are as near; two halves of other clusters are far apart.
        let some = &all[..30];
        let rows = &z[..30 * CROPS * WIDTH];
        assert!(reference.distance(&reference.target(real, some), rows).abs() < 1e-9);
        assert!(reference.distance(reference.whole(), rows) > 1e-3);
        let apart = reference.halves(real, &all, Seed(3)).expect("enough entries");
        assert!((1e-3..1.0).contains(&apart), "{apart}");
        assert_eq!(reference.halves(real, &all[..3], Seed(3)), None);
    }

    #[test]
    fn pools_hold_no_entry_twice_and_none_with_the_same_caption() {
        let (z, captions) = clusters(40);
        let all: Vec<usize> = (0..40).collect();
        let real = Real { z: &z, mu: &z, crops: CROPS, width: WIDTH };
        let reference = Reference::new(real, &all, &all, captions, 4);
        for entry in 0..40 {
            let pool = reference.pool(entry, &mut Stream::new(Seed(1), "pool", 0, entry as u64));
            assert_eq!(pool.len(), POOL - 1);
            assert_eq!(pool.iter().collect::<BTreeSet<_>>().len(), pool.len());
            assert!(pool.iter().all(|other| other / 2 != entry / 2));
        }
    }

    #[test]
    fn the_relative_distance_is_a_share_of_the_variance() {
        let others = [0.0, 0.0, 2.0, 4.0];
        assert_eq!(relative_distance(&others, &others, 2), 0.0);
        // All samples are at the mean.
        assert_eq!(relative_distance(&[1.0, 2.0, 1.0, 2.0], &others, 2), 1.0);
        let captions = ["A man walks.", "a man", "a man walks"];
        assert_eq!(same_captions(captions.into_iter().map(motion::text::words)), [0, 1, 0]);
        assert_eq!(mean_and_spread(&[1.0, 3.0]), (2.0, Some(2.0f64.sqrt())));
        assert_eq!(mean_and_spread(&[1.0]), (1.0, None));
    }
}
