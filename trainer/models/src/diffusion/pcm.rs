//! Phased consistency: the grid cut into M phases, and the sampler that makes one deterministic jump per phase.
//!
//! Source: MotionPCM, arXiv:2501.19083. The edges follow the phased consistency model for images (arXiv:2405.18407):
//! edge j is grid index `floor(j S / M)`. Departs from the image recipe: adversarial noise levels end at the true next
//! edge, since 10 grid points give phases of unequal length.
//!
//! M is the number of sampling steps. Training and sampling use the same edges, so a network trained for one M cannot
//! be sampled with another.

use burn::tensor::Tensor;

use super::{Grid, Schedule, TIMESTEPS, affine_one};

/// The edges `s_0 < s_1 < ... < s_{M-1}` between the phases. Phase m holds the grid indices from its edge on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Phases {
    /// Grid index of each edge; the first is 0.
    pub edges: Vec<usize>,
    grid: Grid,
}

impl Phases {
    /// Cuts `grid` into `phases` phases.
    ///
    /// # Panics
    /// If there are no phases, or more than grid points. A caller that takes the number from a user checks it first.
    pub fn new(grid: &Grid, phases: usize) -> Self {
        assert!((1..=grid.steps).contains(&phases), "1 to {} phases fit the grid, not {phases}", grid.steps);
        Self { edges: (0..phases).map(|j| j * grid.steps / phases).collect(), grid: *grid }
    }

    /// The phase of grid index i. A timestep equal to an edge belongs to the phase below the edge, which holds index i.
    pub fn phase_of(&self, i: usize) -> usize {
        self.edges.partition_point(|edge| *edge <= i) - 1
    }

    /// Returns true if one solver step from grid index i ends on the edge of its phase. The target is then that point
    /// itself.
    pub fn is_edge(&self, i: usize) -> bool {
        self.edges.contains(&i)
    }

    /// `s_m`, the timestep at which phase m ends: 0 for the first.
    pub fn edge_time(&self, m: usize) -> usize {
        self.grid.prev(self.edges[m])
    }

    /// Upper bound of phase m's adversarial noise levels: `s_{m+1}`, and 1000 for the last phase.
    pub fn next_edge_time(&self, m: usize) -> usize {
        if m + 1 < self.edges.len() { self.edge_time(m + 1) } else { TIMESTEPS }
    }

    /// The sampler's jumps (from, to): 999 -> s_{M-1} -> ... -> s_0 = 0.
    pub fn path(&self) -> Vec<(usize, usize)> {
        let last = self.grid.tau(self.grid.steps - 1);
        (0..self.edges.len()).rev().map(|m| (self.next_edge_time(m).min(last), self.edge_time(m))).collect()
    }
}

/// Moves `z` [B, N, d] through all phases with one call of `out`, the network's output, each; adds no noise.
pub fn pcm_sample(
    schedule: &Schedule,
    phases: &Phases,
    mut z: Tensor<3>,
    mut out: impl FnMut(Tensor<3>, usize) -> Tensor<3>,
) -> Tensor<3> {
    for (t, s) in phases.path() {
        let predicted = out(z.clone(), t);
        z = affine_one(z, predicted, schedule.jump(t, s));
    }
    z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_are_the_published_ones() {
        for (skip, m, edges, path) in [
            (100, 1, vec![0], vec![(999, 0)]),
            (100, 2, vec![0, 5], vec![(999, 499), (499, 0)]),
            (100, 4, vec![0, 2, 5, 7], vec![(999, 699), (699, 499), (499, 199), (199, 0)]),
            (20, 4, vec![0, 12, 25, 37], vec![(999, 739), (739, 499), (499, 239), (239, 0)]),
        ] {
            let phases = Phases::new(&Grid::new(skip), m);
            assert_eq!(phases.edges, edges);
            assert_eq!(phases.path(), path);
        }
    }

    #[test]
    fn phases_do_not_matter_if_the_prediction_is_constant() {
        use burn::tensor::{Device, TensorData};
        let schedule = Schedule::published();
        let device = Device::flex();
        let make = |seed: f32| {
            let values: Vec<f32> = (0..24_u8).map(|i| (f32::from(i) * seed).sin()).collect();
            Tensor::<3>::from_data(TensorData::new(values, [2, 3, 4]), &device)
        };
        let z = make(0.7);
        let noise = make(1.3);
        let expected = affine_one(z.clone(), noise.clone(), schedule.jump(999, 0)).into_data();
        for m in [1, 2, 4, 10] {
            let phases = Phases::new(&Grid::new(100), m);
            let mut calls = Vec::new();
            let found = pcm_sample(&schedule, &phases, z.clone(), |_, t| {
                calls.push(t);
                noise.clone()
            });
            assert_eq!((calls.len(), calls[0]), (m, 999));
            let off = found.into_data();
            for (f, e) in off.as_slice::<f32>().unwrap().iter().zip(expected.as_slice::<f32>().unwrap()) {
                assert!((f - e).abs() < 1e-4, "{m} phases: {f} instead of {e}");
            }
        }
    }

    #[test]
    fn an_edge_timestep_belongs_to_the_phase_below() {
        let phases = Phases::new(&Grid::new(100), 2);
        // tau_4 = 499 = s_1, but index 4 is in phase 0.
        assert_eq!((phases.phase_of(4), phases.phase_of(5), phases.phase_of(9)), (0, 1, 1));
        assert!(phases.is_edge(0) && phases.is_edge(5) && !phases.is_edge(4));
        assert_eq!((phases.next_edge_time(0), phases.next_edge_time(1)), (499, 1000));
    }
}
