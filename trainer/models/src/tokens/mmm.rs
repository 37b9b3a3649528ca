//! Sampling from [`Mmm`], and its training examples. Source: MMM (Pinyoanuntapong et al., CVPR 2024).

use burn::tensor::Tensor;

use super::{Uniforms, cosine, gumbel_draw, probability};
use crate::device::host;
use crate::kernels::Dropout;
use crate::networks::{Mmm, MmmCondition, MmmConfig};

/// Tokens of the longest clip; numbers of steps refer to it.
const LONGEST: f64 = 49.0;

/// Settings of the stepwise sampling.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sampling {
    /// Steps of the longest clip; shorter ones reach their last count in fewer.
    pub steps: usize,
    /// Uses the largest logit instead of a draw.
    pub greedy: bool,
    /// The base of the counts of masked tokens.
    pub counts: Counts,
    /// Ends a batch of one before the step that would draw a single token. Upstream does so because of an operator
    /// precedence error; larger batches always run all steps.
    pub stops_alone: bool,
}

/// The base of the counts of masked tokens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Counts {
    /// The tokens that are not given.
    Open,
    /// The whole clip, with given tokens: a gap shorter than the count is drawn again as a whole.
    Whole,
}

/// The inputs and results of one step.
#[derive(Debug)]
pub struct Step<'a> {
    /// The network's input ids, [B P].
    pub seen: &'a [usize],
    /// Logits [B P K].
    pub logits: &'a [f32],
    /// The drawn id of each masked position.
    pub drawn: &'a [Option<usize>],
    /// Number of tokens of each clip to be masked.
    pub counts: &'a [usize],
    /// One minus the softmax share of the drawn id; 0 for positions without a draw.
    pub scores: &'a [f32],
}

/// The number of steps of a clip of `tokens` tokens, in f32 as upstream.
fn own_steps(sampling: &Sampling, tokens: usize) -> f32 {
    ((sampling.steps as f64 / LONGEST) as f32 * tokens as f32).round_ties_even() + 1e-8
}

/// Ids [B P] with end and padding. `given[b]` holds the clip's tokens, `None` for one to be drawn.
///
/// Step k masks the least likely of the drawn tokens and draws them again, all at once. Their number is
/// `max(1, floor(n cos(pi t / 2)))` with `t = min(1, k / s)` and `s = round(steps tokens / 49)`. Tokens that a step
/// keeps are final.
///
/// # Panics
/// If a clip and its end exceed the network's positions.
pub fn sample(
    network: &Mmm,
    config: &MmmConfig,
    sampling: &Sampling,
    condition: &MmmCondition,
    given: &[Vec<Option<usize>>],
    uniforms: Uniforms<'_>,
    mut see: impl FnMut(&Step<'_>),
) -> Vec<usize> {
    let batch = given.len();
    let positions = config.positions();
    let classes = config.codes;
    let lengths: Vec<usize> = given.iter().map(Vec::len).collect();
    assert!(lengths.iter().all(|len| *len < positions), "clips of {lengths:?} tokens for {positions} positions");
    let visible: Vec<usize> = lengths.iter().map(|len| len + 1).collect();
    let mut ids: Vec<usize> = given.iter().flat_map(|tokens| laid_out(config, tokens)).collect();
    let open = |b: usize, p: usize| given[b].get(p).is_some_and(Option::is_none);
    let mut scores: Vec<f32> = (0..batch).flat_map(|b| (0..positions).map(move |p| f32::from(open(b, p)))).collect();
    let counted: Vec<usize> = given
        .iter()
        .map(|tokens| match sampling.counts {
            Counts::Open => tokens.iter().filter(|token| token.is_none()).count(),
            Counts::Whole => tokens.len(),
        })
        .collect();
    let temperature = if sampling.greedy { 0.0 } else { 1.0 };
    let mut draws = vec![0.0; classes];
    for step in 0..sampling.steps {
        let times: Vec<f32> = lengths.iter().map(|len| (step as f32 / own_steps(sampling, *len)).min(1.0)).collect();
        if sampling.stops_alone && batch == 1 && step > 0 {
            let slip = (step as f32 - 1.0 / own_steps(sampling, lengths[0])).min(1.0);
            if slip == times[0] {
                break;
            }
        }
        let count = |(t, n): (&f32, &usize)| ((cosine(*t) * *n as f32) as usize).max(1);
        let counts: Vec<usize> = times.iter().zip(&counted).map(count).collect();
        let masked = least_certain(&counts, &scores, open);
        ids.iter_mut().zip(&masked).filter(|(_, masked)| **masked).for_each(|(id, _)| *id = config.mask());
        let seen = ids.clone();
        let logits = logits(network, condition, &ids, Some(&visible), &mut Dropout::off());
        let logits = host(logits);
        let mut drawn = vec![None; ids.len()];
        for (at, logits) in logits.chunks_exact(classes).enumerate() {
            scores[at] = 0.0;
            if masked[at] {
                uniforms(step, at / positions, at % positions, &mut draws);
                let id = gumbel_draw(logits, temperature, &draws);
                (ids[at], drawn[at]) = (id, Some(id));
                scores[at] = 1.0 - probability(logits, id);
            }
        }
        see(&Step { seen: &seen, logits: &logits, drawn: &drawn, counts: &counts, scores: &scores });
    }
    ids
}

/// Chooses the places to mask: of each clip the open ones with the highest scores, as many as `counts` says.
fn least_certain(counts: &[usize], scores: &[f32], open: impl Fn(usize, usize) -> bool) -> Vec<bool> {
    let positions = scores.len() / counts.len().max(1);
    let mut masked = vec![false; scores.len()];
    for (b, count) in counts.iter().enumerate() {
        let mut order: Vec<usize> = (0..positions).filter(|p| open(b, *p)).map(|p| b * positions + p).collect();
        order.sort_by(|x, y| scores[*y].total_cmp(&scores[*x]));
        order.into_iter().take(*count).for_each(|at| masked[at] = true);
    }
    masked
}

/// Lays out known tokens, masks, the end and padding.
fn laid_out(config: &MmmConfig, tokens: &[Option<usize>]) -> Vec<usize> {
    let mut ids: Vec<usize> = tokens.iter().map(|token| token.unwrap_or(config.mask())).collect();
    ids.push(config.end());
    ids.resize(config.positions(), config.pad());
    ids
}

/// Logits [B, P, K] without the caption's place.
pub fn logits(
    network: &Mmm,
    condition: &MmmCondition,
    ids: &[usize],
    visible: Option<&[usize]>,
    dropout: &mut Dropout,
) -> Tensor<3> {
    let out = network.forward(ids, condition, visible, None, dropout);
    let [batch, len, classes] = out.dims();
    out.slice([0..batch, 1..len, 0..classes])
}

/// The draws for one clip in training; every list has one value per position.
#[derive(Debug, Clone, Copy)]
pub struct Corruption<'a> {
    /// Uniform: the share of masked tokens is `0.5 + u / 2`.
    pub share: f32,
    /// True if a token keeps its id before masking.
    pub keep: &'a [bool],
    /// Codes for the tokens that do not keep theirs.
    pub random: &'a [usize],
    /// Uniform: decides the masked positions.
    pub order: &'a [f32],
}

/// A training example of one clip.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Example {
    /// The network's input: `positions` ids.
    pub input: Vec<usize>,
    /// The expected ids.
    pub target: Vec<usize>,
    /// Number of tokens; the end after them is an input, but the loss does not count it.
    pub len: usize,
}

impl Example {
    /// Lays out `tokens`, the end and padding.
    ///
    /// The masked positions follow the published script, which compares the sort order of `u - valid` itself with the
    /// count, not ranks.
    ///
    /// # Panics
    /// If the tokens and the end exceed the network's positions.
    pub fn new(config: &MmmConfig, tokens: &[usize], draws: &Corruption<'_>) -> Self {
        let len = tokens.len();
        let positions = config.positions();
        assert!(len < positions, "{len} tokens for {positions} positions");
        let mut target = tokens.to_vec();
        target.push(config.end());
        target.resize(positions, config.pad());
        let count = (len as f32 * (0.5 + 0.5 * draws.share)).round_ties_even().max(1.0) as usize;
        let key = |p: usize| draws.order[p] - f32::from(p < len);
        let mut order: Vec<usize> = (0..positions).collect();
        order.sort_by(|a, b| key(*a).total_cmp(&key(*b)));
        let input = (0..positions).map(|p| match (p < len, order[p] < count) {
            (false, false) => target[p],
            (_, true) => config.mask(),
            (true, false) if draws.keep[p] => target[p],
            (true, false) => draws.random[p],
        });
        let input = input.collect();
        Self { input, target, len }
    }
}

/// Cross-entropy over the tokens, masked or not: the mean of each clip, summed. Logits [B, P, K].
pub fn loss(logits_bpk: Tensor<3>, examples: &[Example]) -> Tensor<1> {
    let targets: Vec<usize> = examples.iter().flat_map(|example| example.target.iter().copied()).collect();
    let weights: Vec<f32> = examples
        .iter()
        .flat_map(|e| (0..e.target.len()).map(|p| if p < e.len { 1.0 / e.len as f32 } else { 0.0 }))
        .collect();
    super::cross_entropy(logits_bpk, &targets, &weights)
}
