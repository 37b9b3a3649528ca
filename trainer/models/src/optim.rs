//! AdamW, the moving average, clipping and the learning rate, on flat buffers (see [`crate::flat`]).
//!
//! Source: Loshchilov and Hutter, arXiv:1711.05101, in the arithmetic of PyTorch: decay first, `eps` added outside the
//! bias-corrected root. Burn's optimizers are not used: their state depends on random parameter ids, and they clip each
//! tensor separately.
//!
//! Every element's result depends on that element alone, and sums run in one fixed order. So the bits do not depend on
//! the number of threads or workers.

use protocol::stage::{Decay, Optimizer, Training};

use crate::kernels::simd::multiversion;

/// Constants of the AdamW optimizer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamW {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Decoupled weight decay.
    pub weight_decay: f64,
}

/// Factors of one update.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rates {
    /// Factor of the parameters, the weight decay.
    pub(crate) keep: f32,
    /// Factor of the first moment: the learning rate, bias-corrected.
    pub(crate) rate: f32,
    /// Factor of the root of the second moment, its bias correction.
    pub(crate) unbias: f32,
    /// Factor of the gradient in the first moment.
    pub(crate) new1: f32,
    /// Factor of the old second moment.
    pub(crate) beta2: f32,
    /// Factor of the squared gradient in the second moment.
    pub(crate) new2: f32,
    /// Added to the root of the second moment.
    pub(crate) eps: f32,
}

impl From<&Optimizer> for AdamW {
    fn from(settings: &Optimizer) -> Self {
        Self { beta1: settings.beta1, beta2: settings.beta2, eps: settings.eps, weight_decay: settings.weight_decay }
    }
}

impl AdamW {
    /// Computes the factors of update number `t`, counted from 1, with learning rate `lr`.
    ///
    /// # Panics
    /// If `t` is 0.
    pub(crate) fn rates(&self, t: u64, lr: f64) -> Rates {
        assert!(t > 0, "updates are counted from 1");
        let power = |beta: f64| beta.powf(t as f64);
        Rates {
            keep: (1.0 - lr * self.weight_decay) as f32,
            rate: (lr / (1.0 - power(self.beta1))) as f32,
            unbias: (1.0 / (1.0 - power(self.beta2)).sqrt()) as f32,
            new1: (1.0 - self.beta1) as f32,
            beta2: self.beta2 as f32,
            new2: (1.0 - self.beta2) as f32,
            eps: self.eps as f32,
        }
    }

    /// Makes update number `t`, counted from 1, with rate `lr`, in one pass over the buffers. `m` and `v` start at
    /// zero.
    ///
    /// # Panics
    /// If the buffers differ in length, or `t` is 0.
    pub fn step(&self, t: u64, lr: f64, params: &mut [f32], grads: &[f32], m: &mut [f32], v: &mut [f32]) {
        self.step_by(1.0, t, lr, params, grads, m, v);
    }

    /// Like [`step`](Self::step), with `factor` times the gradients.
    ///
    /// # Panics
    /// As [`step`](Self::step).
    #[expect(clippy::too_many_arguments, reason = "an update has four buffers and three numbers")]
    pub fn step_by(
        &self,
        factor: f32,
        t: u64,
        lr: f64,
        params: &mut [f32],
        grads: &[f32],
        m: &mut [f32],
        v: &mut [f32],
    ) {
        let len = params.len();
        assert_eq!((grads.len(), m.len(), v.len()), (len, len, len), "lengths of gradients and moments");
        update(self.rates(t, lr), factor, params, grads, m, v);
    }
}

multiversion! {
    fn update(rates: Rates, factor: f32, params: &mut [f32], grads: &[f32], m: &mut [f32], v: &mut [f32]) {
        let Rates { keep, rate, unbias, new1, beta2, new2, eps } = rates;
        for (((p, g), m), v) in params.iter_mut().zip(grads).zip(m).zip(v) {
            let g = *g * factor;
            *m += new1 * (g - *m);
            *v = beta2 * *v + new2 * g * g;
            *p = keep * *p - rate * *m / (v.sqrt() * unbias + eps);
        }
    }
}

/// Moves the average: `target <- decay target + (1 - decay) source`.
///
/// # Panics
/// If the lengths differ.
pub fn ema(target: &mut [f32], source: &[f32], decay: f64) {
    assert_eq!(target.len(), source.len(), "lengths of the average and its source");
    blend(target, source, decay as f32, (1.0 - decay) as f32);
}

multiversion! {
    fn blend(target: &mut [f32], source: &[f32], keep: f32, take: f32) {
        for (t, s) in target.iter_mut().zip(source) {
            *t = keep * *t + take * s;
        }
    }
}

/// L2 norm in f64. Eight running sums over every eighth element are added in order: fast, and the same bits everywhere.
pub fn global_norm(values: &[f32]) -> f64 {
    sum_of_squares(values).sqrt()
}

multiversion! {
    fn sum_of_squares(values: &[f32]) -> f64 {
        let mut sums = [0.0_f64; 8];
        let chunks = values.chunks_exact(8);
        let rest = chunks.remainder();
        for chunk in chunks {
            for (sum, value) in sums.iter_mut().zip(chunk) {
                *sum += f64::from(*value) * f64::from(*value);
            }
        }
        for (sum, value) in sums.iter_mut().zip(rest) {
            *sum += f64::from(*value) * f64::from(*value);
        }
        sums.iter().sum::<f64>()
    }
}

/// The factor that scales gradients of this norm to at most `max`; 1 if the norm is below it, or `max` is 0.
pub fn clip_factor(norm: f64, max: f64) -> f64 {
    if max == 0.0 { 1.0 } else { (max / (norm + 1e-6)).min(1.0) }
}

/// Updates per step of [`Decay::Staircase`], and the rate's factor after each.
const STAIR: u64 = 5_000;
const STEP_DOWN: f64 = 0.9;

/// The learning rate as a function of the number of updates made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LrSchedule {
    /// Rate at the end of the warm-up.
    pub peak: f64,
    /// Updates of linear warm-up; the first has rate 0.
    pub warmup: u64,
    /// Total number of updates; the cosine ends there.
    pub steps: u64,
    /// The decay after the warm-up.
    pub decay: Decay,
}

impl From<&Training> for LrSchedule {
    fn from(training: &Training) -> Self {
        Self { peak: training.lr, warmup: training.warmup.0, steps: training.steps.0, decay: training.decay }
    }
}

impl LrSchedule {
    /// The rate of the next update after `done` updates.
    pub fn at(&self, done: u64) -> f64 {
        if done < self.warmup {
            return self.peak * done as f64 / self.warmup as f64;
        }
        match self.decay {
            Decay::Constant => self.peak,
            Decay::Staircase => self.peak * STEP_DOWN.powf(((done - self.warmup) / STAIR) as f64),
            Decay::Cosine => {
                let length = self.steps.saturating_sub(self.warmup).max(1);
                let progress = ((done - self.warmup) as f64 / length as f64).min(1.0);
                self.peak * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warm_up_starts_at_zero_and_the_cosine_ends_there() {
        let rates = LrSchedule { peak: 2.0, warmup: 10, steps: 110, decay: Decay::Cosine };
        assert_eq!((rates.at(0), rates.at(5), rates.at(10)), (0.0, 1.0, 2.0));
        assert!((rates.at(60) - 1.0).abs() < 1e-12 && rates.at(110) < 1e-12 && rates.at(500) < 1e-12);
        let constant = LrSchedule { warmup: 0, decay: Decay::Constant, ..rates };
        assert_eq!((constant.at(0), constant.at(1000)), (2.0, 2.0));
        let stairs = LrSchedule { decay: Decay::Staircase, ..constant };
        assert_eq!((stairs.at(0), stairs.at(4_999)), (2.0, 2.0));
        assert!((stairs.at(5_000) - 1.8).abs() < 1e-12 && (stairs.at(49_999) / 2.0 - 0.9_f64.powi(9)).abs() < 1e-12);
        // A run shorter than its warm-up stays in it.
        assert_eq!(LrSchedule { warmup: 10, steps: 5, ..rates }.at(4), 0.8);
    }

    #[test]
    fn norm_counts_every_element_and_clipping_caps_it() {
        let values: Vec<f32> = (0..19).map(|i| i as f32 - 9.0).collect();
        let exact = values.iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt();
        assert!((global_norm(&values) - exact).abs() < 1e-12);
        assert!(global_norm(&[1.0, f32::NAN]).is_nan());
        assert_eq!((clip_factor(0.5, 1.0), clip_factor(9.0, 0.0)), (1.0, 1.0));
        assert!((clip_factor(4.0, 1.0) - 0.25).abs() < 1e-6);
    }
}
