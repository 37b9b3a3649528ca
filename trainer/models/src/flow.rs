//! Rectified flow: straight lines from noise to data, and the two solvers that DisCoRD is sampled with. Source: Liu et al., arXiv:2209.03003;
//! DisCoRD (Cho et al., arXiv:2411.19527).
//!
//! Time runs from 0 (noise) to 1 (data): `x_t = t data + (1 - t) noise`, and the velocity to be learned is `data - noise`.

use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

/// Interpolates `t data + (1 - t) noise` with one time per clip; [B, T, F].
pub fn between(data_btf: Tensor<3>, noise_btf: Tensor<3>, times: &[f32]) -> Tensor<3> {
    let t = Tensor::<3>::from_data(TensorData::new(times.to_vec(), [times.len(), 1, 1]), &data_btf.device());
    let rest = t.clone().neg() + 1.0;
    data_btf * t + noise_btf * rest
}

/// Numerical solver of the flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Solver {
    /// One evaluation per interval.
    Euler,
    /// Two evaluations per interval: the second is at its middle, after half an Euler step.
    Midpoint,
}

impl Solver {
    /// Evaluations of the network for `intervals` intervals.
    pub fn evaluations(self, intervals: usize) -> usize {
        match self {
            Self::Euler => intervals,
            Self::Midpoint => 2 * intervals,
        }
    }

    /// Moves each sample of `x_btf` one step, from its time in `from` to its time in `to`.
    pub fn step(
        self,
        x_btf: Tensor<3>,
        from: &[f32],
        to: &[f32],
        mut velocity: impl FnMut(Tensor<3>, &[f32]) -> Tensor<3>,
    ) -> Tensor<3> {
        let device = x_btf.device();
        let scaled = |v: Tensor<3>, share: f32| {
            let steps: Vec<f32> = from.iter().zip(to).map(|(t, s)| share * (s - t)).collect();
            v * Tensor::<3>::from_data(TensorData::new(steps, [from.len(), 1, 1]), &device)
        };
        let first = velocity(x_btf.clone(), from);
        match self {
            Self::Euler => x_btf + scaled(first, 1.0),
            Self::Midpoint => {
                let half: Vec<f32> = from.iter().zip(to).map(|(t, s)| t + 0.5 * (s - t)).collect();
                let middle = x_btf.clone() + scaled(first, 0.5);
                x_btf + scaled(velocity(middle, &half), 1.0)
            }
        }
    }
}

/// The end at time 1 of a straight line from `x_btf`: `x + (1 - t) v`, with one time per clip.
pub fn to_data(x_btf: Tensor<3>, velocity_btf: Tensor<3>, times: &[f32]) -> Tensor<3> {
    let rest: Vec<f32> = times.iter().map(|t| 1.0 - t).collect();
    let rest = Tensor::<3>::from_data(TensorData::new(rest, [times.len(), 1, 1]), &x_btf.device());
    x_btf + velocity_btf * rest
}

/// Samples one clip with a network whose line leads to the data from any point of the flow. Each of `steps` equal
/// intervals jumps to the data and back to the start of the next interval with `fresh` noise. The last jump is the
/// result.
pub fn jump(
    steps: usize,
    noise_btf: Tensor<3>,
    velocity: impl Fn(Tensor<3>, f32) -> Tensor<3>,
    mut fresh: impl FnMut(usize) -> Tensor<3>,
) -> Tensor<3> {
    let at = |k: usize| k as f32 / steps as f32;
    let mut x = noise_btf;
    for k in 0..steps {
        let data = to_data(x.clone(), velocity(x, at(k)), &[at(k)]);
        x = if k + 1 < steps { between(data, fresh(k), &[at(k + 1)]) } else { data };
    }
    x
}

/// Follows `velocity` from `noise_btf` at time 0 to time 1 in equal intervals. `see` receives the state at each end of
/// an interval, beginning with the noise.
///
/// Times are those of an f32 grid `k / intervals`, and steps are its differences, as in upstream's solver.
pub fn follow(
    solver: Solver,
    intervals: usize,
    noise_btf: Tensor<3>,
    mut velocity: impl FnMut(Tensor<3>, f32) -> Tensor<3>,
    mut see: impl FnMut(&Tensor<3>),
) -> Tensor<3> {
    let at = |k: usize| k as f32 / intervals as f32;
    let mut x = noise_btf;
    see(&x);
    for k in 0..intervals {
        let t = at(k);
        let step = at(k + 1) - at(k);
        let first = velocity(x.clone(), t);
        x = match solver {
            Solver::Euler => x + first * step,
            Solver::Midpoint => {
                let half = 0.5 * step;
                let middle = x.clone() + first * half;
                x + velocity(middle, t + half) * step
            }
        };
        see(&x);
    }
    x
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    #[test]
    fn a_straight_line_is_followed_exactly_and_a_bent_one_better_by_the_midpoint() {
        let device = Device::flex();
        let noise = Tensor::<3>::from_data(TensorData::new(vec![1.0_f32, -2.0], [1, 2, 1]), &device);
        let data = Tensor::<3>::from_data(TensorData::new(vec![0.5_f32, 3.0], [1, 2, 1]), &device);
        let target = data.clone() - noise.clone();
        let off = |x: Tensor<3>| (x - data.clone()).abs().max().into_scalar::<f32>();
        assert!(off(follow(Solver::Euler, 4, noise.clone(), |_, _| target.clone(), |_| ())) < 1e-6);
        assert!(off(between(data.clone(), noise.clone(), &[1.0])) < 1e-6);
        // dx/dt = x grows to e times the initial value.
        let grown = |solver, n| {
            let end = follow(solver, n, noise.clone(), |x, _| x, |_| ()) / noise.clone();
            (end.mean().into_scalar::<f32>() - std::f32::consts::E).abs()
        };
        assert!(grown(Solver::Midpoint, 8) < 0.1 * grown(Solver::Euler, 16));
        // A single step equals the followed one; a jump along a straight line ends at the data from any point.
        let one = Solver::Midpoint.step(noise.clone(), &[0.0], &[1.0], |x, _| x);
        assert!(
            (one - follow(Solver::Midpoint, 1, noise.clone(), |x, _| x, |_| ())).abs().max().into_scalar::<f32>()
                < 1e-6
        );
        for steps in 1..3 {
            let line = |x: Tensor<3>, t: f32| (data.clone() - x) / (1.0 - t);
            assert!(off(jump(steps, noise.clone(), line, |_| noise.clone() * 3.0)) < 1e-6);
        }
        assert_eq!((Solver::Euler.evaluations(16), Solver::Midpoint.evaluations(15)), (16, 30));
    }
}
