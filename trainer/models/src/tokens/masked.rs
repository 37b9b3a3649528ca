//! Sampling the first layer of codes with MoMask's masked transformer (Guo et al., CVPR 2024), and its training
//! examples.

use burn::tensor::Tensor;

use super::logits::guided;
use super::{Uniforms, cosine, grid, gumbel_draw, keep_top, probability};
use crate::device::host;
use crate::kernels::Dropout;
use crate::networks::{MaskedTransformer, MomaskConfig};
use crate::quantizer::NO_CODE;

/// Score of a token that is never masked again.
const KEPT: f32 = 1e5;

/// Settings of the iterative sampling.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampling {
    /// Number of iterations.
    pub steps: usize,
    /// Scale of classifier-free guidance; 1 for none.
    pub guidance: f32,
    /// Divisor of the logits.
    pub temperature: f32,
    /// Share of the classes that are excluded, the least likely first.
    pub threshold: f64,
}

/// A clip with known and open tokens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Canvas {
    /// A known id, or `None` for one to be drawn.
    pub tokens: Vec<Option<usize>>,
}

impl Canvas {
    /// A clip of `len` open tokens.
    pub fn empty(len: usize) -> Self {
        Self { tokens: vec![None; len] }
    }
}

/// Ids [B n] of the first layer, with [`NO_CODE`] past the end of each clip; n is the longest clip's length.
///
/// Iteration k of T masks the `round(cos(pi t / 2) open)` open tokens with the lowest scores, at least one, with
/// `t = k / (T - 1)`. It draws them all at once; the score of a drawn token is its share in the softmax. Tokens that an
/// iteration keeps are final. Known tokens are never masked, and counts are relative to the others.
///
/// `see` receives the network's input ids of each iteration.
pub fn generate(
    network: &MaskedTransformer,
    config: &MomaskConfig,
    sampling: &Sampling,
    text_bc: Tensor<2>,
    canvases: &[Canvas],
    uniforms: Uniforms<'_>,
    mut see: impl FnMut(&[usize]),
) -> Vec<i64> {
    let lengths: Vec<usize> = canvases.iter().map(|canvas| canvas.tokens.len()).collect();
    let len = lengths.iter().copied().max().unwrap_or(0);
    let mask = config.mask();
    let pad = config.pad();
    let classes = config.codes;
    let mut ids: Vec<usize> = canvases
        .iter()
        .flat_map(|canvas| (0..len).map(|p| canvas.tokens.get(p).map_or(pad, |known| known.unwrap_or(mask))))
        .collect();
    let mut scores: Vec<f32> = ids.iter().map(|id| if *id == mask { 0.0 } else { KEPT }).collect();
    let open: Vec<usize> = canvases.iter().map(|c| c.tokens.iter().filter(|token| token.is_none()).count()).collect();
    let mut draws = vec![0.0; classes];
    for step in 0..sampling.steps {
        let t = grid(step, sampling.steps);
        let mut masked = vec![false; ids.len()];
        for (b, open) in open.iter().enumerate().filter(|(_, open)| **open > 0) {
            let count = (cosine(t) * *open as f32).round_ties_even().max(1.0) as usize;
            let mut order: Vec<usize> = (b * len..(b + 1) * len).collect();
            order.sort_by(|x, y| scores[*x].total_cmp(&scores[*y]));
            order.into_iter().take(count).for_each(|at| masked[at] = true);
        }
        ids.iter_mut().zip(&masked).filter(|(_, masked)| **masked).for_each(|(id, _)| *id = mask);
        see(&ids);
        let logits = guided(sampling.guidance, |conditional| {
            let text = if conditional { text_bc.clone() } else { text_bc.zeros_like() };
            network.forward(&ids, text, &lengths, &mut Dropout::off())
        });
        for (at, logits) in host(logits).chunks_exact(classes).enumerate() {
            scores[at] = KEPT;
            if !masked[at] {
                continue;
            }
            let mut kept = logits.to_vec();
            keep_top(&mut kept, sampling.threshold);
            uniforms(step, at / len, at % len, &mut draws);
            ids[at] = gumbel_draw(&kept, sampling.temperature, &draws);
            scores[at] = probability(logits, ids[at]);
        }
    }
    let id = |(at, id): (usize, usize)| if at % len < lengths[at / len] { id as i64 } else { NO_CODE };
    ids.into_iter().enumerate().map(id).collect()
}

/// The draws for one clip in training; every list has one value per position.
#[derive(Debug, Clone, Copy)]
pub struct Corruption<'a> {
    /// Uniform: sets the share of chosen positions to `cos(pi u / 2)`, padding counted.
    pub share: f32,
    /// Uniform: the positions with the smallest values are chosen.
    pub order: &'a [f32],
    /// Uniform: a tenth of the chosen tokens is replaced by `random`.
    pub replace: &'a [f32],
    /// Uniform: 88 of 100 of the other chosen tokens are masked.
    pub hide: &'a [f32],
    /// Codes that replace tokens.
    pub random: &'a [usize],
}

/// A training example of one clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Example {
    /// The network's input ids.
    pub input: Vec<usize>,
    /// True for positions that the loss counts.
    pub asked: Vec<bool>,
}

impl Example {
    /// Masks and replaces `tokens`; positions from `len` on are padding.
    pub fn new(config: &MomaskConfig, tokens: &[usize], len: usize, draws: &Corruption<'_>) -> Self {
        let n = tokens.len();
        let count = (n as f32 * cosine(draws.share)).round_ties_even().max(1.0) as usize;
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|a, b| draws.order[*a].total_cmp(&draws.order[*b]));
        // Upstream compares the sort order itself with the count, not ranks. It selects the same number, by another
        // draw.
        let asked: Vec<bool> = order.iter().enumerate().map(|(p, at)| *at < count && p < len).collect();
        let input = (0..n).map(|p| match (p < len, asked[p]) {
            (false, _) => config.pad(),
            (true, false) => tokens[p],
            (true, true) if draws.replace[p] < 0.1 => draws.random[p],
            (true, true) if draws.hide[p] < 0.88 => config.mask(),
            (true, true) => tokens[p],
        });
        let input = input.collect();
        Self { input, asked }
    }
}
