//! `train.evaluator`: the text-motion evaluator, in two phases. Source: text-to-motion (Guo et al., CVPR 2022).
//!
//! The first phase trains movements: an autoencoder on windows, `L1(x', x) + a mean|m| + b L1(m[i+1], m[i])`, with x
//! the features in the evaluator's normalisation. With the movements frozen, the second phase trains the two GRUs: `|t
//! - m|^2` for a caption and its motion, `max(0, margin - |t - m|)^2` for other motions.
//!
//! Departs: the other motions are all of the slice except those with the same sentence, averaged. The original draws
//! one cyclic shift of the batch; ours is the expectation of the draw, without the draw that leaves every pair in
//! place. The result is that of the last step, not that with the lowest validation loss. The deviations of root and
//! contacts are divided by `emphasis` once; the original divides twice by 5 in passing.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::flat;
use models::kernels::{Dropout, Pointwise, weighted_distance};
use models::networks::{Evaluator, Init, MotionEncoder, MovementDecoder, MovementEncoder, TextEncoder};
use motion::Stream;
use motion::dataset::normalise;
use motion::dataset::{Dataset, crop, window};
use protocol::stage::{Positions, Split, TrainEvaluator};
use protocol::{ArtifactKind, Digest, Seed};

use crate::artifacts;
use crate::context::{AttemptContext, GangContext, Outcome, StageError};
use crate::external;
use crate::kinds::shape::Gang;
use crate::parts::evaluator::{self, EvaluatorMeta, UNIT};
use crate::parts::warm_start::WarmStart;
use crate::parts::word_vectors::{CLASSES, CaptionBatch, WORD_WIDTH, WORDS, Words};
use crate::train::network::{dropout_seed, group, no_clips};
use crate::train::{GroupPlan, Objective, Order, Pick, SliceResult, TrainState, Turns, train};

/// Keeps the gradient of a distance finite at 0, as in the original.
const NEAR: f64 = 1e-6;

/// The two phases, which key the draws.
const MOVEMENTS: u64 = 0;
const MATCHING: u64 = 1;

/// The networks of the first phase; the encoder comes first.
#[derive(Module, Debug)]
struct Movements {
    encoder: MovementEncoder,
    decoder: MovementDecoder,
}

struct EvaluatorObjective {
    settings: TrainEvaluator,
    meta: EvaluatorMeta,
    dataset: Dataset,
    train: Vec<usize>,
    words: Words,
    movements: Movements,
    /// The encoder of `movements` without tape.
    frozen: MovementEncoder,
    text: TextEncoder,
    motion: MotionEncoder,
    windows: Order,
    clips: Order,
    purpose: String,
    seed: Seed,
    dropout_seed: u64,
    device: Device,
}

/// Cropped motions of a slice.
struct Cuts {
    /// Rows `[B, T, features]` in the evaluator's normalisation, with zeros past the ends.
    rows: Vec<f32>,
    lengths: Vec<usize>,
    frames: usize,
}

impl EvaluatorObjective {
    /// Number of steps of the first phase.
    fn turning_point(&self) -> u64 {
        turning_point(&self.settings)
    }

    /// The members of a slice: every `slices`-th of the batch. The batch is not sorted by length, because motions are
    /// discriminated within a slice.
    fn pick(&mut self, phase: u64, step: u64, slice: usize) -> (Vec<Pick>, usize) {
        let slices = self.settings.training.batch.slices;
        let order = if phase == MOVEMENTS { &mut self.windows } else { &mut self.clips };
        let batch = order.batch(step, |_| 0);
        (batch.iter().skip(slice).step_by(slices).copied().collect(), batch.len())
    }

    fn draw(&self, what: &str, phase: u64, pick: Pick) -> Stream {
        Stream::new(self.seed, &format!("{}/{what}", self.purpose), pick.place, phase)
    }

    fn cut(&self, phase: u64, picks: &[Pick]) -> Cuts {
        let skeleton = self.dataset.skeleton();
        let parts: Vec<(usize, usize, usize)> = picks
            .iter()
            .map(|pick| {
                let e = self.train[pick.example];
                let len = self.dataset.entries[e].len;
                let mut draw = self.draw("crop", phase, *pick);
                let length = self.settings.movement.window;
                let (start, len) = if phase == MOVEMENTS {
                    window(&mut draw, length, length, len, skeleton)
                } else {
                    crop(&mut draw, len, skeleton)
                };
                (e, start, len)
            })
            .collect();
        let width = self.meta.mean.len();
        let lengths: Vec<usize> = parts.iter().map(|(_, _, len)| *len).collect();
        // A movement of padding follows every motion, as in an evaluation.
        let frames = lengths.iter().max().map_or(0, |most| most / UNIT * UNIT + UNIT);
        let mut rows = vec![0.0; parts.len() * frames * width];
        for ((e, start, len), to) in parts.iter().zip(rows.chunks_exact_mut(frames * width)) {
            let from = &self.dataset.features(&self.dataset.entries[*e])[start * width..(start + len) * width];
            to[..from.len()].copy_from_slice(from);
            normalise(&mut to[..from.len()], &self.meta.mean, &self.meta.std);
        }
        Cuts { rows, lengths, frames }
    }

    /// Weights of the `count` places of a sequence: `1 / valid` on the first `valid`, 0 after them.
    fn weights(&self, valid: &[usize], count: usize) -> Tensor<3> {
        let weight = |n: usize| (0..count).map(move |i| if i < n { 1.0 / n as f32 } else { 0.0 });
        let values: Vec<f32> = valid.iter().flat_map(|n| weight(*n)).collect();
        Tensor::from_data(TensorData::new(values, [valid.len(), count, 1]), &self.device)
    }

    fn movement_slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let (picks, global) = self.pick(MOVEMENTS, step, slice);
        let Cuts { rows, lengths, frames } = self.cut(MOVEMENTS, &picks);
        let batch = picks.len();
        let width = self.meta.mean.len();
        let inner = self.meta.config.features;
        let rows = Tensor::<3>::from_data(TensorData::new(rows, [batch, frames, width]), &self.device);
        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let features = rows.clone().slice([0..batch, 0..frames, 0..inner]);
        let movements = self.movements.encoder.forward(features, &mut dropout);
        let made = self.movements.decoder.forward(movements.clone());
        let [_, count, latent] = movements.dims();

        let mean = |found: Tensor<3>, expected: Tensor<3>, valid: &[usize]| {
            let [_, places, channels] = found.dims();
            weighted_distance(Pointwise::L1, found, expected, self.weights(valid, places)) / channels as f32
        };
        let valid: Vec<usize> = lengths.iter().map(|len| (len / UNIT).max(1)).collect();
        let pairs: Vec<usize> = valid.iter().map(|n| (n - 1).max(1)).collect();
        let reconstruction = mean(made, rows, &lengths);
        let sparsity = mean(movements.clone(), Tensor::zeros([batch, count, latent], &self.device), &valid);
        let at = |from: usize| movements.clone().slice([0..batch, from..from + count - 1, 0..latent]);
        let smoothness = mean(at(1), at(0), &pairs);
        let phase = &self.settings.movement;
        let loss = reconstruction.clone() + sparsity * phase.sparsity + smoothness * phase.smoothness;

        let reconstruction = reconstruction.inner().into_scalar::<f32>() / global as f32;
        let loss = loss / global as f32;
        let value = loss.clone().inner().into_scalar::<f32>();
        Ok(SliceResult {
            gradients: vec![Vec::new(), Vec::new(), flat::gradient(&self.movements, loss)],
            terms: vec![value, reconstruction, 0.0, 0.0],
            ..SliceResult::default()
        })
    }

    fn matching_slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let local = step - self.turning_point();
        let (picks, global) = self.pick(MATCHING, local, slice);
        let Cuts { rows, lengths, frames } = self.cut(MATCHING, &picks);
        let batch = picks.len();
        let width = self.meta.mean.len();
        let inner = self.meta.config.features;
        let captions: Vec<&motion::dataset::Caption> = picks
            .iter()
            .map(|pick| {
                let all = &self.dataset.entries[self.train[pick.example]].captions;
                &self.dataset.captions[all[self.draw("caption", MATCHING, *pick).below(all.len())]]
            })
            .collect();
        let apart = apart(&captions.iter().map(|c| c.text.as_str()).collect::<Vec<_>>());
        let CaptionBatch { words, classes, lengths: said } = self.words.batch(captions);

        let rows = Tensor::<3>::from_data(TensorData::new(rows, [batch, frames, width]), &self.device);
        let movements = self.frozen.forward(rows.slice([0..batch, 0..frames, 0..inner]), &mut Dropout::off());
        let valid: Vec<usize> = lengths.iter().map(|len| len / UNIT).collect();
        let motion = self.motion.forward(movements, &valid);
        let words = Tensor::<3>::from_data(TensorData::new(words, [batch, WORDS, WORD_WIDTH]), &self.device);
        let classes = Tensor::<3>::from_data(TensorData::new(classes, [batch, WORDS, CLASSES]), &self.device);
        let text = self.text.forward(words, classes, &said);

        let size = self.meta.config.embedding;
        let off = text.reshape([batch, 1, size]) - motion.reshape([1, batch, size]) + NEAR;
        let squared = (off.clone() * off).sum_dim(2).reshape([batch, batch]);
        let grid = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [batch, batch]), &self.device);
        let own = (0..batch * batch).map(|i| if i % (batch + 1) == 0 { 1.0 } else { 0.0 }).collect();
        let positive = (squared.clone() * grid(own)).sum();
        let near = (squared.sqrt() * -1.0 + self.settings.margin).clamp_min(0.0);
        let negative = (near.clone() * near * grid(apart)).sum();
        let part = |x: &Tensor<1>| x.clone().inner().into_scalar::<f32>() / global as f32;
        let close = part(&positive);
        let far = part(&negative);

        let loss = (positive + negative) / global as f32;
        let value = loss.clone().inner().into_scalar::<f32>();
        let mut gradients = loss.backward();
        let text_flat = flat::take_gradients(&self.text, &mut gradients);
        let motion_flat = flat::take_gradients(&self.motion, &mut gradients);
        Ok(SliceResult {
            gradients: vec![text_flat, motion_flat, Vec::new()],
            terms: vec![value, 0.0, close, far],
            ..SliceResult::default()
        })
    }

    /// Publishes the two encoders and the movement encoder that they read; the decoder served only its training.
    fn publish(&self, state: &TrainState, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let blank = Evaluator::new(&self.meta.config, &mut Init::blank(&self.device.clone().inner()));
        let encoder = self.frozen.num_params();
        let mut weights = state.result(0).to_vec();
        weights.extend_from_slice(state.result(1));
        weights.extend_from_slice(&state.result(2)[..encoder]);
        let trained = (&flat::layout(&blank)[..], &weights[..]);
        evaluator::publish(cx, &self.meta, trained, &self.words)
    }
}

fn turning_point(settings: &TrainEvaluator) -> u64 {
    (settings.training.steps.0 as f64 * settings.movement.until).round() as u64
}

/// For each caption, the weights of the motions to be separated from it: equal, summing to 1, and 0 for its own motion
/// and for motions with the same sentence.
fn apart(sentences: &[&str]) -> Vec<f32> {
    let row = |own: &&str| {
        let others = sentences.iter().filter(|other| other != &own).count().max(1) as f32;
        sentences.iter().map(|other| if other == own { 0.0 } else { 1.0 / others }).collect::<Vec<_>>()
    };
    sentences.iter().flat_map(row).collect()
}

impl Objective for EvaluatorObjective {
    fn groups(&mut self) -> Vec<GroupPlan> {
        let turn = self.turning_point();
        let training = &self.settings.training;
        let ema = self.settings.ema;
        let steps = training.steps.0;
        let movements = Turns::during(0..turn);
        let matching = Turns::during(turn..steps);
        vec![
            group("text", &self.text, training, ema).taking(matching.clone(), steps),
            group("motion", &self.motion, training, ema).taking(matching, steps),
            group("movements", &self.movements, training, ema).taking(movements, steps),
        ]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec!["loss", "reconstruction", "positive", "negative"]
    }

    fn load(&mut self, state: &TrainState) {
        if state.step < self.turning_point() {
            return state.groups[2].trained().assign(&mut self.movements);
        }
        state.groups[0].trained().assign(&mut self.text);
        state.groups[1].trained().assign(&mut self.motion);
        // The average, if one is kept: the evaluator will have its weights.
        state.groups[2].averaged().assign_first(&mut self.frozen);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        if step < self.turning_point() { self.movement_slice(step, slice) } else { self.matching_slice(step, slice) }
    }
}

/// Refuses a phase without a step.
fn check_phases(settings: &TrainEvaluator) -> Result<(), StageError> {
    let steps = settings.training.steps.0;
    let turn = turning_point(settings);
    if 0 < turn && turn < steps {
        return Ok(());
    }
    Err(StageError::Input(format!(
        "`movement.until` assigns {turn} of {steps} steps to the movement phase; each of the two phases needs at least \
         one"
    )))
}

impl Gang for TrainEvaluator {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let dataset = artifacts::input_dataset(cx)?;
        let train_entries = dataset.entries_of(Split::Train);
        let stage = cx.task().name.clone();
        if train_entries.is_empty() {
            return Err(no_clips());
        }
        check_phases(self)?;
        let words = external::read(cx, |_, given| Words::open(given.get("words")))?;
        let meta = EvaluatorMeta {
            format: dataset.format,
            config: evaluator::config(&self.network, dataset.skeleton()),
            mean: dataset.mean.clone(),
            std: dataset.biased_std(self.emphasis),
            words: words.meta(),
            origin: "trained".into(),
        };
        let seed = cx.task().seed;
        let device = cx.device().autodiff();
        let plain = cx.device();
        let purpose = stage.to_string();
        let draws = |what: &str| format!("{purpose}/init {what}");
        let fresh = |purpose: &str| Init::new(seed, purpose, Positions::Uniform, &device);
        let mut start = WarmStart::find(cx, ArtifactKind::Evaluator)?;
        let encoder = MovementEncoder::new(&meta.config, &mut fresh(&draws("encoder")));
        let text = TextEncoder::new(&meta.config, &mut fresh(&draws("text")));
        let motion = MotionEncoder::new(&meta.config, &mut fresh(&draws("motion")));
        let encoder = start.take(encoder, "movement_encoder.")?;
        let text = start.take(text, "text_encoder.")?;
        let motion = start.take(motion, "motion_encoder.")?;
        start.finish(cx, &meta)?;
        let movements = Movements {
            encoder,
            decoder: MovementDecoder::new(&meta.config, meta.mean.len(), &mut fresh(&draws("decoder"))),
        };
        let batch = self.training.batch.global;
        let window_batch = if self.movement.batch > 0 { self.movement.batch } else { batch };
        let mut objective = EvaluatorObjective {
            settings: self.clone(),
            frozen: MovementEncoder::new(&meta.config, &mut Init::new(seed, "frozen", Positions::Uniform, &plain)),
            text,
            motion,
            movements,
            windows: Order::new(seed, &format!("{purpose}/windows"), train_entries.len(), window_batch, 1),
            clips: Order::new(seed, &format!("{purpose}/clips"), train_entries.len(), batch, 1),
            train: train_entries,
            dataset,
            words,
            purpose: purpose.clone(),
            seed,
            dropout_seed: dropout_seed(cx),
            device: plain,
            meta,
        };
        train(&mut objective, &self.training, cx)?.publish(|state| objective.publish(state, cx))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_sentence_is_not_pushed_away() {
        let weights = apart(&["a", "b", "a", "c"]);
        assert_eq!(weights[..4], [0.0, 0.5, 0.0, 0.5]);
        assert_eq!(weights[4..8], [1.0 / 3.0, 0.0, 1.0 / 3.0, 1.0 / 3.0]);
        assert_eq!(apart(&["a", "a"]), [0.0; 4]);
    }
}
