//! Noise schedules, and the interpretation of a network's output along them.
//!
//! A noised sample at timestep t is `z_t = alpha_t z_0 + sigma_t eps`. Schedules differ in the two factors; predictions
//! differ in the quantity that the network returns. Both reduce to plain coefficients, so that samplers and losses
//! depend on neither. In this module `out` is the network's output, guided or not: every interpretation is affine in
//! it.
//!
//! Sources: Rombach et al., arXiv:2112.10752 (`scaled_linear`, as in MLD and MotionLCM); Ho et al., arXiv:2006.11239
//! (`linear`); Nichol and Dhariwal, arXiv:2102.09672 (`cosine`); Salimans and Ho, arXiv:2202.00512 (velocity); Liu et
//! al., arXiv:2209.03003 (`flow`). The published weights for the first two were trained with f32 tables, whose rounding
//! is visible in `1 - ab_t` near t = 0. So those tables are rounded to f32 and then widened. The cosine table is f64,
//! as its authors have it.

use burn::tensor::Tensor;
use protocol::stage::{Diffusion, NoiseSchedule, Prediction};

pub use super::timesteps::TIMESTEPS;
use super::timesteps::{ddim_previous, ddim_timesteps};
use super::{affine, unzip};

/// A noise schedule, and the quantity that the network predicts along it.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// `beta_t`; empty for a flow.
    betas: Vec<f64>,
    /// `ab_t`; empty for a flow.
    alpha_bar: Vec<f64>,
    /// Pairs (alpha_t, sigma_t) by timestep.
    factors: Vec<(f64, f64)>,
    prediction: Prediction,
}

/// Factors (alpha, sigma) of a rectified flow, a straight line, at the share `s` of noise.
pub fn flow(s: f64) -> (f64, f64) {
    (1.0 - s, s)
}

/// Returns `steps` equidistant numbers in f32, computed from the nearer end as in PyTorch.
fn line(first: f32, last: f32, steps: usize) -> impl Iterator<Item = f32> {
    let step = (last - first) / (steps - 1).max(1) as f32;
    (0..steps).map(move |t| {
        if t < steps / 2 { step.mul_add(t as f32, first) } else { (-step).mul_add((steps - 1 - t) as f32, last) }
    })
}

fn betas(settings: &Diffusion, steps: usize) -> Vec<f64> {
    let first = settings.beta_first;
    let last = settings.beta_last;
    match settings.schedule {
        NoiseSchedule::ScaledLinear => {
            line(first.sqrt() as f32, last.sqrt() as f32, steps).map(|root| f64::from(root * root)).collect()
        }
        NoiseSchedule::Linear => line(first as f32, last as f32, steps).map(f64::from).collect(),
        NoiseSchedule::Cosine => {
            let bar = |share: f64| ((share + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2);
            let at = |t: usize| bar(t as f64 / steps as f64);
            (0..steps).map(|t| (1.0 - at(t + 1) / at(t)).min(0.999)).collect()
        }
        NoiseSchedule::Flow => Vec::new(),
    }
}

impl Default for Schedule {
    fn default() -> Self {
        Self::published()
    }
}

impl Schedule {
    /// The schedule of MLD, MotionLCM and MotionPCM: `scaled_linear` .00085 -> .012, noise predicted. The terminal
    /// signal is not zero: `ab_999` = .00466.
    pub fn published() -> Self {
        Self::new(&Diffusion::default(), TIMESTEPS)
    }

    /// Creates a schedule over timesteps `0..steps`.
    pub fn new(settings: &Diffusion, steps: usize) -> Self {
        let betas = betas(settings, steps);
        let rounded = settings.schedule != NoiseSchedule::Cosine;
        let mut product = 1.0_f64;
        let bar = |beta: &f64| {
            if rounded {
                product *= f64::from(1.0 - *beta as f32);
                f64::from(product as f32)
            } else {
                product *= 1.0 - beta;
                product
            }
        };
        let alpha_bar: Vec<f64> = betas.iter().map(bar).collect();
        let factors = if settings.schedule == NoiseSchedule::Flow {
            (0..steps).map(|t| flow(t as f64 / (steps - 1).max(1) as f64)).collect()
        } else {
            alpha_bar.iter().map(|bar| (bar.sqrt(), (1.0 - bar).sqrt())).collect()
        };
        Self { betas, alpha_bar, factors, prediction: settings.prediction }
    }

    /// Number of timesteps.
    pub fn steps(&self) -> usize {
        self.factors.len()
    }

    fn is_flow(&self) -> bool {
        self.alpha_bar.is_empty()
    }

    /// `beta_t`, the share of the variance that becomes noise at t.
    ///
    /// # Panics
    /// If `t` is not a timestep, like all functions of a timestep. Also for a flow, which has no `beta_t`.
    pub fn beta(&self, t: usize) -> f64 {
        self.betas[t]
    }

    /// `ab_t`, the signal's share of the variance.
    pub fn alpha_bar(&self, t: usize) -> f64 {
        let (alpha, sigma) = self.factors[t];
        self.alpha_bar.get(t).copied().unwrap_or_else(|| alpha * alpha / (alpha * alpha + sigma * sigma))
    }

    /// `alpha_t`, the factor of the signal.
    pub fn alpha(&self, t: usize) -> f64 {
        self.factors[t].0
    }

    /// `sigma_t`, the factor of the noise.
    pub fn sigma(&self, t: usize) -> f64 {
        self.factors[t].1
    }

    /// Factors (alpha_t, sigma_t) of `z_t = A z_0 + E noise`.
    pub fn add_noise(&self, t: usize) -> (f64, f64) {
        self.factors[t]
    }

    /// The network's target for samples `clean` and their `noise` at `timesteps`: the noise, the sample, or the
    /// velocity. The velocity of a flow is `noise - clean`, its slope towards noise; otherwise it is
    /// `alpha noise - sigma clean`.
    pub fn target(&self, clean: Tensor<3>, noise: Tensor<3>, timesteps: &[usize]) -> Tensor<3> {
        match self.prediction {
            Prediction::Noise => noise,
            Prediction::Sample => clean,
            Prediction::Velocity if self.is_flow() => noise - clean,
            Prediction::Velocity => {
                let (a, e) = unzip(timesteps.iter().map(|t| (-self.sigma(*t), self.alpha(*t))));
                affine(clean, noise, &a, &e)
            }
        }
    }

    /// Factors of `z_0 = A z_t + E out`, the clean sample that an output implies.
    pub fn clean(&self, t: usize) -> (f64, f64) {
        self.readings_at(self.factors[t]).0
    }

    /// Factors of `eps = A z_t + E out`, the noise that an output implies.
    pub fn noise(&self, t: usize) -> (f64, f64) {
        self.readings_at(self.factors[t]).1
    }

    /// Factors of the implied clean sample and noise at a level (alpha, sigma), which may lie between timesteps.
    pub fn readings_at(&self, (alpha, sigma): (f64, f64)) -> ((f64, f64), (f64, f64)) {
        match self.prediction {
            Prediction::Noise => ((1.0 / alpha, -sigma / alpha), (0.0, 1.0)),
            Prediction::Sample => ((0.0, 1.0), (1.0 / sigma, -alpha / sigma)),
            Prediction::Velocity if self.is_flow() => ((1.0, -sigma), (1.0, alpha)),
            Prediction::Velocity => ((alpha, -sigma), (sigma, alpha)),
        }
    }

    /// Factors of `z_s = A z_t + E out`, the deterministic move from `t` to `s`: the implied clean sample, with its
    /// noise at level s. For a flow it is an Euler step. `jump(t, t)` is exactly the identity.
    ///
    /// Source: Song, Meng, Ermon, arXiv:2010.02502, eq. 12 with eta = 0.
    pub fn jump(&self, t: usize, s: usize) -> (f64, f64) {
        if t == s {
            return (1.0, 0.0);
        }
        let (alpha, sigma) = self.factors[s];
        if self.prediction == Prediction::Noise {
            let a = alpha / self.alpha(t);
            return (a, sigma - a * self.sigma(t));
        }
        let clean = self.clean(t);
        let noise = self.noise(t);
        (alpha * clean.0 + sigma * noise.0, alpha * clean.1 + sigma * noise.1)
    }

    /// Factors of `z_s = A z_m + E noise`, the noising from level `m` to a noisier level `s >= m`.
    pub fn transition(&self, m: usize, s: usize) -> (f64, f64) {
        if self.is_flow() {
            let a = self.alpha(s) / self.alpha(m);
            return (a, (self.sigma(s).powi(2) - (a * self.sigma(m)).powi(2)).max(0.0).sqrt());
        }
        let ratio = self.alpha_bar(s) / self.alpha_bar(m);
        (ratio.sqrt(), (1.0 - ratio).max(0.0).sqrt())
    }

    /// The moves (from, to) of a sampler with `steps` steps, noisiest first. A diffusion is spaced as in MLD (see
    /// [`super::ddim`]). A flow starts at pure noise and ends at the sample, in steps of equal length.
    ///
    /// # Panics
    /// If `steps` is not in `1..self.steps()`.
    pub fn path(&self, steps: usize) -> Vec<(usize, usize)> {
        if self.is_flow() {
            let last = self.steps() - 1;
            assert!((1..=last).contains(&steps), "a flow's sampler takes 1 to {last} steps, not {steps}");
            let at = |j: usize| (last * (steps - j) + steps / 2) / steps;
            return (0..steps).map(|j| (at(j), at(j + 1))).collect();
        }
        ddim_timesteps(steps).into_iter().map(|t| (t, ddim_previous(steps, t))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: (f64, f64), expected: (f64, f64)) {
        let off = (found.0 - expected.0).abs().max((found.1 - expected.1).abs());
        assert!(off < 2e-5, "found {found:?}, expected {expected:?}");
    }

    #[test]
    fn table_has_the_published_values() {
        let s = Schedule::published();
        for (t, bar) in [
            (0, 0.999_149_98),
            (1, 0.998_296_03),
            (99, 0.895_462_44),
            (199, 0.755_238_08),
            (299, 0.592_182_84),
            (399, 0.426_086_08),
            (499, 0.277_669_41),
            (599, 0.161_752_37),
            (699, 0.083_128_25),
            (799, 0.037_194_96),
            (899, 0.014_298_66),
            (999, 0.004_660_09),
        ] {
            let off = s.alpha_bar(t) - bar;
            assert!(off.abs() < 5e-8, "t {t}: off by {off:e}");
        }
    }

    #[test]
    fn jumps_have_the_published_factors() {
        let s = Schedule::published();
        near(s.jump(999, 0), (14.642_594, -14.579_281));
        near(s.jump(999, 499), (7.719_100, -6.851_193));
        near(s.jump(499, 0), (1.896_930, -1.583_046));
        near(s.jump(999, 699), (4.223_544, -3.256_157));
        near(s.jump(699, 499), (1.827_636, -0.900_124));
        near(s.jump(499, 199), (1.649_217, -0.906_936));
        near(s.jump(199, 0), (1.150_200, -0.539_888));
        near(s.transition(0, 499), (0.527_168, 0.849_761));
        near(s.transition(499, 999), (0.129_549, 0.991_573));
    }

    #[test]
    fn jumps_compose_and_the_empty_one_is_the_identity() {
        let s = Schedule::published();
        for (t, m, end) in [(999, 499, 0), (812, 300, 17), (20, 19, 1)] {
            let (a1, e1) = s.jump(t, m);
            let (a2, e2) = s.jump(m, end);
            let (a, e) = s.jump(t, end);
            assert!((a2 * a1 - a).abs() < 1e-12 && (a2 * e1 + e2 - e).abs() < 1e-12);
            assert_eq!(s.jump(t, t), (1.0, 0.0));
        }
    }

    /// Every schedule with every prediction that it supports.
    fn all(steps: usize) -> Vec<(Diffusion, Schedule)> {
        let mut all = Vec::new();
        for schedule in [NoiseSchedule::ScaledLinear, NoiseSchedule::Linear, NoiseSchedule::Cosine, NoiseSchedule::Flow]
        {
            for prediction in [Prediction::Noise, Prediction::Sample, Prediction::Velocity] {
                let settings = Diffusion { schedule, prediction, ..Diffusion::default() };
                if !(schedule == NoiseSchedule::Flow && prediction == Prediction::Noise) {
                    all.push((settings.clone(), Schedule::new(&settings, steps)));
                }
            }
        }
        all
    }

    /// A numeric example: the true output implies the true sample and noise, at every timestep.
    #[test]
    fn the_true_output_gives_back_sample_noise_and_every_level() {
        let device = burn::tensor::Device::flex();
        let tensor = |value: f64| Tensor::<3>::full([1, 1, 1], value as f32, &device);
        for (settings, schedule) in all(50) {
            let clean = 0.75_f64;
            let noise = -1.25_f64;
            for t in 0..50 {
                let (a, e) = schedule.add_noise(t);
                let z = a * clean + e * noise;
                let out = schedule.target(tensor(clean), tensor(noise), &[t]).into_scalar::<f32>();
                let read = |(a, e): (f64, f64)| a * z + e * f64::from(out);
                let close = |found: f64, expected: f64, what: &str| {
                    // Coefficients are large near one end.
                    let bound = 1e-5 * (1.0 + schedule.clean(t).0.abs() + schedule.noise(t).0.abs());
                    assert!((found - expected).abs() < bound, "{settings:?}, t {t}, {what}: {found}, not {expected}");
                };
                close(read(schedule.clean(t)), clean, "sample");
                if schedule.sigma(t) > 0.0 {
                    close(read(schedule.noise(t)), noise, "noise");
                    for s in [0, 10, 49] {
                        let (a, e) = schedule.add_noise(s);
                        close(read(schedule.jump(t, s)), a * clean + e * noise, "jump");
                    }
                }
            }
        }
    }

    #[test]
    fn noising_in_two_moves_has_the_variance_of_one() {
        for (settings, schedule) in all(100) {
            let first = schedule.add_noise(20);
            let second = schedule.transition(20, 70);
            let whole = schedule.add_noise(70);
            let variance = (second.0 * first.1).powi(2) + second.1.powi(2);
            assert!((second.0 * first.0 - whole.0).abs() < 1e-6, "{settings:?}");
            assert!((variance.sqrt() - whole.1).abs() < 1e-6, "{settings:?}");
        }
    }

    #[test]
    fn a_flow_goes_from_pure_noise_to_the_sample() {
        let settings =
            Diffusion { schedule: NoiseSchedule::Flow, prediction: Prediction::Velocity, ..Diffusion::default() };
        let schedule = Schedule::new(&settings, TIMESTEPS);
        assert_eq!((schedule.add_noise(0), schedule.add_noise(999)), ((1.0, 0.0), (0.0, 1.0)));
        assert_eq!(schedule.path(1), [(999, 0)]);
        assert_eq!(schedule.path(4), [(999, 749), (749, 500), (500, 250), (250, 0)]);
        assert_eq!(schedule.path(999).len(), 999);
        // A jump along a flow is an Euler step.
        near(schedule.jump(750, 250), (1.0, (250.0 - 750.0) / 999.0));
        assert_eq!(Schedule::published().path(50)[..2], [(981, 961), (961, 941)]);
    }
}
