//! `encode.tokens`: the ids of every entry, one token per whole group of four frames.
//!
//! An entry is encoded alone, so its ids depend only on itself and `padded`.

use std::collections::{BTreeMap, BTreeSet};

use protocol::stage::EncodeTokens;
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::kinds::shape::Map;
use crate::parts::tokenizer::{TOKENS_FILE, TokensMeta, TrainedTokenizer};
use crate::shards::{self, shard_range};

/// Meta of one shard, its entries' part of [`TokensMeta`].
#[derive(Debug, Serialize, Deserialize)]
struct ShardMeta {
    tokens: TokensMeta,
    first: usize,
}

fn tensors(ids: Vec<i64>, quantizers: usize) -> Tensors {
    Tensors::default().with_integers("ids", [ids.len() / quantizers, quantizers], ids)
}

impl Map for EncodeTokens {
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let (digest, manifest) = artifacts::input(cx, "tokenizer", ArtifactKind::Tokenizer)?;
        let tokenizer = TrainedTokenizer::read(&*blobs, &manifest, &cx.device())?;
        let dataset = artifacts::input_dataset(cx)?;
        tokenizer.check_format(dataset.format)?;
        let unit = tokenizer.unit();
        let width = dataset.mean.len();
        let range = shard_range(dataset.entries.len(), index, of);
        let mut meta = TokensMeta {
            format: dataset.format,
            tokenizer: digest,
            codes: tokenizer.meta().codes,
            quantizers: tokenizer.meta().quantizers,
            splits: Vec::new(),
            captions: Vec::new(),
            lengths: Vec::new(),
        };
        let mut ids = Vec::new();
        for (done, e) in range.clone().enumerate() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let entry = &dataset.entries[e];
            let tokens = entry.len / unit;
            if tokens > 0 {
                let mut rows = dataset.features(entry)[..tokens * unit * width].to_vec();
                tokenizer.normalise(&mut rows);
                rows.resize(rows.len().max(self.padded * width), 0.0);
                let found = tokenizer.encode(rows);
                ids.extend_from_slice(&found[..tokens * meta.quantizers]);
            }
            meta.splits.push(entry.split);
            meta.captions.push(entry.captions.clone());
            meta.lengths.push(tokens);
            cx.progress(done as u64 + 1, range.len() as u64, "clips", &[]);
        }
        let tensors = tensors(ids, meta.quantizers);
        let metrics = BTreeMap::from([("entries".to_owned(), range.len() as f64)]);
        shards::publish(cx, &ShardMeta { tokens: meta, first: range.start }, TOKENS_FILE, &tensors, metrics)
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let mut whole: Option<TokensMeta> = None;
        let mut ids = Vec::new();
        for shard in shards::read(cx, shards, "tokens", TOKENS_FILE) {
            let (ShardMeta { tokens, first }, mut part) = shard?;
            let have = whole.as_ref().map_or(0, |whole| whole.splits.len());
            if first != have {
                return Err(StageError::Fault(format!(
                    "a shard begins at entry {first}, but the previous shard ended at entry {have}"
                )));
            }
            ids.extend_from_slice(&part.take_integers("ids", 2, TOKENS_FILE)?.values);
            match &mut whole {
                None => whole = Some(tokens),
                Some(whole) => {
                    whole.splits.extend(tokens.splits);
                    whole.captions.extend(tokens.captions);
                    whole.lengths.extend(tokens.lengths);
                }
            }
        }
        let meta = whole.ok_or_else(|| StageError::Fault("no shard of the tokens was given".into()))?;
        let used: BTreeSet<i64> = ids.iter().step_by(meta.quantizers).copied().collect();
        let metrics = BTreeMap::from([
            ("entries".to_owned(), meta.splits.len() as f64),
            ("tokens".to_owned(), (ids.len() / meta.quantizers) as f64),
            ("used".to_owned(), used.len() as f64 / meta.codes as f64),
        ]);
        let bytes = tensors(ids, meta.quantizers).to_bytes()?;
        let output = artifacts::publish(cx, ArtifactKind::Tokens, to_meta(&meta), TOKENS_FILE, bytes)?;
        Ok(Outcome::Finished { output, metrics })
    }
}
