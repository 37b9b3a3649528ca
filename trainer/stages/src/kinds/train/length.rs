//! `train.length`: predicts the length of a caption's motion. Source: MoMask's length estimator (Guo et al., CVPR
//! 2024).
//!
//! A class is a movement of four frames. The loss is the cross-entropy against `frames / 4`, with one of the clip's
//! captions drawn in each step.
//!
//! Departs: every entry has its whole length, where the original sometimes shortens it by a movement. A drawn length is
//! at least one movement.

use burn::tensor::activation::softmax;
use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::model::Parts;
use models::kernels::Dropout;
use models::networks::{Init, LengthEstimator};
use motion::Stream;
use motion::dataset::Dataset;
use protocol::artifact::Role;
use protocol::stage::{Positions, Split, TrainLength};
use protocol::{ArtifactKind, Seed};

use crate::artifacts::{self, Embeddings, to_meta};
use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::length::LengthMeta;
use crate::parts::warm_start::WarmStart;
use crate::parts::weights;
use crate::train::network::{dropout_seed, group, no_clips, slice_result};
use crate::train::{GroupPlan, Losses, Objective, Order, SliceResult, TrainState, train};

/// Name of the distance in frames between the mean of the predicted lengths and the true one.
const OFF: &str = "frames_off";

struct Lengths {
    settings: TrainLength,
    dataset: Dataset,
    embeddings: Embeddings,
    train: Vec<usize>,
    order: Order,
    network: LengthEstimator,
    seed: Seed,
    purpose: String,
    dropout_seed: u64,
    device: Device,
}

impl Objective for Lengths {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![group("model", &self.network, &self.settings.training, 0.0)]
    }

    fn terms(&self) -> Vec<&'static str> {
        vec![Losses::TOTAL, OFF]
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.network);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let batch = self.settings.training.batch;
        let range = self.order.slice(slice, batch.slices);
        let picks = self.order.batch(step, |_| 0)[range].to_vec();
        let mut text = Vec::new();
        let mut frames = Vec::new();
        for pick in &picks {
            let entry = &self.dataset.entries[self.train[pick.example]];
            let mut draw = Stream::new(self.seed, &format!("{}/caption", self.purpose), pick.place, 0);
            let caption = entry.captions[draw.below(entry.captions.len())];
            text.extend_from_slice(self.embeddings.captions.row(caption));
            frames.push(entry.len);
        }
        let shape = [picks.len(), self.embeddings.null.len()];
        let text = Tensor::<2>::from_data(TensorData::new(text, shape), &self.device);
        let mut dropout = Dropout::new(self.settings.dropout, self.dropout_seed, step, slice as u64);
        let logits = self.network.forward(text, &mut dropout);
        let probabilities = softmax(logits.clone().inner(), 1).into_data();
        let probabilities = probabilities.as_slice::<f32>().map_err(|e| StageError::Fault(format!("{e:?}")))?;
        let mean = |row: &[f32]| -> f32 { row.iter().enumerate().map(|(class, p)| class as f32 * p).sum() };
        let rows = probabilities.chunks_exact(LengthEstimator::CLASSES);
        let off =
            rows.zip(&frames).map(|(row, frames)| (mean(row) * LengthEstimator::UNIT as f32 - *frames as f32).abs());
        let off = off.sum::<f32>() / batch.global as f32;
        let classes: Vec<usize> =
            frames.iter().map(|frames| LengthEstimator::class(*frames, LengthEstimator::CLASSES)).collect();
        let mut losses = Losses::new(batch.global);
        losses.add("cross-entropy", LengthEstimator::loss(logits, &classes), 1.0);
        losses.note(OFF, off);
        slice_result(&self.network, &losses, &self.terms())
    }
}

impl Gang for TrainLength {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let dataset = artifacts::input_dataset(cx)?;
        let (_, manifest) = artifacts::input(cx, "text", ArtifactKind::Embeddings)?;
        let embeddings = Embeddings::read(&*blobs, &manifest)?;
        if dataset.captions.len() != embeddings.meta.captions {
            return Err(StageError::Input(format!(
                "`dataset` has {} captions, but `text` embeds {}; use embeddings of the same dataset",
                dataset.captions.len(),
                embeddings.meta.captions
            )));
        }
        let train_entries = dataset.entries_of(Split::Train);
        if train_entries.is_empty() {
            return Err(no_clips());
        }
        let meta = LengthMeta {
            format: dataset.format,
            fits: Parts::from([(Role::TEXT, embeddings.meta.text)]),
            text_dim: embeddings.meta.dim,
            classes: LengthEstimator::CLASSES,
            unit: LengthEstimator::UNIT,
        };
        let seed = cx.task().seed;
        let purpose = cx.task().name.to_string();
        let tracked = cx.device().autodiff();
        let mut init = Init::new(seed, &format!("{purpose}/init"), Positions::Uniform, &tracked);
        let network = WarmStart::begin(
            cx,
            ArtifactKind::Length,
            LengthEstimator::new(meta.text_dim, meta.classes, &mut init),
            &meta,
        )?;
        let mut objective = Lengths {
            settings: self.clone(),
            network,
            order: Order::new(seed, &purpose, train_entries.len(), self.training.batch.global, 1),
            train: train_entries,
            dataset,
            embeddings,
            seed,
            purpose,
            dropout_seed: dropout_seed(cx),
            device: cx.device(),
        };
        train(&mut objective, &self.training, cx)?
            .publish(|state| weights::publish(cx, ArtifactKind::Length, to_meta(&meta), state.trained(0)))
    }
}
