//! Sampling from [`Gpt`], and its training examples. Source: T2M-GPT (Zhang et al., CVPR 2023).

use burn::tensor::Tensor;

use super::cross_entropy;
use crate::device::host;
use crate::kernels::Dropout;
use crate::networks::{Gpt, GptConfig};
use crate::quantizer::first_largest;

/// Choice of the next id from its logits.
pub enum Draw<'a> {
    /// The id with the largest logit.
    Greedy,
    /// A draw from the softmax: the largest of `p / e`. The function fills one exponential `e` per class for a step and
    /// example.
    Categorical(&'a mut dyn FnMut(usize, usize, &mut [f64])),
}

impl std::fmt::Debug for Draw<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Greedy => "Greedy",
            Self::Categorical(_) => "Categorical",
        })
    }
}

/// The ids of each example before its end; empty if the end comes first.
///
/// `text_bc` [B, C]. Finished examples are still computed with the others, whose logits do not depend on them. As
/// upstream, an example that reaches the last position has one id less than there are positions: the last draw is
/// dropped.
pub fn sample(network: &Gpt, config: &GptConfig, text_bc: Tensor<2>, mut draw: Draw<'_>) -> Vec<Vec<usize>> {
    let batch = text_bc.dims()[0];
    let end = config.end();
    let classes = config.codes + 1;
    let mut ids: Vec<Vec<usize>> = vec![Vec::new(); batch];
    let mut lengths: Vec<Option<usize>> = vec![None; batch];
    let mut exponentials = vec![0.0; classes];
    for step in 0..config.block {
        let flat: Vec<usize> = ids.concat();
        let logits = network.forward(&flat, text_bc.clone(), &mut Dropout::off());
        let last = host(logits.slice([0..batch, step..step + 1, 0..classes]));
        for (b, logits) in last.chunks_exact(classes).enumerate() {
            if lengths[b].is_some() {
                ids[b].push(config.pad());
                continue;
            }
            let id = match &mut draw {
                Draw::Greedy => first_largest(logits.iter().copied()),
                Draw::Categorical(fill) => {
                    fill(step, b, &mut exponentials);
                    drawn(logits, &exponentials)
                }
            };
            if id == end || step + 1 == config.block {
                lengths[b] = Some(step);
            }
            ids[b].push(if id == end { config.pad() } else { id });
        }
        if lengths.iter().all(Option::is_some) {
            break;
        }
    }
    let cut = |(mut ids, length): (Vec<usize>, Option<usize>)| {
        ids.truncate(length.unwrap_or(config.block - 1));
        ids
    };
    ids.into_iter().zip(lengths).map(cut).collect()
}

/// The class with the largest `p / e`; logarithms are compared, so that nothing overflows.
fn drawn(logits: &[f32], exponentials: &[f64]) -> usize {
    let scores = logits.iter().zip(exponentials).map(|(logit, e)| f64::from(*logit) - e.ln());
    scores.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(class, _)| class)
}

/// A training example of one clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Example {
    /// The network's input: `block - 1` ids, some replaced.
    pub input: Vec<usize>,
    /// The expected ids at each of the `block` places.
    pub target: Vec<usize>,
    /// Number of tokens, without the end.
    pub len: usize,
}

impl Example {
    /// Lays out `tokens`, the end and padding. The input has `random` instead wherever `keep` is false, at ends and
    /// padding too; both have `block - 1` values.
    ///
    /// # Panics
    /// If the tokens and the end exceed the network's places.
    pub fn new(config: &GptConfig, tokens: &[usize], keep: &[bool], random: &[usize]) -> Self {
        assert!(tokens.len() < config.block, "{} tokens for {} places", tokens.len(), config.block);
        let mut target = tokens.to_vec();
        target.push(config.end());
        target.resize(config.block, config.pad());
        let seen = target.iter().zip(keep.iter().zip(random));
        let input = seen.map(|(id, (keep, random))| if *keep { *id } else { *random }).collect();
        Self { input, target, len: tokens.len() }
    }
}

/// Cross-entropy over tokens and end: the mean of each example, summed. Logits [B, block, K + 1].
pub fn loss(logits_btc: Tensor<3>, examples: &[Example]) -> Tensor<1> {
    let targets: Vec<usize> = examples.iter().flat_map(|example| example.target.iter().copied()).collect();
    let weights: Vec<f32> = examples
        .iter()
        .flat_map(|e| (0..e.target.len()).map(|t| if t <= e.len { 1.0 / (e.len + 1) as f32 } else { 0.0 }))
        .collect();
    cross_entropy(logits_btc, &targets, &weights)
}
