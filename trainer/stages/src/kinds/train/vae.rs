//! `train.vae`: the motion VAE. Source: MLD (arXiv:2212.04048) and MotionLCM v2: smooth L1 on normalised features and
//! on joints in metres, KL as a mean over all elements.
//!
//! Ours: an optional first phase on short windows, terms on the speed of feet and on derivatives of all joints, changed paths, and batches of similar
//! length. Terms on joints and feet may start later. The unmasked loss of v1 counts padding up to the longest clip of a
//! slice, not of the batch.

use std::iter::repeat_n;

use burn::tensor::{Device, Tensor, TensorData};
use models::kernels::Dropout;
use models::losses::{self, Body, VaeRecipe};
use models::networks::{Init, Vae};
use motion::dataset::{Dataset, crop, window};
use motion::{Stream, paths};
use protocol::stage::{Split, StageSpec, TrainVae};
use protocol::{ArtifactKind, Seed};

use crate::artifacts::{self, VaeMeta, to_meta};
use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::warm_start::WarmStart;
use crate::parts::weights;
use crate::train::network::{dropout_seed, group, no_clips, slice_result};
use crate::train::{GroupPlan, Losses, Objective, Order, Pick, SliceResult, TrainState, train};

/// Number of batches that are sorted by length together.
const POOL: usize = 4;

struct VaeObjective {
    settings: TrainVae,
    dataset: Dataset,
    /// Entries of an epoch, each as many times as it is drawn.
    train: Vec<usize>,
    network: Vae,
    windows: Order,
    clips: Order,
    purpose: String,
    seed: Seed,
    dropout_seed: u64,
    body: Body,
    device: Device,
}

impl VaeObjective {
    /// Number of steps that train on windows.
    fn window_steps(&self) -> u64 {
        self.share(self.settings.windows.until)
    }

    fn share(&self, part: f64) -> u64 {
        (self.settings.training.steps.0 as f64 * part).round() as u64
    }

    /// Frames `start..start + len` of the clip at a place.
    fn cut(&self, phase: u64, pick: Pick) -> (usize, usize) {
        let entry = &self.dataset.entries[self.train[pick.example]];
        let mut draw = Stream::new(self.seed, &format!("{}/crop", self.purpose), pick.place, phase);
        let skeleton = self.dataset.skeleton();
        if phase == 0 {
            let windows = &self.settings.windows;
            window(&mut draw, windows.min, windows.max, entry.len, skeleton)
        } else {
            crop(&mut draw, entry.len, skeleton)
        }
    }

    /// The phase, the slice's places, and the number of examples in its batch.
    fn pick(&mut self, step: u64, slice: usize) -> (u64, Vec<Pick>, usize) {
        let (phase, local) = match step.checked_sub(self.window_steps()) {
            None => (0, step),
            Some(local) => (1, local),
        };
        let empty = || Order::new(Seed(0), "", 1, 1, 1);
        let mut order = std::mem::replace(if phase == 0 { &mut self.windows } else { &mut self.clips }, empty());
        let batch = order.batch(local, |pick| self.cut(phase, pick).1);
        let range = order.slice(slice, self.settings.training.batch.slices);
        *(if phase == 0 { &mut self.windows } else { &mut self.clips }) = order;
        (phase, batch[range].to_vec(), batch.len())
    }
}

impl Objective for VaeObjective {
    fn groups(&mut self) -> Vec<GroupPlan> {
        vec![group("model", &self.network, &self.settings.training, self.settings.ema)]
    }

    fn terms(&self) -> Vec<&'static str> {
        self.settings.recorded().to_vec()
    }

    fn load(&mut self, state: &TrainState) {
        state.groups[0].trained().assign(&mut self.network);
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let (phase, picks, global) = self.pick(step, slice);
        let cuts: Vec<(usize, usize)> = picks.iter().map(|pick| self.cut(phase, *pick)).collect();
        let lengths: Vec<usize> = cuts.iter().map(|(_, len)| *len).collect();
        let (batch, frames, width) =
            (picks.len(), *lengths.iter().max().expect("no empty slice"), self.dataset.mean.len());
        let latent = self.settings.latent;
        let mut rows = vec![0.0; batch * frames * width];
        let mut noise = vec![0.0; batch * latent.tokens * latent.dim];
        for (b, (pick, (start, len))) in picks.iter().zip(&cuts).enumerate() {
            let entry = &self.dataset.entries[self.train[pick.example]];
            let from = &self.dataset.features(entry)[start * width..(start + len) * width];
            let to = &mut rows[b * frames * width..][..len * width];
            to.copy_from_slice(from);
            let mut draw = Stream::new(self.seed, &format!("{}/path", self.purpose), pick.place, phase);
            paths::augment(to, self.dataset.skeleton(), &self.settings.augment, &mut draw);
            self.dataset.normalise(to);
            let size = latent.tokens * latent.dim;
            let mut draw = Stream::new(self.seed, &format!("{}/noise", self.purpose), pick.place, phase);
            draw.fill_normal(&mut noise[b * size..(b + 1) * size]);
        }
        let rows = Tensor::<3>::from_data(TensorData::new(rows, [batch, frames, width]), &self.device);
        let noise = Tensor::from_data(TensorData::new(noise, [batch, latent.tokens, latent.dim]), &self.device);

        let mut dropout = Dropout::new(self.settings.network.dropout, self.dropout_seed, step, slice as u64);
        let posterior = self.network.encode(rows.clone(), &lengths, &mut dropout);
        let decoded = self.network.decode(posterior.sample(noise), &lengths, frames, &mut dropout);

        // Early in training the root drift dominates the posture; the terms on joints may start later.
        let mut recipe = VaeRecipe::from(self.settings.loss.clone());
        if step < self.share(self.settings.loss.joint_from) {
            recipe.weights = recipe.weights.without_joints();
        }
        let terms = losses::vae(&recipe, &self.body, decoded, rows, &posterior, &lengths);
        let mut losses = Losses::new(global);
        for (name, term) in terms.named() {
            if let Some(term) = term {
                // The weight is already applied.
                losses.add(name, term, 1.0);
            }
        }
        slice_result(&self.network, &losses, &self.terms())
    }
}

impl Gang for TrainVae {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let dataset = artifacts::input_dataset(cx)?;
        let draws = dataset.draws(self.balance);
        let train_entries: Vec<usize> =
            dataset.entries_of(Split::Train).into_iter().flat_map(|e| repeat_n(e, draws[e])).collect();
        let stage = cx.task().name.clone();
        if train_entries.is_empty() {
            return Err(no_clips());
        }
        let meta = VaeMeta {
            format: dataset.format,
            features: dataset.mean.len(),
            latent: self.latent,
            network: self.network.clone(),
            mean: dataset.mean.clone(),
            std: dataset.std.clone(),
            projection: None,
        };
        let seed = cx.task().seed;
        let device = cx.device().autodiff();
        let purpose = stage.to_string();
        let mut init = Init::new(seed, &format!("{purpose}/init"), self.network.positions, &device);
        let network = WarmStart::begin(cx, ArtifactKind::Vae, Vae::new(&meta.config(), &mut init), &meta)?;
        let batch = self.training.batch.global;
        let window_batch = if self.windows.batch > 0 { self.windows.batch } else { batch };
        let mut objective = VaeObjective {
            settings: self.clone(),
            windows: Order::new(seed, &format!("{purpose}/windows"), train_entries.len(), window_batch, POOL),
            clips: Order::new(seed, &format!("{purpose}/clips"), train_entries.len(), batch, POOL),
            body: Body::new(dataset.skeleton(), &dataset.mean, &dataset.std, &cx.device()),
            train: train_entries,
            dataset,
            network,
            purpose,
            seed,
            dropout_seed: dropout_seed(cx),
            device: cx.device(),
        };
        train(&mut objective, &self.training, cx)?
            .publish(|state| weights::publish(cx, ArtifactKind::Vae, to_meta(&meta), state.trained(0)))
    }
}
