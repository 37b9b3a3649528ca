//! DDIM, the teacher's sampler: the loop over [`Schedule::jump`], which is the update. Predictions arrive guided.
//!
//! Source: Song, Meng, Ermon, arXiv:2010.02502, eq. 12 with eta = 0. Timesteps have "leading" spacing with offset 1
//! (981, 961, ..., 1 for 50 steps). As in MLD, the last move ends at `ab_0` and not at 1.

use burn::tensor::Tensor;

pub use super::timesteps::{ddim_previous, ddim_timesteps};
use super::{Schedule, affine_one};

/// Moves `z` [B, N, d] from pure noise to a clean latent in `steps` calls of `out`. For a flow these are Euler steps.
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

/// Timesteps with "leading" spacing and no offset, noisiest first: 900, 800, ..., 0 for 10 of 1000 (StableMoFusion).
///
/// # Panics
/// If `steps` is not in `1..=schedule.steps()`.
pub fn leading_timesteps(schedule: &Schedule, steps: usize) -> Vec<usize> {
    let all = schedule.steps();
    assert!((1..=all).contains(&steps), "DDIM takes 1 to {all} steps, not {steps}");
    (0..steps).rev().map(|i| i * (all / steps)).collect()
}

/// Samples along `timesteps` like [`ddim_sample`]; the last move ends at the sample itself, without noise of timestep
/// 0.
pub fn ddim_sample_to_data(
    schedule: &Schedule,
    timesteps: &[usize],
    mut z: Tensor<3>,
    mut out: impl FnMut(Tensor<3>, usize) -> Tensor<3>,
) -> Tensor<3> {
    for (j, &t) in timesteps.iter().enumerate() {
        let predicted = out(z.clone(), t);
        let coefficients = timesteps.get(j + 1).map_or_else(|| schedule.clean(t), |s| schedule.jump(t, *s));
        z = affine_one(z, predicted, coefficients);
    }
    z
}
