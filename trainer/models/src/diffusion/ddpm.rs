//! Ancestral sampling: every move draws from the posterior of a cleaner level, given the sample and its clean estimate.
//!
//! Source: Ho et al., arXiv:2006.11239, eq. 6 and 7, with MDM's posterior variance ("fixed small"). Moves over several
//! timesteps follow Nichol and Dhariwal, arXiv:2102.09672. The last move returns the clean estimate without noise.
//! Nothing is clipped.

use burn::tensor::Tensor;

use super::{Schedule, affine_one};

/// Selects `steps` of the schedule's timesteps, noisiest first, evenly spaced from the last one to 0.
///
/// # Panics
/// If `steps` is not in `1..=schedule.steps()`.
pub fn ddpm_timesteps(schedule: &Schedule, steps: usize) -> Vec<usize> {
    let all = schedule.steps();
    assert!((1..=all).contains(&steps), "ancestral sampling takes 1 to {all} steps, not {steps}");
    if steps == 1 {
        return vec![all - 1];
    }
    let stride = (all - 1) as f64 / (steps - 1) as f64;
    (0..steps).rev().map(|i| (stride * i as f64).round_ties_even() as usize).collect()
}

/// The factors (A, C, D) of `z_s = A z_t + C z_0 + D noise` for s before t.
pub fn posterior(schedule: &Schedule, t: usize, s: usize) -> (f64, f64, f64) {
    let bar_t = schedule.alpha_bar(t);
    let bar_s = schedule.alpha_bar(s);
    let ratio = bar_t / bar_s;
    let a = ratio.sqrt() * (1.0 - bar_s);
    let c = bar_s.sqrt() * (1.0 - ratio);
    let variance = (1.0 - ratio) * (1.0 - bar_s) / (1.0 - bar_t);
    (a / (1.0 - bar_t), c / (1.0 - bar_t), variance.sqrt())
}

/// Moves `z` [B, T, F] from pure noise to a clean sample along `timesteps`. `out(z, t)` is the network's output,
/// already guided. `step_noise(j)` returns noise of the same shape for every move j but the last.
pub fn ddpm_sample(
    schedule: &Schedule,
    timesteps: &[usize],
    mut z: Tensor<3>,
    mut step_noise: impl FnMut(usize) -> Tensor<3>,
    mut out: impl FnMut(Tensor<3>, usize) -> Tensor<3>,
) -> Tensor<3> {
    for (j, &t) in timesteps.iter().enumerate() {
        let predicted = out(z.clone(), t);
        let clean = affine_one(z.clone(), predicted, schedule.clean(t));
        z = match timesteps.get(j + 1) {
            Some(s) => {
                let (a, c, d) = posterior(schedule, t, *s);
                affine_one(z, clean, (a, c)) + step_noise(j) * (d as f32)
            }
            None => clean,
        };
    }
    z
}

#[cfg(test)]
mod tests {
    use protocol::stage::{Diffusion, NoiseSchedule, Prediction};

    use super::*;

    fn cosine(steps: usize) -> Schedule {
        let settings =
            Diffusion { schedule: NoiseSchedule::Cosine, prediction: Prediction::Sample, ..Diffusion::default() };
        Schedule::new(&settings, steps)
    }

    #[test]
    fn a_posterior_has_the_published_factors() {
        let schedule = cosine(50);
        for t in 1..50 {
            let (a, c, d) = posterior(&schedule, t, t - 1);
            let beta = schedule.beta(t);
            let bar = schedule.alpha_bar(t);
            let before = schedule.alpha_bar(t - 1);
            assert!((a - (1.0 - before) * (1.0 - beta).sqrt() / (1.0 - bar)).abs() < 1e-9, "t {t}");
            assert!((c - beta * before.sqrt() / (1.0 - bar)).abs() < 1e-9, "t {t}");
            assert!((d * d - beta * (1.0 - before) / (1.0 - bar)).abs() < 1e-9, "t {t}");
        }
    }

    #[test]
    fn a_posterior_of_true_samples_has_the_moments_of_its_level() {
        // Given z_t = alpha_t z_0 + sigma_t eps, z_s has mean alpha_s z_0 and variance sigma_s^2.
        for (schedule, t, s) in [(cosine(50), 40, 3), (cosine(1000), 999, 500), (Schedule::published(), 700, 20)] {
            let (a, c, d) = posterior(&schedule, t, s);
            assert!((a * schedule.alpha(t) + c - schedule.alpha(s)).abs() < 1e-9);
            let variance = (a * schedule.sigma(t)).powi(2) + d * d;
            assert!((variance - schedule.sigma(s).powi(2)).abs() < 1e-9);
        }
    }

    #[test]
    fn timesteps_are_all_or_evenly_spaced() {
        assert_eq!(ddpm_timesteps(&cosine(50), 50), (0..50).rev().collect::<Vec<_>>());
        assert_eq!(ddpm_timesteps(&cosine(1000), 5), [999, 749, 500, 250, 0]);
        assert_eq!(ddpm_timesteps(&cosine(50), 1), [49]);
    }
}
