//! Examples of the stages that diffuse motion itself: a clip's frames, its caption, and keyed draws about it.

use std::cell::RefCell;

use burn::tensor::{Device, Tensor, TensorData};
use motion::Stream;
use motion::dataset::{Dataset, crop};
use protocol::stage::{Split, Training};
use protocol::{ArtifactKind, Manifest, Seed, StageName};

use super::no_clips;
use crate::artifacts::{self, Embeddings, EmbeddingsMeta};
use crate::context::{AttemptContext, StageError};
use crate::evaluator::normalise;
use crate::motion_networks::CaptionRows;
use crate::parts;
use crate::text::{self, TextEncoder};
use crate::train::{Order, Pick};

/// Batches that are sorted by length together, where padding is to be little.
const POOL: usize = 4;

/// Which frames of a clip are an example.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cut {
    /// A multiple of the unit length, the longest or one unit less: MDM.
    Jittered,
    /// All: StableMoFusion.
    Whole,
}

/// What captions become.
#[derive(Debug)]
enum Words {
    /// One vector each, embedded before.
    Vectors(Embeddings),
    /// Tokens, embedded where they are needed.
    Tokens(Box<dyn TextEncoder>),
}

/// How examples are made.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rules {
    pub(super) cut: Cut,
    /// Whether a caption is its tokens.
    pub(super) tokens: bool,
    /// Whether every example is padded to `max_frames`.
    pub(super) whole: bool,
    pub(super) max_frames: usize,
    /// What the deviations of root and contacts are divided by.
    pub(super) bias: f64,
}

/// Clips and captions of the training split, in the order of a stage.
#[derive(Debug)]
pub(super) struct FeatureData {
    dataset: Dataset,
    words: Words,
    text_meta: EmbeddingsMeta,
    train: Vec<usize>,
    std: Vec<f32>,
    rules: Rules,
    order: RefCell<Order>,
    seed: Seed,
    stage: StageName,
    slices: usize,
    device: Device,
}

/// One slice of a batch.
#[derive(Debug)]
pub(super) struct FeatureSlice {
    /// Frames of each motion.
    pub(super) lengths: Vec<usize>,
    /// Motions [B, T, F], normalised, with zeros behind their ends.
    pub(super) clean_btf: Tensor<3>,
    /// Standard normal noise [B, T, F].
    pub(super) noise_btf: Tensor<3>,
    /// Captions.
    pub(super) captions: CaptionRows,
    /// A timestep each.
    pub(super) timesteps: Vec<usize>,
    /// Those of the whole batch.
    pub(super) batch_timesteps: Vec<usize>,
}

impl FeatureData {
    /// Reads the inputs `dataset` and `text`.
    pub(super) fn read(cx: &dyn AttemptContext, training: &Training, rules: Rules) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let dataset = artifacts::dataset(&*blobs, &manifest)?;
        let (_, manifest) = artifacts::input(cx, "text", ArtifactKind::Embeddings)?;
        let text_meta: EmbeddingsMeta = artifacts::meta(&manifest, "the caption embeddings")?;
        if text_meta.captions != dataset.captions.len() {
            return Err(StageError::Input(format!(
                "`text` embeds {} captions, `dataset` has {}; both must come from one dataset",
                text_meta.captions,
                dataset.captions.len()
            )));
        }
        let words = if rules.tokens {
            let encoder = parts::manifest(&*blobs, text_meta.text, "the text encoder")?;
            Words::Tokens(text::open(&encoder, &*blobs, &cx.device())?)
        } else {
            Words::Vectors(Embeddings::read(&*blobs, &manifest)?)
        };
        let train = dataset.entries_of(Split::Train);
        if train.is_empty() {
            return Err(no_clips());
        }
        let layout = dataset.skeleton().layout();
        let biased = |i: usize| i < layout.positions.start || layout.contacts.contains(&i);
        let std = dataset.std.iter().enumerate().map(|(i, std)| match biased(i) {
            true => *std / rules.bias as f32,
            false => *std,
        });
        let (seed, stage, global) = (cx.task().seed, cx.task().name.clone(), training.batch.global);
        let pool = if rules.whole { 1 } else { POOL };
        Ok(Self {
            std: std.collect(),
            order: RefCell::new(Order::new(seed, stage.as_str(), train.len(), global, pool)),
            dataset,
            words,
            text_meta,
            train,
            rules,
            seed,
            stage,
            slices: training.batch.slices,
            device: cx.device(),
        })
    }

    /// The data.
    pub(super) fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// What features are divided by, `[features]`.
    pub(super) fn std(&self) -> &[f32] {
        &self.std
    }

    /// Width of a caption's vector, or of its tokens.
    pub(super) fn text_dim(&self) -> usize {
        match &self.words {
            Words::Vectors(_) => self.text_meta.dim,
            Words::Tokens(encoder) => encoder.token_dim(),
        }
    }

    /// The encoder that embeds the captions.
    pub(super) fn text_encoder(&self, cx: &dyn AttemptContext) -> Result<Manifest, StageError> {
        parts::manifest(&*cx.blobs(), self.text_meta.text, "the text encoder")
    }

    fn stream(&self, what: &str, pick: Pick) -> Stream {
        Stream::new(self.seed, &format!("{}/{what}", self.stage), pick.place, 0)
    }

    /// First frame and frames of the example at a place.
    fn cut(&self, pick: Pick) -> (usize, usize) {
        let entry = &self.dataset.entries[self.train[pick.example]];
        let mut draw = self.stream("crop", pick);
        let (start, len) = match self.rules.cut {
            Cut::Jittered => crop(&mut draw, entry.len, self.dataset.skeleton()),
            Cut::Whole => (0, entry.len),
        };
        match len.checked_sub(self.rules.max_frames) {
            Some(rest) if rest > 0 => (start + draw.below(rest + 1), self.rules.max_frames),
            _ => (start, len),
        }
    }

    /// Slice `slice` of the batch of `step`, at timesteps below `timesteps`. With probability `drop` a caption is left out.
    pub(super) fn slice(
        &self,
        step: u64,
        slice: usize,
        timesteps: usize,
        drop: f64,
    ) -> Result<FeatureSlice, StageError> {
        // Where every example is padded alike, there is nothing to sort by.
        let length = |pick: Pick| if self.rules.whole { 0 } else { self.cut(pick).1 };
        let batch = self.order.borrow_mut().batch(step, length);
        let range = self.order.borrow().slice(slice, self.slices);
        let timestep = |pick: &Pick| self.stream("timestep", *pick).below(timesteps);
        let batch_timesteps: Vec<usize> = batch.iter().map(timestep).collect();
        let picks = &batch[range.clone()];
        let cuts: Vec<(usize, usize)> = picks.iter().map(|pick| self.cut(*pick)).collect();
        let lengths: Vec<usize> = cuts.iter().map(|(_, len)| *len).collect();
        let longest = *lengths.iter().max().expect("no empty slice");
        let frames = if self.rules.whole { self.rules.max_frames } else { longest };
        let width = self.std.len();
        let (mut rows, mut noise) = (vec![0.0; picks.len() * frames * width], vec![0.0; picks.len() * frames * width]);
        let mut captions = CaptionRows { rows: Vec::new(), kept: Vec::new() };
        for (b, (pick, (start, len))) in picks.iter().zip(&cuts).enumerate() {
            let entry = &self.dataset.entries[self.train[pick.example]];
            let at = b * frames * width;
            let to = &mut rows[at..at + len * width];
            to.copy_from_slice(&self.dataset.features(entry)[start * width..(start + len) * width]);
            normalise(to, &self.dataset.mean, &self.std);
            // Of padding too; how much there is of it depends on the slice, whose frames come first.
            self.stream("noise", *pick).fill_normal(&mut noise[at..at + frames * width]);
            let mut draw = self.stream("example", *pick);
            let caption = entry.captions[draw.below(entry.captions.len())];
            captions.kept.push(draw.uniform() >= drop);
            captions.rows.push(self.caption(caption)?);
        }
        let tensor = |values| Tensor::from_data(TensorData::new(values, [picks.len(), frames, width]), &self.device);
        Ok(FeatureSlice {
            lengths,
            clean_btf: tensor(rows),
            noise_btf: tensor(noise),
            captions,
            timesteps: batch_timesteps[range].to_vec(),
            batch_timesteps,
        })
    }

    /// A caption by number, as the network reads it.
    fn caption(&self, number: usize) -> Result<Vec<f32>, StageError> {
        match &self.words {
            Words::Vectors(embeddings) => Ok(embeddings.captions.row(number).to_vec()),
            Words::Tokens(encoder) => {
                let tokens = encoder.tokens(&[&self.dataset.captions[number].text])?;
                tokens.into_iter().next().ok_or_else(|| StageError::Fault("the encoder gave no caption".into()))
            }
        }
    }
}
