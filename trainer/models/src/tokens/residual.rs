//! Adding the layers of codes above the first with MoMask's residual transformer (Guo et al., CVPR 2024).

use burn::tensor::Tensor;

use super::{Uniforms, guided, gumbel_draw, host, keep_top};
use crate::kernels::Dropout;
use crate::networks::{MomaskConfig, ResidualTransformer};
use crate::quantizer::NO_CODE;
use crate::tokens::masked::Sampling;

/// All ids [B n Q] for those of the first layer [B n], which are [`NO_CODE`] behind the end of each clip. A pad that is drawn inside a clip is
/// [`NO_CODE`] too: that layer adds nothing there. The layers are drawn one after the other; `sampling.steps` does not matter.
pub fn generate(
    network: &ResidualTransformer,
    config: &MomaskConfig,
    sampling: &Sampling,
    text_bc: Tensor<2>,
    first: &[i64],
    lengths: &[usize],
    uniforms: Uniforms<'_>,
) -> Vec<i64> {
    let (batch, pad, classes) = (lengths.len(), config.residual_pad(), config.codes + 1);
    let len = first.len() / batch;
    let valid = |at: usize| at % len < lengths[at / len];
    let mut layers: Vec<Vec<usize>> =
        vec![first.iter().enumerate().map(|(at, id)| if valid(at) { *id as usize } else { pad }).collect()];
    let mut sum: Option<Tensor<3>> = None;
    let mut draws = vec![0.0; classes];
    for layer in 1..config.quantizers {
        let below = network.embed(&layers[layer - 1], layer - 1, batch);
        let seen = match sum.take() {
            Some(sum) => sum + below,
            None => below,
        };
        let logits = guided(sampling.guidance, |conditional| {
            let text = if conditional { text_bc.clone() } else { text_bc.zeros_like() };
            network.forward(seen.clone(), &vec![layer; batch], text, lengths, &mut Dropout::off())
        });
        let mut ids = vec![pad; first.len()];
        for (at, logits) in host(logits).chunks_exact_mut(classes).enumerate().filter(|(at, _)| valid(*at)) {
            keep_top(logits, sampling.threshold);
            uniforms(layer - 1, at / len, at % len, &mut draws);
            ids[at] = gumbel_draw(logits, sampling.temperature, &draws);
        }
        layers.push(ids);
        sum = Some(seen);
    }
    let id = |at: usize, layer: &Vec<usize>| if layer[at] == pad { NO_CODE } else { layer[at] as i64 };
    (0..first.len()).flat_map(|at| layers.iter().map(move |layer| id(at, layer))).collect()
}

/// The layer that a clip is trained on, from 1 to Q - 1, for a uniform draw: the lower ones more often.
pub fn trained_layer(uniform: f32, quantizers: usize) -> usize {
    let top = (quantizers - 2) as f32;
    1 + ((1.0 - super::cosine(uniform)) * top).round_ties_even() as usize
}
