//! Draws from logits, guidance between them, and their loss.

use burn::tensor::activation::log_softmax;
use burn::tensor::{Tensor, TensorData};

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
pub(super) fn guided<const D: usize>(scale: f32, mut pass: impl FnMut(bool) -> Tensor<D>) -> Tensor<D> {
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
}
