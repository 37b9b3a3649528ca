//! Examples for stages that train in the latent space: a latent drawn from its posterior, its caption, and their keyed
//! draws.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::iter::repeat_n;

use burn::tensor::{Device, Tensor, TensorData};
use models::flat::Entry;
use motion::Stream;
use motion::dataset::Split;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, Training};
use protocol::{ArtifactKind, Digest, Manifest, Seed, StageName};

use crate::artifacts::{self, DenoiserMeta, Draft, Embeddings, Latents, to_meta};
use crate::context::{AttemptContext, StageError};
use crate::generate::generator::LATENT_DIFFUSION;
use crate::parts::{self, weights};
use crate::train::network::no_clips;
use crate::train::{Order, Pick};

/// Latents and captions of the training split, in the order of a stage.
#[derive(Debug)]
pub(crate) struct LatentData {
    latents: Latents,
    embeddings: Embeddings,
    /// Entries of an epoch, each as many times as it is drawn.
    train: Vec<usize>,
    order: RefCell<Order>,
    seed: Seed,
    stage: StageName,
    slices: usize,
    device: Device,
}

/// A slice of a batch with its draws.
#[derive(Debug)]
pub(crate) struct LatentSlice {
    /// Keys of all draws.
    pub(crate) picks: Vec<Pick>,
    /// Rows of the latents, which select the entry and its crop.
    pub(crate) rows: Vec<usize>,
    /// Number of frames of each latent's motion.
    pub(crate) lengths: Vec<usize>,
    /// Latents [B, N, d], drawn from their posteriors.
    pub(crate) clean_bnd: Tensor<3>,
    /// Caption embeddings [B, 1, text].
    pub(crate) text_blc: Tensor<3>,
    /// The empty caption's embedding, repeated [B, 1, text].
    pub(crate) null_blc: Tensor<3>,
}

impl LatentData {
    /// Reads the inputs `latents` and `text`. Groups examples of similar length within `pool` batches; stages that
    /// decode no motion need only 1.
    pub(crate) fn read(cx: &dyn AttemptContext, training: &Training, pool: usize) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let (_, manifest) = artifacts::input(cx, "latents", ArtifactKind::Latents)?;
        let latents = Latents::read(&*blobs, &manifest)?;
        let (_, manifest) = artifacts::input(cx, "text", ArtifactKind::Embeddings)?;
        let embeddings = Embeddings::read(&*blobs, &manifest)?;
        let captions = latents.meta.captions.iter().flatten().max().map_or(0, |most| most + 1);
        let stage = cx.task().name.clone();
        if captions > embeddings.meta.captions {
            return Err(StageError::Input(format!(
                "`latents` refers to {captions} captions, but `text` embeds {}; use both of the same dataset",
                embeddings.meta.captions
            )));
        }
        let is_train = |e: &usize| latents.meta.splits[*e] == Split::Train;
        let times = |e: usize| latents.meta.draws.get(e).copied().unwrap_or(1);
        let train: Vec<usize> = (0..latents.entries()).filter(is_train).flat_map(|e| repeat_n(e, times(e))).collect();
        if train.is_empty() {
            return Err(no_clips());
        }
        let seed = cx.task().seed;
        let order = RefCell::new(Order::new(seed, stage.as_str(), train.len(), training.batch.global, pool));
        Ok(Self { latents, embeddings, train, order, seed, stage, slices: training.batch.slices, device: cx.device() })
    }

    /// The VAE of the latents.
    pub(crate) fn vae(&self) -> Digest {
        self.latents.meta.vae
    }

    /// Meta of the latents.
    pub(crate) fn meta(&self) -> &artifacts::LatentsMeta {
        &self.latents.meta
    }

    /// Meta of the embeddings.
    pub(crate) fn text_meta(&self) -> &artifacts::EmbeddingsMeta {
        &self.embeddings.meta
    }

    /// Manifest of the encoder that embedded the captions.
    pub(crate) fn text_encoder(&self, cx: &dyn AttemptContext) -> Result<Manifest, StageError> {
        parts::manifest(&*cx.blobs(), self.embeddings.meta.text, "the text encoder")
    }

    /// The generator for one kind of draw of one example.
    pub(crate) fn stream(&self, what: &str, pick: Pick) -> Stream {
        Stream::new(self.seed, &format!("{}/{what}", self.stage), pick.place, 0)
    }

    /// Standard normal noise [B, N, d] for one purpose.
    pub(crate) fn noise(&self, what: &str, picks: &[Pick]) -> Tensor<3> {
        let latent = self.latents.meta.latent;
        let size = latent.tokens * latent.dim;
        let mut values = vec![0.0; picks.len() * size];
        for (row, pick) in values.chunks_exact_mut(size).zip(picks) {
            self.stream(what, *pick).fill_normal(row);
        }
        Tensor::from_data(TensorData::new(values, [picks.len(), latent.tokens, latent.dim]), &self.device)
    }

    /// The whole batch of `step`.
    pub(crate) fn picks(&self, step: u64) -> Vec<Pick> {
        let mut order = self.order.borrow_mut();
        let sorted = order.is_pooled();
        order.batch(step, |pick| if sorted { self.meta().lengths[self.row(pick)] } else { 0 })
    }

    /// The row of the latents that [`slice`](Self::slice) uses for an example.
    pub(crate) fn row(&self, pick: Pick) -> usize {
        let crops = self.latents.meta.crops;
        self.train[pick.example] * crops + self.stream("example", pick).below(crops)
    }

    /// Slice `slice` of the batch of `step`. A caption is replaced by the empty one with probability `drop`.
    pub(crate) fn slice(&self, step: u64, slice: usize, drop: f64) -> LatentSlice {
        let range = self.order.borrow().slice(slice, self.slices);
        let picks: Vec<Pick> = self.picks(step)[range].to_vec();
        let latent = self.latents.meta.latent;
        let size = latent.tokens * latent.dim;
        let crops = self.latents.meta.crops;
        let mut clean = Vec::new();
        let mut text = Vec::new();
        let mut lengths = Vec::new();
        let mut rows = Vec::new();
        for pick in &picks {
            let entry = self.train[pick.example];
            let mut draw = self.stream("example", *pick);
            let row = entry * crops + draw.below(crops);
            lengths.push(self.latents.meta.lengths[row]);
            rows.push(row);
            let captions = &self.latents.meta.captions[entry];
            let caption = captions[draw.below(captions.len())];
            let empty = draw.uniform() < drop;
            let mut noise = vec![0.0; size];
            draw.fill_normal(&mut noise);
            let mu = self.latents.mu.row(row);
            let sigma = self.latents.sigma.row(row);
            clean.extend(mu.iter().zip(sigma).zip(&noise).map(|((mu, sigma), noise)| mu + sigma * noise));
            text.extend_from_slice(if empty { &self.embeddings.null } else { self.embeddings.captions.row(caption) });
        }
        let batch = picks.len();
        let width = self.embeddings.null.len();
        let tensor = |values, shape: [usize; 3]| Tensor::from_data(TensorData::new(values, shape), &self.device);
        let null = self.embeddings.null.iter().copied().cycle().take(batch * width).collect();
        LatentSlice {
            picks,
            rows,
            lengths,
            clean_bnd: tensor(clean, [batch, latent.tokens, latent.dim]),
            text_blc: tensor(text, [batch, 1, width]),
            null_blc: tensor(null, [batch, 1, width]),
        }
    }
}

/// Uploads a latent-diffusion model: the denoiser, from its meta and a flat buffer of weights, and the parts that it
/// was trained with.
pub(crate) fn publish(
    cx: &mut dyn AttemptContext,
    format: DataFormat,
    meta: &DenoiserMeta,
    (entries, values): (&[Entry], &[f32]),
    mut parts: BTreeMap<Role, Manifest>,
) -> Result<Digest, StageError> {
    let mut denoiser = Draft::new(cx, ArtifactKind::Denoiser, to_meta(meta));
    weights::add(&mut denoiser, (entries, values))?;
    parts.insert(Role::DENOISER, denoiser.into_manifest());
    parts::publish_model(cx, LATENT_DIFFUSION, format, &parts)
}
