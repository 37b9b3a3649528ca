//! A classifier of motions by action.
//!
//! Statistics over time of the root's path and the joints' positions describe a motion, for any length. Ridge regression on one-hot
//! labels with a Gaussian kernel classifies it: a closed form without draws, so that the same clips give the same
//! answers. Ours; the classifier for the recognition accuracy of Action2Motion (Guo et al., 2020) is a recurrent
//! network.

use motion::Skeleton;
use motion::features::root_path;
use nalgebra::{DMatrix, DVector};

/// Added to the kernel's diagonal, which is 1.
const RIDGE: f64 = 0.05;
/// Standard deviations from the mean that count at most. Statistics that hardly vary in real clips would otherwise
/// outweigh all others in generated motion.
const FARTHEST: f64 = 10.0;
/// Seconds over which channels are averaged, so that shaking is not taken for an activity.
const SMOOTH_SECONDS: f64 = 0.25;

/// Describes a motion of feature rows `[frames, features]` in the data's own scale.
///
/// Channels are the root's heading and place since the first frame, its height, and the joints' positions relative to
/// it. After a running mean over a quarter of a second each has its mean, standard deviation, extremes and mean change
/// from frame to frame. Rotations, velocities and contacts are left out, since they repeat the positions.
pub fn describe(rows: &[f32], skeleton: &Skeleton) -> Vec<f64> {
    let layout = skeleton.layout();
    let width = skeleton.features;
    let around = (SMOOTH_SECONDS * skeleton.fps / 2.0) as usize;
    let turns = rows.chunks_exact(width).scan(0.0, |heading, row| {
        let now = *heading;
        *heading += f64::from(row[layout.yaw.start]);
        Some(now)
    });
    let path = root_path(rows, skeleton);
    let along = |axis: usize| path.iter().map(|(_, at)| at[axis]).collect();
    let body = layout.root_height.start..layout.positions.end;
    let channel = |c: usize| rows.chunks_exact(width).map(|row| f64::from(row[c])).collect();
    let channels = [turns.collect(), along(0), along(2)].into_iter().chain(body.map(channel));
    channels.flat_map(|values: Vec<f64>| statistics(&running_mean(&values, around))).collect()
}

/// Means over `around` values on each side. The first and the last value are repeated at the ends.
fn running_mean(values: &[f64], around: usize) -> Vec<f64> {
    let last = values.len().saturating_sub(1);
    let at = |i: usize| values[i.saturating_sub(around).min(last)];
    let mean = |i: usize| (i..=i + 2 * around).map(at).sum::<f64>() / (2 * around + 1) as f64;
    (0..values.len()).map(mean).collect()
}

/// Mean, standard deviation, extremes and mean change of a channel.
fn statistics(values: &[f64]) -> [f64; 5] {
    let frames = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / frames;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / frames;
    let change: f64 = values.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum();
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [mean, variance.sqrt(), low, high, change / (frames - 1.0).max(1.0)]
}

/// A trained classifier of described motions.
#[derive(Debug)]
pub struct Classifier {
    mean: Vec<f64>,
    scale: Vec<f64>,
    /// The training motions, standardised.
    known: Vec<Vec<f64>>,
    /// Weights of shape [known, classes].
    weights: DMatrix<f64>,
    /// Width of the kernel, for squared distances.
    bandwidth: f64,
}

impl Classifier {
    /// Trains on motions from [`describe`], with the class of each, below `classes`. `None` if there are too few
    /// motions or a value is not finite.
    pub fn fit(motions: &[Vec<f64>], labels: &[usize], classes: usize) -> Option<Self> {
        let n = motions.len();
        let width = motions.first()?.len();
        if n < 2 || labels.len() != n || motions.iter().flatten().any(|v| !v.is_finite()) {
            return None;
        }
        let over = |f: &dyn Fn(&Vec<f64>) -> f64| motions.iter().map(f).sum::<f64>() / n as f64;
        let mean: Vec<f64> = (0..width).map(|i| over(&|m| m[i])).collect();
        let deviation = |i: usize| over(&|m| (m[i] - mean[i]).powi(2)).sqrt();
        // A statistic that does not vary carries no information.
        let scale = (0..width).map(deviation).map(|sd| if sd > 1e-6 { 1.0 / sd } else { 0.0 }).collect();
        let mut fitted = Self { mean, scale, known: vec![], weights: DMatrix::zeros(0, 0), bandwidth: 1.0 };
        let known: Vec<Vec<f64>> = motions.iter().map(|m| fitted.standard(m)).collect();
        let mut distances: Vec<f64> =
            (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| squared(&known[i], &known[j])).collect();
        let middle = distances.len() / 2;
        fitted.bandwidth = distances.select_nth_unstable_by(middle, f64::total_cmp).1.max(f64::MIN_POSITIVE);
        let kernel =
            DMatrix::from_fn(n, n, |i, j| fitted.near(&known[i], &known[j]) + if i == j { RIDGE } else { 0.0 });
        let targets = DMatrix::from_fn(n, classes, |i, class| f64::from(u8::from(labels[i] == class)));
        fitted.weights = kernel.cholesky()?.solve(&targets);
        fitted.known = known;
        Some(fitted)
    }

    /// The predicted class of a described motion.
    pub fn classify(&self, motion: &[f64]) -> usize {
        let motion = self.standard(motion);
        let distances: Vec<f64> = self.known.iter().map(|known| squared(known, &motion)).collect();
        // A common factor changes no order. Without it, a motion that is far from all would be near to none.
        let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
        let near = distances.iter().map(|distance| (-(distance - least) / self.bandwidth).exp());
        (self.weights.transpose() * DVector::from_iterator(distances.len(), near)).argmax().0
    }

    fn standard(&self, motion: &[f64]) -> Vec<f64> {
        let standard = |((v, mean), scale): ((&f64, &f64), &f64)| ((v - mean) * scale).clamp(-FARTHEST, FARTHEST);
        motion.iter().zip(&self.mean).zip(&self.scale).map(standard).collect()
    }

    fn near(&self, a: &[f64], b: &[f64]) -> f64 {
        (-squared(a, b) / self.bandwidth).exp()
    }
}

fn squared(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use motion::random::Stream;
    use protocol::Seed;
    use protocol::stage::DataFormat;

    use super::*;

    /// Rows in which some channels sway at one of two tempos around one of two places.
    fn rows(class: usize, number: u64, skeleton: &Skeleton) -> Vec<f32> {
        let mut stream = Stream::new(Seed(3), "rows", class as u64, number);
        let frames = 40 + stream.below(60);
        let phase = stream.range(0.0, 6.0);
        let speed = [0.2, 0.2, 0.9][class];
        let place = [0.0, 1.5, 0.0][class];
        let mut rows: Vec<f32> = (0..frames * skeleton.features).map(|_| stream.range(-0.3, 0.3) as f32).collect();
        for (t, row) in rows.chunks_exact_mut(skeleton.features).enumerate() {
            row[4..44].iter_mut().for_each(|v| *v += (place + (t as f64 * speed + phase).sin()) as f32);
        }
        rows
    }

    #[test]
    fn places_and_tempos_are_told_apart_at_any_length() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let described = |class, number| describe(&rows(class, number, skeleton), skeleton);
        let labels: Vec<usize> = (0..60).map(|i| i % 3).collect();
        let motions: Vec<Vec<f64>> = labels.iter().enumerate().map(|(i, class)| described(*class, i as u64)).collect();
        let classifier = Classifier::fit(&motions, &labels, 3).expect("sixty motions");
        // A statistic that hardly varies in real clips puts a motion far from all of them alike.
        for class in 0..3 {
            let mut far = described(class, 2000);
            far[0] += 100.0;
            assert_eq!(classifier.classify(&far), class);
        }
        let right = (0..60).filter(|i| classifier.classify(&described(i % 3, 1000 + *i as u64)) == i % 3).count();
        assert!(right >= 54, "{right} of 60");
    }

    #[test]
    fn nothing_is_learnt_from_nothing() {
        assert!(Classifier::fit(&[], &[], 2).is_none());
        assert!(Classifier::fit(&[vec![f64::NAN], vec![1.0]], &[0, 1], 2).is_none());
    }
}
