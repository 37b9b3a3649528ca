//! `text.embed`: embeds captions as vectors, once for all stages, with the encoder as an artifact.
//!
//! Every text is embedded once, for all captions that have it, and alone, so that the bits do not depend on the
//! division into shards. A shard reads the encoder's folder itself and records the encoder's digest. The merge uploads
//! the encoder and refuses shards of another.

use std::collections::{BTreeMap, HashMap};

use protocol::artifact::Role;
use protocol::stage::{StageSettings, TextEmbed, TextEncoder};
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, Draft, EMBEDDINGS_FILE, EmbeddingsMeta, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::external;
use crate::kinds::shape::Map;
use crate::parts::text::{Named, TextEncoderMeta};
use crate::shards::{self, shard_range};

/// Number of texts between progress reports.
const BLOCK: usize = 16;

/// Meta of one shard.
#[derive(Debug, Serialize, Deserialize)]
struct ShardMeta {
    /// Fingerprint of the encoder in the folder, see [`fingerprint`].
    encoder: Digest,
    /// Index of the shard's first text.
    first: usize,
}

/// Digest of an encoder's digest. A manifest names only blobs that its worker has uploaded or reads. A shard does neither
/// with the encoder, which another run may have stored, so its manifest must not contain the encoder's digest.
fn fingerprint(encoder: Digest) -> Digest {
    Digest::of(encoder.to_string().as_bytes())
}

/// All different texts, the empty one first, and the index of each caption's text.
fn texts(cx: &dyn AttemptContext) -> Result<(Vec<String>, Vec<usize>), StageError> {
    let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
    let captions = artifacts::captions(&*cx.blobs(), &manifest)?;
    let mut texts = vec![String::new()];
    let mut known = HashMap::from([(String::new(), 0)]);
    let of = captions.into_iter().map(|caption| {
        *known.entry(caption.text).or_insert_with_key(|text| {
            texts.push(text.clone());
            texts.len() - 1
        })
    });
    let of = of.collect();
    Ok((texts, of))
}

/// The rows of all shards and their width. All shards must come from the encoder with the digest `encoder`.
fn gather(
    settings: &TextEmbed,
    cx: &mut dyn AttemptContext,
    shards: &[Digest],
    encoder: Digest,
) -> Result<(Vec<f32>, usize), StageError> {
    let mut rows: Vec<f32> = Vec::new();
    let mut dim = 0;
    for shard in shards::read::<ShardMeta>(cx, shards, "embeddings", EMBEDDINGS_FILE) {
        let (meta, mut part) = shard?;
        if meta.encoder != encoder {
            return Err(StageError::Input(format!(
                "the encoder in {} differs between workers, or changed during the stage; give all workers the same \
                 encoder and run the stage again",
                settings.path
            )));
        }
        let part = part.take("rows", 2, EMBEDDINGS_FILE)?;
        dim = part.row_len();
        if meta.first * dim != rows.len() {
            let have = rows.len() / dim.max(1);
            return Err(StageError::Fault(format!(
                "a shard begins at text {}, but the previous shard ended at text {have}",
                meta.first
            )));
        }
        rows.extend_from_slice(&part.values);
    }
    Ok((rows, dim))
}

impl Map for TextEmbed {
    // Reading published encoders takes longer than the rest of an estimate.
    fn cheaper(&self) -> Option<StageSettings> {
        let hashed = Self { dataset: self.dataset.clone(), ..Self::default() };
        (self.encoder != TextEncoder::Hashed).then(|| hashed.into())
    }

    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let (texts, _) = texts(cx)?;
        let range = shard_range(texts.len(), index, of);
        let named = external::read(cx, |_, given| Named::open(self, given))?;
        let fingerprint = fingerprint(named.digest());
        let encoder = named.ready(self, &cx.device())?;
        let dim = encoder.dim();
        let mut rows = Vec::with_capacity(range.len() * dim);
        for block in texts[range.clone()].chunks(BLOCK) {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let block: Vec<&str> = block.iter().map(String::as_str).collect();
            rows.extend(encoder.pooled(&block)?);
            cx.progress((rows.len() / dim) as u64, range.len() as u64, "captions", &[]);
        }
        let meta = ShardMeta { encoder: fingerprint, first: range.start };
        let tensors = Tensors::default().with("rows", [range.len(), dim], rows);
        let metrics = BTreeMap::from([("captions".to_owned(), range.len() as f64)]);
        shards::publish(cx, &meta, EMBEDDINGS_FILE, &tensors, metrics)
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let (texts, of) = texts(cx)?;
        let named = external::read(cx, |_, given| Named::open(self, given))?;
        let (rows, dim) = gather(self, cx, shards, fingerprint(named.digest()))?;
        if dim == 0 || rows.len() != texts.len() * dim {
            return Err(StageError::Fault(format!(
                "the shards have {} numbers for {} texts of {dim} numbers each",
                rows.len(),
                texts.len()
            )));
        }
        if let Some(bad) = rows.iter().position(|v| !v.is_finite()) {
            let text = protocol::excerpt(&texts[bad / dim]);
            return Err(StageError::Input(format!(
                "the encoder's embedding of `{text}` is not finite; the encoder's weights are damaged"
            )));
        }
        if let Some(line) = named.skipped() {
            cx.log(&line);
        }
        let part = named.upload(cx)?;
        let said: TextEncoderMeta = artifacts::meta(&part, "the text encoder")?;
        if said.dim != dim {
            return Err(StageError::Fault(format!(
                "the encoder returned {dim} numbers per caption; expected {}",
                said.dim
            )));
        }
        let row = |text: usize| rows[text * dim..(text + 1) * dim].iter().copied();
        let captions: Vec<f32> = of.iter().flat_map(|text| row(*text)).collect();
        let null: Vec<f32> = row(0).collect();
        let meta = EmbeddingsMeta { text: part.digest(), dim, captions: of.len() };
        let tensors = Tensors::default().with("captions", [of.len(), dim], captions).with("null", [dim], null);
        let mut draft = Draft::new(cx, ArtifactKind::Embeddings, to_meta(&meta));
        draft.part(&Role::TEXT, &part);
        draft.add(EMBEDDINGS_FILE, tensors.to_bytes()?)?;
        let output = draft.finish(cx)?;
        let metrics =
            BTreeMap::from([("captions".to_owned(), of.len() as f64), ("texts".to_owned(), texts.len() as f64)]);
        Ok(Outcome::Finished { output, metrics })
    }
}
