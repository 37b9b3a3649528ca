//! Latent consistency: the solver's grid, the boundary condition, and the multi-step sampler.
//!
//! Source: Luo et al., arXiv:2310.04378; MotionLCM, arXiv:2404.19759. The grid is `tau_i = (i + 1) k - 1`; tables of the
//! grid are indexed by i, those of the schedule by timestep.

use burn::tensor::Tensor;

use super::{Schedule, TIMESTEPS, affine_one};

/// Standard deviation of the data in the boundary condition.
const SIGMA_DATA: f64 = 0.5;
/// Factor on timesteps in the boundary condition.
const TIMESTEP_SCALING: f64 = 10.0;

/// The teacher's solver grid: `steps = 1000 / skip` timesteps, `skip` apart; the last is 999.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// S, the number of grid points.
    pub steps: usize,
    /// k, the timesteps between neighbours.
    pub skip: usize,
}

impl Grid {
    /// Creates the grid with stride `skip`: 20 in MotionLCM v1, 100 in v2 and MotionPCM.
    ///
    /// # Panics
    /// If `skip` is not a divisor of 1000. A caller that takes it from a user checks it first.
    pub fn new(skip: usize) -> Self {
        assert!(skip > 0 && TIMESTEPS.is_multiple_of(skip), "the solver's skip must divide 1000, not {skip}");
        Self { steps: TIMESTEPS / skip, skip }
    }

    /// `tau_i`, the timestep of grid point i.
    pub fn tau(&self, i: usize) -> usize {
        (i + 1) * self.skip - 1
    }

    /// The timestep after one solver step from grid point i: `tau_{i-1}`, or 0 from i = 0.
    pub fn prev(&self, i: usize) -> usize {
        i * self.skip - usize::from(i > 0)
    }
}

/// (c_skip, c_out) at timestep `t`: (1, 0) at 0, within 3e-7 of (0, 1) from 99 on.
pub fn boundary(t: usize) -> (f64, f64) {
    let s = TIMESTEP_SCALING * t as f64;
    let square = SIGMA_DATA * SIGMA_DATA;
    (square / (s * s + square), s / (s * s + square).sqrt())
}

/// The consistency function as `A z + E out`: `c_skip z + c_out z_0(z, out)`.
pub fn consistency(schedule: &Schedule, t: usize) -> (f64, f64) {
    let (skip, out) = boundary(t);
    let (a, e) = schedule.clean(t);
    (skip + out * a, out * e)
}

/// Rule for the timesteps of the multi-step sampler.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LcmTimesteps {
    /// v1: grid points spread evenly from 999 downwards.
    Even(Grid),
    /// v2: the tuned map for 1, 2 and 4 steps, which starts below 999; other counts are spread evenly.
    Tuned(Grid),
}

/// Timesteps of the sampler, noisiest first. [`LcmTimesteps::Tuned`] visits 299 twice in four steps, as published.
///
/// # Panics
/// If `steps` is not in 1..=grid.steps.
pub fn lcm_timesteps(rule: LcmTimesteps, steps: usize) -> Vec<usize> {
    let (grid, tuned) = match rule {
        LcmTimesteps::Even(grid) => (grid, false),
        LcmTimesteps::Tuned(grid) => (grid, true),
    };
    assert!((1..=grid.steps).contains(&steps), "the sampler takes 1 to {} steps, not {steps}", grid.steps);
    match (tuned, steps) {
        (true, 1) => vec![799],
        (true, 2) => vec![699, 299],
        (true, 4) => vec![699, 399, 299, 299],
        _ => (0..steps).map(|j| grid.tau(grid.steps - 1 - j * grid.steps / steps)).collect(),
    }
}

/// Denoises `z` [B, N, d] in `timesteps.len()` calls of `out`, the network's output. Adds `step_noise[j]` after every
/// call but the last.
///
/// # Panics
/// If the number of noise tensors is not the number of steps minus one.
pub fn lcm_sample(
    schedule: &Schedule,
    timesteps: &[usize],
    mut z: Tensor<3>,
    step_noise: &[Tensor<3>],
    mut out: impl FnMut(Tensor<3>, usize) -> Tensor<3>,
) -> Tensor<3> {
    assert_eq!(step_noise.len() + 1, timesteps.len(), "one noise tensor for each step but the last");
    for (j, &t) in timesteps.iter().enumerate() {
        let predicted = out(z.clone(), t);
        z = affine_one(z, predicted, consistency(schedule, t));
        if let Some(fresh) = step_noise.get(j) {
            z = affine_one(z, fresh.clone(), schedule.add_noise(timesteps[j + 1]));
        }
    }
    z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_ends_at_999_and_its_first_point_steps_to_0() {
        let grid = Grid::new(100);
        assert_eq!((grid.steps, grid.tau(0), grid.tau(9)), (10, 99, 999));
        assert_eq!((grid.prev(0), grid.prev(1), grid.prev(9)), (0, 99, 899));
        assert_eq!(Grid::new(1).prev(1), 0);
    }

    #[test]
    fn boundary_has_the_published_values() {
        assert_eq!(boundary(0), (1.0, 0.0));
        for (t, skip) in [(19, 6.925e-6), (99, 2.551e-7), (999, 2.505e-9)] {
            assert!((boundary(t).0 / skip - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn timesteps_are_the_published_ones() {
        let v1 = LcmTimesteps::Even(Grid::new(20));
        let v2 = LcmTimesteps::Tuned(Grid::new(100));
        assert_eq!(lcm_timesteps(v1, 4), [999, 759, 499, 259]);
        assert_eq!(lcm_timesteps(v1, 3), [999, 679, 339]);
        assert_eq!(lcm_timesteps(v1, 8), [999, 879, 759, 639, 499, 379, 259, 139]);
        assert_eq!(lcm_timesteps(v2, 1), [799]);
        assert_eq!(lcm_timesteps(v2, 2), [699, 299]);
        assert_eq!(lcm_timesteps(v2, 4), [699, 399, 299, 299]);
        assert_eq!(lcm_timesteps(LcmTimesteps::Even(Grid::new(100)), 4), [999, 799, 499, 299]);
    }
}
