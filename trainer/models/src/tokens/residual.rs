//! Sampling the layers of codes above the first with MoMask's residual transformer (Guo et al., CVPR 2024).

use burn::tensor::Tensor;

use super::logits::guided;
use super::{Uniforms, gumbel_draw, keep_top};
use crate::device::host;
use crate::kernels::Dropout;
use crate::networks::{MomaskConfig, ResidualTransformer};
use crate::quantizer::NO_CODE;
use crate::tokens::masked::Sampling;

/// The first layer, to which the others are added.
#[derive(Clone, Copy)]
pub struct First<'a> {
    /// Ids of the layer [B n], with [`NO_CODE`] past the end of each clip.
    pub ids: &'a [i64],
    /// Number of tokens of each clip.
    pub lengths: &'a [usize],
    /// Known codes by layer from 1 on and place in [B n]. They are not drawn, and the layers above see them. The
    /// published sampler has none.
    pub known: &'a dyn Fn(usize, usize) -> Option<usize>,
}

impl std::fmt::Debug for First<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("First").field("lengths", &self.lengths).finish_non_exhaustive()
    }
}

/// All ids [B n Q] for the ids of the first layer [B n], which are [`NO_CODE`] past the end of each clip. A pad drawn
/// inside a clip is [`NO_CODE`] too: that layer adds nothing there. The layers are drawn one after the other;
/// `sampling.steps` is not used.
pub fn generate(
    network: &ResidualTransformer,
    config: &MomaskConfig,
    sampling: &Sampling,
    text_bc: Tensor<2>,
    first: First<'_>,
    uniforms: Uniforms<'_>,
) -> Vec<i64> {
    let First { ids: first, lengths, known } = first;
    let batch = lengths.len();
    let pad = config.residual_pad();
    let classes = config.codes + 1;
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
            ids[at] = known(layer, at).unwrap_or_else(|| gumbel_draw(logits, sampling.temperature, &draws));
        }
        layers.push(ids);
        sum = Some(seen);
    }
    let id = |at: usize, layer: &Vec<usize>| if layer[at] == pad { NO_CODE } else { layer[at] as i64 };
    (0..first.len()).flat_map(|at| layers.iter().map(move |layer| id(at, layer))).collect()
}

/// Selects a clip's training layer, from 1 to Q - 1, by a uniform draw; lower layers are more likely.
pub fn trained_layer(uniform: f32, quantizers: usize) -> usize {
    let top = (quantizers - 2) as f32;
    1 + ((1.0 - super::cosine(uniform)) * top).round_ties_even() as usize
}
