//! DDIM with classifier-free guidance: the teacher's sampler.
//!
//! Source: Song, Meng, Ermon, arXiv:2010.02502, eq. 12 with eta = 0. Timesteps have "leading" spacing with offset 1
//! (981, 961, ..., 1 for 50 steps), and the last move lands on `ab_0`, not on 1, as MLD has it.

use burn::tensor::Tensor;

use super::{Schedule, TIMESTEPS, affine_one};

/// Timesteps of the sampler, noisiest first.
///
/// # Panics
/// If `steps` is not in 1..=999.
pub fn ddim_timesteps(steps: usize) -> Vec<usize> {
    assert!((1..TIMESTEPS).contains(&steps), "DDIM takes 1 to 999 steps, not {steps}");
    let stride = TIMESTEPS / steps;
    (0..steps).rev().map(|i| i * stride + 1).collect()
}

/// Where the step at `t` lands: `t - 1000 / steps`, or 0 below that.
pub fn ddim_previous(steps: usize, t: usize) -> usize {
    t.saturating_sub(TIMESTEPS / steps)
}

/// Moves `z` [B, N, d] from pure noise to a clean latent in `steps` calls of `out`. Along a flow these are Euler's steps.
///
/// `out(z, t)` is the network's output, already guided.
pub fn ddim_sample(
    schedule: &Schedule,
    steps: usize,
    mut z: Tensor<3>,
    mut out: impl FnMut(Tensor<3>, usize) -> Tensor<3>,
) -> Tensor<3> {
    for (t, s) in schedule.path(steps) {
        let predicted = out(z.clone(), t);
        z = affine_one(z, predicted, schedule.jump(t, s));
    }
    z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timesteps_lead_with_offset_one() {
        assert_eq!(ddim_timesteps(1), [1]);
        assert_eq!(ddim_timesteps(5), [801, 601, 401, 201, 1]);
        assert_eq!(ddim_timesteps(50)[..3], [981, 961, 941]);
        assert_eq!(ddim_previous(50, 21), 1);
        assert_eq!(ddim_previous(50, 1), 0);
        assert_eq!(ddim_timesteps(999)[0], 999);
    }
}
