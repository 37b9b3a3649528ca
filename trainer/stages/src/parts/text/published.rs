//! Common part of the published encoders: their folder as named in settings, their artifact, and loading their weights.
//!
//! The artifact has `tokenizer.json` and `model.safetensors`, with the weights in their published type, without those
//! of other towers. Its meta holds everything else, so that it can be opened without its folder. Everything is computed
//! in f32.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use burn::module::Module;
use burn::tensor::Device;
use checkpoint::{Blob, BlobError, Blobs};
use models::flat;
use protocol::stage::{ClipIds, ClipOutput, TextEmbed, TextEncoder as Choice};
use protocol::{ArtifactKind, Digest, Manifest};
use serde::{Deserialize, Serialize};
use text_models::{
    Description, EncoderError, EncoderFolder, Kind, Network, ReadAt, Request, TensorSpec, TokenIds, Tokenizer,
    WeightsFile,
};

use super::remembered::Remembered;
use crate::artifacts::{self, Draft, MODEL_FILE, to_meta};
use crate::context::{AttemptContext, ContextError, StageError};
use crate::external::Given;

/// File of the tokenizer.
const TOKENIZER_FILE: &str = "tokenizer.json";

/// Limits of the cached vectors and words, in numbers: 64 MB and 256 MB.
const REMEMBERED: (usize, usize) = (16 << 20, 64 << 20);

/// Meta of a published encoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct PublishedMeta {
    /// Name in the table of encoders.
    pub(super) encoder: String,
    /// Width of a caption's vector.
    pub(super) dim: usize,
    /// The vector of CLIP to use.
    pub(super) output: ClipOutput,
    /// Sizes of the network, and the rules for converting captions to ids.
    pub(super) description: Description,
}

/// A file in pieces.
#[derive(Debug)]
struct Pieces(Vec<Vec<u8>>);

impl ReadAt for Pieces {
    fn bytes(&self) -> u64 {
        self.0.iter().map(|piece| piece.len() as u64).sum()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        let mut begin = 0;
        let mut filled = 0;
        for piece in &self.0 {
            let end = begin + piece.len() as u64;
            let at = offset + filled as u64;
            if filled < out.len() && (begin..end).contains(&at) {
                let rest = &piece[(at - begin) as usize..];
                let count = rest.len().min(out.len() - filled);
                out[filled..filled + count].copy_from_slice(&rest[..count]);
                filled += count;
            }
            begin = end;
        }
        if filled == out.len() { Ok(()) } else { Err("the file is too short".into()) }
    }
}

/// A file of an artifact as a reader.
#[derive(Debug)]
struct Stored {
    blob: Box<dyn Blob>,
    /// The error of the store, so that a lost connection is not reported as a broken file.
    refused: Rc<RefCell<Option<BlobError>>>,
}

impl ReadAt for Stored {
    fn bytes(&self) -> u64 {
        self.blob.bytes()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        self.blob.read_at(offset, out).map_err(|error| {
            let text = error.to_string();
            self.refused.replace(Some(error));
            text
        })
    }
}

/// Conversion of captions to the network's ids.
#[derive(Debug)]
pub(super) struct Captions {
    /// Meta of the encoder.
    pub(super) meta: PublishedMeta,
    tokenizer: Tokenizer,
    key: String,
}

impl Captions {
    /// The caches of this encoder's vectors on `device` in this process: of captions, and of their words.
    pub(super) fn remembered(&self, device: &Device) -> (Arc<Remembered>, Arc<Remembered>) {
        let of = |what: &str, most| Remembered::shared(format!("{what} {} {device:?}", self.key), most);
        (of("vectors", REMEMBERED.0), of("words", REMEMBERED.1))
    }

    /// The ids of a caption.
    pub(super) fn ids(&self, caption: &str) -> Result<Vec<usize>, StageError> {
        Ok(self.tokenizer.ids(caption).map_err(unfit)?.into_iter().map(|id| id as usize).collect())
    }

    /// The ids of a caption, padded to `length`.
    pub(super) fn padded(&self, caption: &str, length: usize) -> Result<Vec<usize>, StageError> {
        let (ids, _) = self.tokenizer.padded(caption, length).map_err(unfit)?;
        Ok(ids.into_iter().map(|id| id as usize).collect())
    }
}

/// A published encoder whose network is not created yet.
pub(super) struct Published {
    pub(super) captions: Captions,
    weights: WeightsFile<Box<dyn ReadAt>>,
    refused: Rc<RefCell<Option<BlobError>>>,
}

impl Published {
    /// Creates it; `key` must contain everything that captions' vectors depend on.
    fn new(
        key: String,
        meta: PublishedMeta,
        tokenizer_json: &[u8],
        weights: impl FnOnce(Rc<RefCell<Option<BlobError>>>) -> Box<dyn ReadAt>,
    ) -> Result<Self, StageError> {
        let Description { network, head, rules } = &meta.description;
        let corrupt = |what: String| corrupt(&meta.encoder, &what);
        meta.description.check().map_err(corrupt)?;
        let tokenizer = Tokenizer::new(TOKENIZER_FILE, tokenizer_json, rules, network.rows()).map_err(unfit)?;
        let refused: Rc<RefCell<Option<BlobError>>> = Rc::default();
        let opened = WeightsFile::open(weights(Rc::clone(&refused)));
        let said = |what: String| refusal(&refused, &meta.encoder, &what);
        let weights = opened.map_err(said)?;
        // Checked before a network of these sizes is created.
        weights.holds(&network.tensors(), "").map_err(corrupt)?;
        let dense: Vec<TensorSpec> = head.iter().flat_map(|head| head.tensors(network.width())).collect();
        weights.holds(&dense, text_models::DENSE).map_err(corrupt)?;
        Ok(Self { captions: Captions { meta, tokenizer, key }, weights, refused })
    }

    /// Opens the encoder of an artifact.
    pub(super) fn of_artifact(manifest: &Manifest, blobs: &dyn Blobs) -> Result<Self, StageError> {
        let meta: PublishedMeta = artifacts::meta(manifest, "the text encoder")?;
        let tokenizer_json = artifacts::file(blobs, manifest, TOKENIZER_FILE)?;
        let blob = artifacts::open(blobs, manifest, MODEL_FILE)?;
        Self::new(manifest.digest().hex(), meta, &tokenizer_json, |refused| Box::new(Stored { blob, refused }))
    }

    /// Loads into `blank` the weights whose names have `prefix`.
    pub(super) fn filled<M: Module>(&self, blank: M, prefix: &str) -> Result<M, StageError> {
        let mut entries = flat::layout(&blank).into_iter();
        let filled = flat::replace(blank, |values| {
            let name = entries.next().map(|entry| format!("{prefix}{}", entry.name)).unwrap_or_default();
            self.weights.read(&name, values)
        });
        filled.map_err(|what| refusal(&self.refused, &self.captions.meta.encoder, &what))
    }

    /// Converts sizes to the network's own settings, which have the published keys.
    pub(super) fn sizes<T: serde::de::DeserializeOwned>(&self, sizes: &impl Serialize) -> Result<T, StageError> {
        serde_json::from_value(to_meta(sizes)).map_err(|e| corrupt(&self.captions.meta.encoder, &e.to_string()))
    }
}

/// The error for the user's files or captions.
fn unfit(error: EncoderError) -> StageError {
    StageError::Input(error.to_string())
}

fn corrupt(encoder: &str, what: &str) -> StageError {
    StageError::Context(ContextError::Corrupt(format!("the text encoder `{encoder}`: {what}")))
}

/// The store's error, or else an error for the encoder's file.
fn refusal(refused: &RefCell<Option<BlobError>>, encoder: &str, what: &str) -> StageError {
    refused.take().map_or_else(|| corrupt(encoder, what), artifacts::blob_error)
}

/// The encoder in a folder that settings name.
#[derive(Debug)]
pub(super) struct Source {
    meta: PublishedMeta,
    folder: EncoderFolder,
    weights: Vec<Vec<u8>>,
}

impl Source {
    /// Reads the folder that `settings` name; `None` if the encoder is built in.
    ///
    /// # Errors
    /// If a file is missing or invalid.
    pub(super) fn open(settings: &TextEmbed, given: &Given) -> Result<Option<Self>, StageError> {
        let kind = match settings.encoder {
            Choice::Hashed => return Ok(None),
            Choice::Clip => Kind::Clip,
            Choice::T5 => Kind::T5,
            Choice::SentenceT5 => Kind::SentenceT5,
        };
        let ids = match settings.ids {
            ClipIds::HuggingFace => TokenIds::HuggingFace,
            ClipIds::OpenAi => TokenIds::OpenAi,
        };
        let request = Request { kind, ids, most: settings.max_tokens };
        let folder = EncoderFolder::open(given.path("path")?, &request).map_err(unfit)?;
        let Description { network, head, .. } = &folder.description;
        let dim = match (network, head, settings.output) {
            (_, Some(head), _) => head.width,
            (Network::Clip(sizes), None, ClipOutput::Projected) => sizes.projection_dim,
            (network, None, _) => network.width(),
        };
        let meta = PublishedMeta {
            encoder: settings.encoder.name().to_owned(),
            dim,
            output: settings.output,
            description: folder.description.clone(),
        };
        let weights = folder.weights().map_err(unfit)?;
        Ok(Some(Self { meta, folder, weights }))
    }

    /// Digest of everything that captions' vectors depend on.
    pub(super) fn digest(&self) -> Digest {
        self.folder.digest(&self.weights)
    }

    /// Summary of the tensors in the folder that are not the encoder's.
    pub(super) fn skipped(&self) -> Option<String> {
        self.folder.skipped_line()
    }

    /// Uploads the encoder's files and their manifest.
    ///
    /// # Errors
    /// If the store refuses them.
    pub(super) fn upload(&self, cx: &mut dyn AttemptContext) -> Result<Manifest, StageError> {
        let mut draft = Draft::new(cx, ArtifactKind::TextEncoder, to_meta(&self.meta));
        draft.add(TOKENIZER_FILE, self.folder.tokenizer_json.clone())?;
        let pieces: Vec<&[u8]> = self.weights.iter().map(Vec::as_slice).collect();
        draft.add_pieces(MODEL_FILE, &pieces)?;
        let manifest = draft.into_manifest();
        cx.put_manifest(&manifest)?;
        Ok(manifest)
    }

    /// Converts to a published encoder, ready to create its network.
    pub(super) fn into_published(self) -> Result<Published, StageError> {
        let key = format!("{} {:?}", self.digest().hex(), self.meta.output);
        let Self { meta, folder, weights } = self;
        Published::new(key, meta, &folder.tokenizer_json, |_| Box::new(Pieces(weights)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_one_file() {
        let pieces = Pieces(vec![vec![1, 2], vec![], vec![3, 4, 5]]);
        assert_eq!(pieces.bytes(), 5);
        for offset in 0..5 {
            for length in 0..=5 - offset {
                let mut out = vec![0; length];
                pieces.read_at(offset as u64, &mut out).unwrap();
                assert_eq!(out, [1, 2, 3, 4, 5][offset..offset + length]);
            }
        }
        assert!(pieces.read_at(4, &mut [0; 2]).is_err());
    }
}
