//! DPM-Solver, DPM-Solver++ and the stochastic DPM-Solver++: multistep, second order, midpoint.
//!
//! Source: Lu et al., arXiv:2206.00927 (noise) and arXiv:2211.01095 (data and its stochastic form), with the settings
//! of published motion models. StableMoFusion uses the stochastic form on the noise levels of Karras et al.,
//! arXiv:2206.00364 (rho 7), and calls the network at the timestep nearest to a level. Its code did not pin the
//! library. Up to one version the library repeats the last level, so that the last move changes nothing. Later versions
//! end at level 0, so that the last move returns the clean estimate. [`Last`] selects between the two.
//!
//! Notation: `lambda = ln(alpha / sigma)`; a move from t to s has `h = lambda_s - lambda_t`. The first move is first
//! order. The last move is first order too if there are fewer than 15, and so is any move to level 0.

use burn::tensor::Tensor;

use super::{Schedule, affine_one};

/// The last move may be second order from this many moves on.
const MANY: usize = 15;
/// Exponent of the level spacing of Karras et al.
const RHO: f64 = 7.0;

/// The quantity that the solver integrates exactly, and the noise it adds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// The predicted noise: DPM-Solver.
    Noise,
    /// The predicted sample: DPM-Solver++.
    Data,
    /// The predicted sample, with fresh noise in every move: the stochastic DPM-Solver++.
    StochasticData,
}

/// End of the last move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Last {
    /// Level 0, without noise.
    Zero,
    /// The level of the move before, so that the last move changes nothing.
    Repeated,
}

/// A noise level: the network's timestep there, and the factors of signal and noise.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Level {
    t: usize,
    alpha: f64,
    sigma: f64,
}

impl Level {
    /// The level with the ratio `sigma / alpha`, where `alpha^2 + sigma^2 = 1`.
    fn of_ratio(t: usize, ratio: f64) -> Self {
        let alpha = 1.0 / (ratio * ratio + 1.0).sqrt();
        Self { t, alpha, sigma: ratio * alpha }
    }

    fn lambda(self) -> f64 {
        (self.alpha / self.sigma).ln()
    }
}

/// The levels that a solver visits; each move leads from one to the next.
#[derive(Debug, Clone, PartialEq)]
pub struct DpmPath {
    levels: Vec<Level>,
}

/// `sigma / alpha` of a timestep.
fn ratio(schedule: &Schedule, t: usize) -> f64 {
    schedule.sigma(t) / schedule.alpha(t)
}

/// The timestep whose level is nearest to `log` in the logarithm. A level beyond the table, which only rounding can
/// cause, gives its first or last timestep.
fn nearest(logs: &[f64], log: f64) -> usize {
    let low = logs.iter().filter(|known| **known <= log).count().clamp(1, logs.len() - 1) - 1;
    let share = ((logs[low] - log) / (logs[low] - logs[low + 1])).clamp(0.0, 1.0);
    (low as f64 + share).round_ties_even() as usize
}

impl DpmPath {
    /// `steps` moves over evenly spaced timesteps, from the last timestep to timestep 0.
    ///
    /// # Panics
    /// If `steps` is not in `1..schedule.steps()`.
    pub fn even(schedule: &Schedule, steps: usize) -> Self {
        let last = schedule.steps() - 1;
        assert!((1..=last).contains(&steps), "the solver takes 1 to {last} steps, not {steps}");
        let at = |i: usize| (last as f64 * i as f64 / steps as f64).round_ties_even() as usize;
        let level = |i: usize| {
            let t = at(i);
            Level { t, alpha: schedule.alpha(t), sigma: schedule.sigma(t) }
        };
        Self { levels: (0..=steps).rev().map(level).collect() }
    }

    /// `steps` levels between the extreme levels of the schedule, spaced as in Karras et al., then the end that `last`
    /// selects.
    ///
    /// # Panics
    /// If `steps` is not in `1..=schedule.steps()`.
    pub fn karras(schedule: &Schedule, steps: usize, last: Last) -> Self {
        let all = schedule.steps();
        assert!((1..=all).contains(&steps), "the solver takes 1 to {all} steps, not {steps}");
        let logs: Vec<f64> = (0..all).map(|t| ratio(schedule, t).ln()).collect();
        let high = logs[all - 1].exp().powf(1.0 / RHO);
        let low = logs[0].exp().powf(1.0 / RHO);
        let level = |i: usize| {
            let share = i as f64 / (steps - 1).max(1) as f64;
            let ratio = (high + share * (low - high)).powf(RHO);
            Level::of_ratio(nearest(&logs, ratio.ln()), ratio)
        };
        let mut levels: Vec<Level> = (0..steps).map(level).collect();
        let end = match last {
            Last::Zero => Level { t: 0, alpha: 1.0, sigma: 0.0 },
            Last::Repeated => levels[steps - 1],
        };
        levels.push(end);
        Self { levels }
    }

    /// Number of moves, one less than the number of levels.
    pub fn steps(&self) -> usize {
        self.levels.len() - 1
    }

    /// The timesteps of the network's calls, noisiest first.
    pub fn timesteps(&self) -> Vec<usize> {
        self.levels[..self.steps()].iter().map(|level| level.t).collect()
    }

    /// `sigma / alpha` of all levels.
    pub fn ratios(&self) -> Vec<f64> {
        self.levels.iter().map(|level| level.sigma / level.alpha).collect()
    }

    /// The factors of move `j`.
    fn step(&self, form: Form, j: usize) -> Move {
        let from = self.levels[j];
        let to = self.levels[j + 1];
        if to.sigma == 0.0 {
            // The limit of all three forms at level 0; their own formulas divide by the level.
            let noise = if form == Form::Noise { -from.sigma / from.alpha } else { 0.0 };
            let (keep, take) = if form == Form::Noise { (1.0 / from.alpha, noise) } else { (0.0, 1.0) };
            return Move { keep, take, lean: 0.0, fresh: 0.0 };
        }
        let h = to.lambda() - from.lambda();
        let (keep, take, fresh) = match form {
            Form::Noise => (to.alpha / from.alpha, -to.sigma * h.exp_m1(), 0.0),
            Form::Data => (to.sigma / from.sigma, -to.alpha * (-h).exp_m1(), 0.0),
            Form::StochasticData => {
                let grown = -(-2.0 * h).exp_m1();
                (to.sigma / from.sigma * (-h).exp(), to.alpha * grown, to.sigma * grown.max(0.0).sqrt())
            }
        };
        let first = j == 0 || (j + 1 == self.steps() && self.steps() < MANY);
        let lean = if first { 0.0 } else { 0.5 * take * h / (from.lambda() - self.levels[j - 1].lambda()) };
        Move { keep, take, lean, fresh }
    }
}

/// Factors of `z_s = keep z_t + take p + lean (p - p_before) + fresh noise`, with p the quantity that the form
/// integrates.
struct Move {
    keep: f64,
    take: f64,
    lean: f64,
    fresh: f64,
}

/// Moves `z` [B, T, F] from pure noise along `path`. `out(z, t)` is the network's output, already guided.
/// `step_noise(j)` returns noise of the same shape for every move j of the stochastic form that adds noise.
pub fn dpm_sample(
    schedule: &Schedule,
    path: &DpmPath,
    form: Form,
    mut z: Tensor<3>,
    mut step_noise: impl FnMut(usize) -> Tensor<3>,
    mut out: impl FnMut(Tensor<3>, usize) -> Tensor<3>,
) -> Tensor<3> {
    let mut before: Option<Tensor<3>> = None;
    for j in 0..path.steps() {
        let level = path.levels[j];
        let predicted = out(z.clone(), level.t);
        let (clean, noise) = schedule.readings_at((level.alpha, level.sigma));
        let p = affine_one(z.clone(), predicted, if form == Form::Noise { noise } else { clean });
        let Move { keep, take, lean, fresh } = path.step(form, j);
        z = affine_one(z, p.clone(), (keep, take));
        if let Some(before) = before.filter(|_| lean != 0.0) {
            z = z + (p.clone() - before) * (lean as f32);
        }
        if fresh > 0.0 {
            z = z + step_noise(j) * (fresh as f32);
        }
        before = Some(p);
    }
    z
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use protocol::stage::{Diffusion, NoiseSchedule, Prediction};

    use super::*;

    fn linear() -> Schedule {
        let settings = Diffusion {
            schedule: NoiseSchedule::Linear,
            beta_first: 1e-4,
            beta_last: 0.02,
            prediction: Prediction::Sample,
        };
        Schedule::new(&settings, 1000)
    }

    #[test]
    fn karras_levels_have_the_published_timesteps() {
        let times = |steps| DpmPath::karras(&linear(), steps, Last::Zero).timesteps();
        assert_eq!(times(10), [999, 937, 864, 775, 663, 511, 301, 102, 18, 0]);
        assert_eq!(times(4), [999, 775, 301, 0]);
        assert_eq!(times(16), [999, 963, 923, 880, 831, 775, 711, 636, 545, 434, 301, 170, 77, 28, 7, 0]);
        assert_eq!(times(1), [999]);
        let ratios = DpmPath::karras(&linear(), 10, Last::Repeated).ratios();
        assert!((ratios[0] - 157.4).abs() < 0.1 && (ratios[9] - 0.0100).abs() < 1e-4 && ratios[9] == ratios[10]);
    }

    /// The exact network for one known sample: every form must reach the sample for any number of steps.
    #[test]
    fn a_network_that_knows_the_sample_is_followed_to_it() {
        let schedule = Schedule::published();
        let device = Device::flex();
        let clean = Tensor::<3>::from_floats([[[0.7, -1.2, 0.1]]], &device);
        let noise = Tensor::<3>::from_floats([[[-0.4, 0.9, 1.5]]], &device);
        let start = affine_one(clean.clone(), noise, schedule.add_noise(999));
        let out = |z: Tensor<3>, t: usize| {
            let (alpha, sigma) = schedule.add_noise(t);
            (z - clean.clone() * (alpha as f32)) / (sigma as f32)
        };
        for form in [Form::Noise, Form::Data] {
            for steps in [1, 2, 5, 20] {
                let path = DpmPath::even(&schedule, steps);
                let found = dpm_sample(&schedule, &path, form, start.clone(), |_| unreachable!("no noise"), out);
                let off = (found - clean.clone()).abs().max().into_scalar::<f32>();
                assert!(off < 0.05, "{form:?}, {steps} steps: off by {off}");
            }
        }
    }
}
