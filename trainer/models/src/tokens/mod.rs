//! Sampling token ids from the published generators, and their training losses.
//!
//! Everything but the networks runs on the host: ids are integers, and masking is decided by comparisons. Draws are
//! arguments, so that a caller keys them and a test stores them.
//!
//! Losses are sums over the examples, in a form that adds up over slices. The weights come from a caller that has the
//! whole batch.

pub mod autoregressive;
pub mod masked;
pub mod mmm;
pub mod residual;

use burn::tensor::activation::log_softmax;
use burn::tensor::{Tensor, TensorData};

use crate::device::host;
use crate::quantizer::{first_largest, gumbel};

/// Fills uniform draws in [0, 1), one per class: step, example, position.
pub type Uniforms<'a> = &'a mut dyn FnMut(usize, usize, usize, &mut [f32]);

/// The lowest temperature, at which draws are the largest logit.
const COLDEST: f32 = 1e-10;

/// Draws a class: the largest of `logit / temperature + gumbel`.
pub fn gumbel_draw(logits: &[f32], temperature: f32, uniforms: &[f32]) -> usize {
    let temperature = temperature.max(COLDEST);
    first_largest(logits.iter().zip(uniforms).map(|(logit, u)| logit / temperature + gumbel(*u)))
}

/// Keeps the `ceil((1 - threshold) n)` largest of n logits; the others become minus infinity.
///
/// Computed in floating point as upstream: a threshold of 0.9 keeps 2 of 20 logits.
pub fn keep_top(logits: &mut [f32], threshold: f64) {
    let kept = ((1.0 - threshold) * logits.len() as f64).ceil() as usize;
    let mut order: Vec<usize> = (0..logits.len()).collect();
    order.sort_by(|a, b| logits[*b].total_cmp(&logits[*a]));
    order.into_iter().skip(kept).for_each(|i| logits[i] = f32::NEG_INFINITY);
}

/// The share of a class in the softmax of `logits`.
pub fn probability(logits: &[f32], class: usize) -> f32 {
    let top = logits.iter().fold(f32::NEG_INFINITY, |top, l| top.max(*l));
    let all: f32 = logits.iter().map(|l| (l - top).exp()).sum();
    (logits[class] - top).exp() / all
}

/// Share of tokens that are masked at `t` from 0 (all) to 1 (none): `cos(pi t / 2)`. Computed in f32 as upstream, since
/// the rounding decides counts.
pub fn cosine(t: f32) -> f32 {
    (t * std::f32::consts::PI * 0.5).cos()
}

/// Point `k` of `count` equidistant points from 0 to 1, computed in f32 as by `torch.linspace`: the second half from
/// the end.
pub fn grid(k: usize, count: usize) -> f32 {
    if count < 2 {
        return 0.0;
    }
    let step = 1.0 / (count - 1) as f32;
    if k < count / 2 { step * k as f32 } else { 1.0 - step * (count - 1 - k) as f32 }
}

/// Cross-entropy of logits [B, n, classes] against `targets` [B n], weighted by `weights` [B n] and summed. A target of
/// weight 0 need not be a class.
pub fn cross_entropy(logits_bnc: Tensor<3>, targets: &[usize], weights: &[f32]) -> Tensor<1> {
    let [batch, len, classes] = logits_bnc.dims();
    let mut own = vec![0.0_f32; batch * len * classes];
    for (i, (target, weight)) in targets.iter().zip(weights).enumerate() {
        if *weight != 0.0 {
            own[i * classes + target] = *weight;
        }
    }
    let own = Tensor::<3>::from_data(TensorData::new(own, [batch, len, classes]), &logits_bnc.device());
    (log_softmax(logits_bnc, 2) * own).sum().neg()
}

/// Logits with classifier-free guidance, `null + scale (conditional - null)`; scale 1 skips the null pass.
fn guided<const D: usize>(scale: f32, mut pass: impl FnMut(bool) -> Tensor<D>) -> Tensor<D> {
    let conditional = pass(true);
    if scale == 1.0 {
        return conditional;
    }
    let null = pass(false);
    null.clone() + (conditional - null) * scale
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_kept_is_that_of_floating_point() {
        let kept = |n: usize| {
            let mut logits: Vec<f32> = (0..n).map(|i| (i * 7 % n) as f32).collect();
            keep_top(&mut logits, 0.9);
            logits.iter().filter(|l| l.is_finite()).count()
        };
        assert_eq!((kept(20), kept(21), kept(512), kept(513)), (2, 3, 52, 52));
    }

    #[test]
    fn masked_counts_are_those_of_upstream() {
        let counts = |length: f32, steps: usize| -> Vec<f32> {
            let at = |k: usize| cosine(grid(k, steps)) * length;
            (0..steps).map(|k| at(k).round_ties_even().max(1.0)).collect()
        };
        assert_eq!(counts(49.0, 10), [49.0, 48.0, 46.0, 42.0, 38.0, 31.0, 25.0, 17.0, 9.0, 1.0]);
        assert_eq!(counts(20.0, 10), [20.0, 20.0, 19.0, 17.0, 15.0, 13.0, 10.0, 7.0, 3.0, 1.0]);
    }
}
