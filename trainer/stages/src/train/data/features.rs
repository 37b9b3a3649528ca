//! Examples for stages that diffuse motion itself: a clip's frames, its caption, and their keyed draws.

use std::cell::RefCell;

use burn::tensor::{Device, Tensor, TensorData};
use motion::Stream;
use motion::dataset::normalise;
use motion::dataset::{Dataset, crop};
use protocol::stage::{Split, Training};
use protocol::{ArtifactKind, Manifest, Seed, StageName};

use crate::artifacts::{self, Embeddings, EmbeddingsMeta};
use crate::context::{AttemptContext, StageError};
use crate::parts;
use crate::parts::motion_networks::CaptionRows;
use crate::parts::text::{self, TextEncoder};
use crate::train::network::no_clips;
use crate::train::{Order, Pick};

/// Batches that are sorted by length together, to reduce padding.
const POOL: usize = 4;

/// Selection of an example's frames from a clip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cut {
    /// A multiple of the unit length, the longest one or one unit less: MDM.
    Jittered,
    /// The whole clip: StableMoFusion.
    Whole,
}

/// Form of the captions.
#[derive(Debug)]
enum Words {
    /// One vector per caption, embedded earlier.
    Vectors(Embeddings),
    /// The tokens of a caption, embedded on demand.
    Tokens(Box<dyn TextEncoder>),
}

/// Rules for making examples.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rules {
    pub(crate) cut: Cut,
    /// Captions are sequences of tokens.
    pub(crate) tokens: bool,
    /// Every example is padded to `max_frames`.
    pub(crate) whole: bool,
    pub(crate) max_frames: usize,
    /// Divisor of the deviations of root and contacts.
    pub(crate) bias: f64,
}

/// Clips and captions of the training split, in the order of a stage.
#[derive(Debug)]
pub(crate) struct FeatureData {
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

/// A slice of a batch with its draws.
#[derive(Debug)]
pub(crate) struct FeatureSlice {
    /// Number of frames of each motion.
    pub(crate) lengths: Vec<usize>,
    /// Motions [B, T, F], normalised, with zeros past their ends.
    pub(crate) clean_btf: Tensor<3>,
    /// Standard normal noise [B, T, F].
    pub(crate) noise_btf: Tensor<3>,
    pub(crate) captions: CaptionRows,
    /// Timestep of each motion.
    pub(crate) timesteps: Vec<usize>,
    /// Timesteps of the whole batch.
    pub(crate) batch_timesteps: Vec<usize>,
}

impl FeatureData {
    /// Reads the inputs `dataset` and `text`.
    pub(crate) fn read(cx: &dyn AttemptContext, training: &Training, rules: Rules) -> Result<Self, StageError> {
        let blobs = cx.blobs();
        let dataset = artifacts::input_dataset(cx)?;
        let (_, manifest) = artifacts::input(cx, "text", ArtifactKind::Embeddings)?;
        let text_meta: EmbeddingsMeta = artifacts::meta(&manifest, "the caption embeddings")?;
        if text_meta.captions != dataset.captions.len() {
            return Err(StageError::Input(format!(
                "`text` embeds {} captions, but `dataset` has {}; use embeddings of the same dataset",
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
        let seed = cx.task().seed;
        let stage = cx.task().name.clone();
        let global = training.batch.global;
        let pool = if rules.whole { 1 } else { POOL };
        Ok(Self {
            std: dataset.biased_std(rules.bias),
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

    pub(crate) fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Deviations that divide features, `[features]`.
    pub(crate) fn std(&self) -> &[f32] {
        &self.std
    }

    /// Width of a caption's vector, or of its tokens.
    pub(crate) fn text_dim(&self) -> usize {
        match &self.words {
            Words::Vectors(_) => self.text_meta.dim,
            Words::Tokens(encoder) => encoder.token_dim(),
        }
    }

    /// Manifest of the encoder that embeds the captions.
    pub(crate) fn text_encoder(&self, cx: &dyn AttemptContext) -> Result<Manifest, StageError> {
        parts::manifest(&*cx.blobs(), self.text_meta.text, "the text encoder")
    }

    fn stream(&self, what: &str, pick: Pick) -> Stream {
        Stream::new(self.seed, &format!("{}/{what}", self.stage), pick.place, 0)
    }

    /// First frame and length of the example at a place.
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

    /// Slice `slice` of the batch of `step`, at timesteps below `timesteps`. A caption is dropped with probability
    /// `drop`.
    pub(crate) fn slice(
        &self,
        step: u64,
        slice: usize,
        timesteps: usize,
        drop: f64,
    ) -> Result<FeatureSlice, StageError> {
        // If all examples have equal padding, sorting gains nothing.
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
        let mut rows = vec![0.0; picks.len() * frames * width];
        let mut noise = vec![0.0; picks.len() * frames * width];
        let mut captions = CaptionRows { rows: Vec::new(), kept: Vec::new() };
        for (b, (pick, (start, len))) in picks.iter().zip(&cuts).enumerate() {
            let entry = &self.dataset.entries[self.train[pick.example]];
            let at = b * frames * width;
            let to = &mut rows[at..at + len * width];
            to.copy_from_slice(&self.dataset.features(entry)[start * width..(start + len) * width]);
            normalise(to, &self.dataset.mean, &self.std);
            // The noise covers padding too. The amount of padding depends on the slice, so the motion's own frames come
            // first.
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

    /// A caption by index, in the form that the network reads.
    fn caption(&self, number: usize) -> Result<Vec<f32>, StageError> {
        match &self.words {
            Words::Vectors(embeddings) => Ok(embeddings.captions.row(number).to_vec()),
            Words::Tokens(encoder) => {
                let tokens = encoder.tokens(&[&self.dataset.captions[number].text])?;
                tokens
                    .into_iter()
                    .next()
                    .ok_or_else(|| StageError::Fault("the text encoder returned no embedding".into()))
            }
        }
    }
}
