//! A trained evaluator from its artifact: embeds captions and motions.
//!
//! Motions are in the data's own scale and are normalised with the evaluator's statistics, independently of the
//! model's. Padding is zero after normalisation. Every motion has at least one movement of padding after its end, so an
//! embedding does not depend on the batch. Source: Guo et al.'s own loader, which pads to 196 frames. Departs: a motion
//! of 196 frames is padded too.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use models::device::host;
use models::flat::Entry;
use models::names::save;
use models::networks::{Evaluator, EvaluatorConfig, Init};
use motion::Skeleton;
use motion::dataset::normalise;
use motion::dataset::{Caption, Dataset, statistics};
use protocol::stage::{DataFormat, EvaluatorNetwork};
use protocol::{ArtifactKind, Digest, Manifest};
use serde::{Deserialize, Serialize};

use super::weights;
use super::word_vectors::{CLASSES, WORD_WIDTH, WORDS, Words, WordsMeta};
use crate::artifacts::{self, Draft, to_meta, word};
use crate::context::{AttemptContext, StageError};

/// Number of frames of a movement.
pub const UNIT: usize = 4;

/// Meta of an artifact of kind `evaluator`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluatorMeta {
    /// Format of the training data.
    pub format: DataFormat,
    /// Sizes of the networks.
    pub config: EvaluatorConfig,
    /// Mean subtracted from features, `[features]`, contacts included.
    pub mean: Vec<f32>,
    /// Deviation that divides features, `[features]`.
    pub std: Vec<f32>,
    /// Meta of its word vectors.
    pub words: WordsMeta,
    /// Origin of the weights, `trained` or `imported`.
    pub origin: String,
}

/// Sizes of an evaluator for a skeleton.
pub fn config(network: &EvaluatorNetwork, skeleton: &Skeleton) -> EvaluatorConfig {
    EvaluatorConfig {
        features: skeleton.layout().contacts.start,
        movement_hidden: network.movement,
        movement: network.movement,
        motion_hidden: network.motion,
        word: WORD_WIDTH,
        classes: CLASSES,
        text_hidden: network.text,
        embedding: network.embedding,
    }
}

/// Uploads an evaluator.
pub fn publish(
    cx: &mut dyn AttemptContext,
    meta: &EvaluatorMeta,
    (entries, values): (&[Entry], &[f32]),
    words: &Words,
) -> Result<Digest, StageError> {
    let mut draft = Draft::new(cx, ArtifactKind::Evaluator, to_meta(meta));
    weights::add(&mut draft, (entries, values))?;
    words.write(&mut draft)?;
    draft.finish(cx)
}

/// A trained evaluator.
#[derive(Debug)]
pub struct TrainedEvaluator {
    network: Evaluator,
    meta: EvaluatorMeta,
    words: Words,
    device: Device,
}

impl TrainedEvaluator {
    /// Reads an artifact of kind `evaluator`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, device: &Device) -> Result<Self, StageError> {
        let meta: EvaluatorMeta = artifacts::meta(manifest, "the evaluator")?;
        let words = Words::read(blobs, manifest, &meta.words)?;
        let device = device.clone().inner();
        let fresh = Evaluator::new(&meta.config, &mut Init::blank(&device));
        let network = weights::load(fresh, blobs, manifest, "the evaluator's weights")?;
        Ok(Self { network, meta, words, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &EvaluatorMeta {
        &self.meta
    }

    /// Width of an embedding.
    pub fn width(&self) -> usize {
        self.meta.config.embedding
    }

    /// The weights under the published names.
    pub fn weights(&self) -> Vec<u8> {
        save(&self.network)
    }

    /// Embeds captions as `[captions, width]`.
    pub fn captions<'a>(&self, captions: impl IntoIterator<Item = &'a Caption>) -> Vec<f32> {
        let batch = self.words.batch(captions);
        let count = batch.lengths.len();
        let words = Tensor::<3>::from_data(TensorData::new(batch.words, [count, WORDS, WORD_WIDTH]), &self.device);
        let classes = Tensor::<3>::from_data(TensorData::new(batch.classes, [count, WORDS, CLASSES]), &self.device);
        host(self.network.text_encoder.forward(words, classes, &batch.lengths))
    }

    /// Embeds motions as `[motions, width]`; each motion is `[frames, features]` in the data's own scale.
    pub fn motions(&self, motions: &[Vec<f32>]) -> Vec<f32> {
        let width = self.meta.mean.len();
        let lengths: Vec<usize> = motions.iter().map(|m| m.len() / width).collect();
        let frames = lengths.iter().max().map_or(0, |most| most / UNIT * UNIT + UNIT);
        let mut rows = vec![0.0; motions.len() * frames * width];
        for (motion, to) in motions.iter().zip(rows.chunks_exact_mut((frames * width).max(1))) {
            let keep = motion.len().min(to.len());
            to[..keep].copy_from_slice(&motion[..keep]);
            normalise(&mut to[..keep], &self.meta.mean, &self.meta.std);
        }
        let rows = Tensor::<3>::from_data(TensorData::new(rows, [motions.len(), frames, width]), &self.device);
        host(self.network.motion(rows, &lengths))
    }

    /// Embeds motions [B, T, F] normalised with `mean` and `std` as [B, width]; the first `lengths[b]` frames are
    /// valid. Gradients flow to the motions, not to the evaluator. Otherwise as [`motions`](Self::motions).
    pub fn embed_normalised(&self, x_btf: Tensor<3>, lengths: &[usize], mean: &[f32], std: &[f32]) -> Tensor<2> {
        let [batch, have, width] = x_btf.dims();
        let device = x_btf.device();
        let row = |value: &dyn Fn(usize) -> f32| {
            Tensor::<3>::from_data(TensorData::new((0..width).map(value).collect::<Vec<_>>(), [1, 1, width]), &device)
        };
        let own = &self.meta;
        let scale = row(&|i| std[i] / own.std[i]);
        let shift = row(&|i| (mean[i] - own.mean[i]) / own.std[i]);
        let frames = lengths.iter().max().map_or(0, |most| most / UNIT * UNIT + UNIT);
        let x = x_btf * scale + shift;
        let x = match frames.checked_sub(have) {
            Some(more) if more > 0 => Tensor::cat(vec![x, Tensor::zeros([batch, more, width], &device)], 1),
            _ => x.slice([0..batch, 0..frames, 0..width]),
        };
        let live = lengths.iter().flat_map(|l| (0..frames).map(move |t| if t < *l { 1.0_f32 } else { 0.0 })).collect();
        self.network.motion(x * Tensor::<3>::from_data(TensorData::new(live, [batch, frames, 1]), &device), lengths)
    }

    /// Refuses data with another skeleton than the evaluator's, or with features on another scale.
    ///
    /// The scale is estimated from the deviations of positions, rotations and velocities, and the distance of their
    /// means. Another body of motion changes these little. Metres in place of millimetres, or features normalised
    /// before, change them greatly.
    pub fn check(&self, dataset: &Dataset, entries: &[usize]) -> Result<(), StageError> {
        let ours = self.meta.format;
        if dataset.format != ours {
            return Err(StageError::Input(format!(
                "the evaluator expects `{}` skeletons ({} features), but the dataset has `{}` ({}); train an evaluator \
                 on this data, or import the one published for it",
                word(&ours),
                self.meta.mean.len(),
                word(&dataset.format),
                dataset.mean.len()
            )));
        }
        let clips: Vec<&[f32]> = entries.iter().map(|e| dataset.features(&dataset.entries[*e])).collect();
        let (mean, std) = statistics(dataset.skeleton(), clips.iter().copied());
        let layout = dataset.skeleton().layout();
        for (what, group) in
            [("positions", layout.positions), ("rotations", layout.rotations), ("velocities", layout.velocities)]
        {
            let n = group.len() as f64;
            let own = |i: usize| f64::from(self.meta.std[i]);
            let ratio = group.clone().map(|i| (std[i].max(1e-9) / own(i)).ln()).sum::<f64>() / n;
            let shift =
                (group.map(|i| ((mean[i] - f64::from(self.meta.mean[i])) / own(i)).powi(2)).sum::<f64>() / n).sqrt();
            if ratio.abs() > MOST_RATIO.ln() || shift > MOST_SHIFT {
                return Err(StageError::Input(format!(
                    "the features do not have the evaluator's scale: the standard deviation of their {what} is {:.3} \
                     times the evaluator's, and their mean differs by {shift:.2} deviations (expected at most \
                     {MOST_RATIO} times and {MOST_SHIFT}); use features that are not normalised and have the \
                     evaluator's unit, or train an evaluator on this data",
                    ratio.exp()
                )));
            }
        }
        Ok(())
    }
}

/// Largest allowed ratio between the deviations of the features and those of the evaluator's training data.
const MOST_RATIO: f64 = 4.0;
/// Largest allowed distance of their means, in deviations.
const MOST_SHIFT: f64 = 2.5;
