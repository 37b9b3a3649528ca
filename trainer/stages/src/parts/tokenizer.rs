//! Trained tokenizers from artifacts: motion to token ids and back, with plain arrays.
//!
//! Everything runs on the plain device, without dropout. Ids are rows `[tokens, quantizers]`;
//! [`NO_CODE`](models::quantizer::NO_CODE) adds nothing. Not its job: training, and generating ids.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use models::device::host;
use models::flat::{self, Entry};
use models::kernels::Dropout;
use models::names::from_bytes;
use models::networks::{Init, Tokenizer, TokenizerConfig, UNIT};
use models::quantizer::{Pass, look_up};
use motion::dataset::{denormalise, normalise};
use protocol::stage::{DataFormat, TokenizerNetwork};
use protocol::{ArtifactKind, Digest, Manifest};
use serde::{Deserialize, Serialize};

use super::model::expect_format;
use super::weights;
use crate::artifacts::{self, Draft, HostTensor, MODEL_FILE, Tensors, to_meta};
use crate::context::{AttemptContext, ContextError, StageError};

/// Meta of an artifact of kind `tokenizer`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TokenizerMeta {
    /// Format of the training data.
    pub format: DataFormat,
    /// Width of a feature vector.
    pub features: usize,
    /// Number of codes K of a codebook.
    pub codes: usize,
    /// Width d of a code.
    pub code_dim: usize,
    /// Number of codebooks Q.
    pub quantizers: usize,
    /// Size of encoder and decoder.
    pub network: TokenizerNetwork,
    /// Mean of the training features, `[features]`.
    pub mean: Vec<f32>,
    /// Standard deviation of the training features, `[features]`.
    pub std: Vec<f32>,
}

impl TokenizerMeta {
    /// The networks' size.
    pub fn config(&self) -> TokenizerConfig {
        TokenizerConfig { features: self.features, dim: self.code_dim, network: self.network.clone() }
    }

    /// Names and shapes of the codebooks in the file.
    pub(crate) fn books(&self) -> Vec<Entry> {
        let shape = vec![self.codes, self.code_dim];
        let name = |q: usize| format!("quantizer.layers.{q}.codebook");
        (0..self.quantizers).map(|q| Entry { name: name(q), shape: shape.clone() }).collect()
    }

    /// Uploads a tokenizer's parameters and codebooks.
    pub fn publish(
        &self,
        cx: &mut dyn AttemptContext,
        params: (&[Entry], &[f32]),
        books: &[&[f32]],
    ) -> Result<Digest, StageError> {
        let names = self.books();
        let books = names.chunks(1).zip(books.iter().copied());
        let mut draft = Draft::new(cx, ArtifactKind::Tokenizer, to_meta(self));
        weights::add_all(&mut draft, &[params].into_iter().chain(books).collect::<Vec<_>>())?;
        draft.finish(cx)
    }
}

/// A trained tokenizer.
#[derive(Debug)]
pub struct TrainedTokenizer {
    network: Tokenizer,
    books: Vec<Vec<f32>>,
    meta: TokenizerMeta,
    device: Device,
}

impl TrainedTokenizer {
    /// Reads an artifact of kind `tokenizer`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, device: &Device) -> Result<Self, StageError> {
        Self::load(artifacts::meta(manifest, "the tokenizer")?, &artifacts::file(blobs, manifest, MODEL_FILE)?, device)
    }

    /// Creates a tokenizer from its meta and weights.
    pub fn load(meta: TokenizerMeta, weights: &[u8], device: &Device) -> Result<Self, StageError> {
        let device = device.clone().inner();
        let fresh = Tokenizer::new(&meta.config(), &mut Init::blank(&device));
        let entries: Vec<Entry> = flat::layout(&fresh).into_iter().chain(meta.books()).collect();
        let mut all = from_bytes(&entries, weights, "")
            .map_err(|error| StageError::Context(ContextError::Corrupt(format!("the tokenizer's weights: {error}"))))?;
        let codes = all.split_off(all.len() - meta.quantizers * meta.codes * meta.code_dim);
        let books = codes.chunks_exact(meta.codes * meta.code_dim).map(<[f32]>::to_vec).collect();
        Ok(Self { network: flat::write(fresh, &all), books, meta, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &TokenizerMeta {
        &self.meta
    }

    /// Number of frames per token.
    pub fn unit(&self) -> usize {
        UNIT
    }

    /// Codes of each codebook, `[K, d]`.
    pub fn books(&self) -> &[Vec<f32>] {
        &self.books
    }

    /// Refuses data of another format than the training data.
    pub fn check_format(&self, format: DataFormat) -> Result<(), StageError> {
        expect_format("the tokenizer", self.meta.format, format)
    }

    /// Computes `(x - mean) / std` with the statistics of the training data, in place.
    pub fn normalise(&self, rows: &mut [f32]) {
        normalise(rows, &self.meta.mean, &self.meta.std);
    }

    /// The inverse of [`normalise`](Self::normalise).
    pub fn denormalise(&self, rows: &mut [f32]) {
        denormalise(rows, &self.meta.mean, &self.meta.std);
    }

    /// Encodes one motion of at least 4 normalised rows `[frames, features]` as ids `[frames / 4, Q]`.
    pub fn encode(&self, rows: Vec<f32>) -> Vec<i64> {
        let frames = rows.len() / self.meta.features;
        self.encode_windows(rows, frames)
    }

    /// Encodes motions of `frames` normalised rows each as ids `[motions, frames / 4, Q]`.
    pub(crate) fn encode_windows(&self, rows: Vec<f32>, frames: usize) -> Vec<i64> {
        let features = self.meta.features;
        let shape = [rows.len() / (frames * features), frames, features];
        let rows = Tensor::<3>::from_data(TensorData::new(rows, shape), &self.device);
        let encoded = host(self.network.encode(rows, &mut Dropout::off()));
        let book = |layer: usize, _: &[f32]| std::borrow::Cow::<[f32]>::Borrowed(self.books[layer].as_slice());
        let quantizers = self.meta.quantizers;
        Pass::through(encoded, self.meta.code_dim, quantizers, &self.device, book, None).ids(quantizers)
    }

    /// Sums of codes `[tokens, d]` of ids `[tokens, Q]`.
    pub fn codes(&self, ids: &[i64]) -> Vec<f32> {
        look_up(ids, self.meta.quantizers, &self.books, self.meta.code_dim)
    }

    /// Decodes one motion's ids `[tokens, Q]` to normalised rows `[4 tokens, features]`.
    pub fn decode(&self, ids: &[i64]) -> Vec<f32> {
        let codes = self.codes(ids);
        let tokens = codes.len() / self.meta.code_dim;
        let codes = Tensor::<3>::from_data(TensorData::new(codes, [1, tokens, self.meta.code_dim]), &self.device);
        host(self.network.decode(codes, &mut Dropout::off()))
    }
}

/// File of ids: `ids` `[tokens of all entries, Q]`.
pub const TOKENS_FILE: &str = "tokens.safetensors";

/// Meta of an artifact of kind `tokens`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TokensMeta {
    /// Format of the encoded data.
    pub format: DataFormat,
    /// The tokenizer that encoded the data.
    pub tokenizer: Digest,
    /// Number of codes K of a codebook.
    pub codes: usize,
    /// Number of codebooks Q.
    pub quantizers: usize,
    /// Split of each entry.
    pub splits: Vec<motion::dataset::Split>,
    /// Captions of each entry, as indices in the dataset and so as rows of the embeddings.
    pub captions: Vec<Vec<usize>>,
    /// Number of tokens of each entry.
    pub lengths: Vec<usize>,
}

/// Token ids with their meta.
#[derive(Debug, Clone)]
pub struct Tokens {
    /// Meta of the artifact.
    pub meta: TokensMeta,
    ids: HostTensor<i64>,
    /// Index of each entry's first token.
    starts: Vec<usize>,
}

impl Tokens {
    /// Reads an artifact of kind `tokens`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest) -> Result<Self, StageError> {
        let meta: TokensMeta = artifacts::meta(manifest, "the tokens")?;
        let bad = |text: String| StageError::Context(ContextError::Corrupt(format!("{TOKENS_FILE}: {text}")));
        let mut tensors = Tensors::from_bytes(artifacts::mapped(blobs, manifest, TOKENS_FILE)?, TOKENS_FILE)?;
        let ids = tensors.take_integers("ids", 2, TOKENS_FILE)?;
        let all: usize = meta.lengths.iter().sum();
        if ids.shape != [all, meta.quantizers] || meta.splits.len() != meta.lengths.len() {
            let found = &ids.shape;
            let wanted = [all, meta.quantizers];
            return Err(bad(format!("`ids` has shape {found:?}; the manifest declares {wanted:?}")));
        }
        let codes = meta.codes as i64;
        if let Some(id) = ids.values.iter().find(|id| !(0..codes).contains(*id)) {
            return Err(bad(format!("id {id} is not a code; the tokenizer has {codes} codes")));
        }
        let begin = |at: &mut usize, len: &usize| {
            let first = *at;
            *at += len;
            Some(first)
        };
        let starts = meta.lengths.iter().scan(0, begin).collect();
        Ok(Self { meta, ids, starts })
    }

    /// Ids `[tokens, Q]` of entry `e`.
    pub fn of(&self, e: usize) -> &[i64] {
        let q = self.meta.quantizers;
        &self.ids.values[self.starts[e] * q..(self.starts[e] + self.meta.lengths[e]) * q]
    }
}
