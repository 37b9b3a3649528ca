//! `encode.latents`: posteriors of random crops, computed once for every stage that trains in the latent space.
//!
//! Crop `c` of entry `e` is keyed by (seed, stage, c, e). All crops of an entry that have equal length are one batch.
//! So a clip's batch depends on the entry alone, and the bits do not depend on the division into shards.

use std::collections::BTreeMap;

use motion::Stream;
use motion::dataset::{Split, crop};
use protocol::stage::{self, EncodeLatents};
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};

use crate::artifacts::{self, Augmented, LATENTS_FILE, LatentsMeta, Tensors, VaeMeta, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::kinds::shape::Map;
use crate::metrics::latent_fid::standard_deviation;
use crate::parts::latent_networks::Autoencoder;
use crate::shards::{self, shard_range};

/// Meta of one shard, its entries' part of [`LatentsMeta`].
#[derive(Debug, Serialize, Deserialize)]
struct ShardMeta {
    latents: LatentsMeta,
    first: usize,
}

/// Encodes an entry's crops `(start, frames)`, those of one length together. `rows` returns the features of a crop.
/// Returns mu and sigma `[crops, N, d]`.
fn encode_crops(vae: &Autoencoder, crops: &[(usize, usize)], rows: &dyn Fn(usize) -> Vec<f32>) -> (Vec<f32>, Vec<f32>) {
    let size = vae.meta().latent.tokens * vae.meta().latent.dim;
    let mut mu = vec![0.0; crops.len() * size];
    let mut sigma = mu.clone();
    let mut by_length: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (c, (_, frames)) in crops.iter().enumerate() {
        by_length.entry(*frames).or_default().push(c);
    }
    for (frames, members) in by_length {
        let mut batch: Vec<f32> = members.iter().flat_map(|c| rows(*c)).collect();
        vae.normalise(&mut batch);
        let posterior = vae.encode(batch, frames);
        for (i, c) in members.into_iter().enumerate() {
            let to = c * size..(c + 1) * size;
            mu[to.clone()].copy_from_slice(&posterior.mu[i * size..(i + 1) * size]);
            sigma[to].copy_from_slice(&posterior.sigma[i * size..(i + 1) * size]);
        }
    }
    (mu, sigma)
}

impl Map for EncodeLatents {
    fn repetitions(&self, entries: &dyn Fn(stage::Split) -> f64) -> f64 {
        entries(stage::Split::All) * self.crops as f64
    }

    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let (vae_digest, vae) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
        let (_, dataset) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        if self.crops == 0 {
            return Err(StageError::Input("`crops` is 0; expected at least 1".into()));
        }
        let dataset = artifacts::dataset(&*blobs, &dataset)?;
        let vae = Autoencoder::read(&*blobs, &vae, &cx.device())?;
        let VaeMeta { latent, format, .. } = *vae.meta();
        vae.check_format(dataset.format)?;

        let range = shard_range(dataset.entries.len(), index, of);
        let purpose = format!("{}/crop", cx.task().name);
        let seed = cx.task().seed;
        let mut mu = Vec::new();
        let mut sigma = Vec::new();
        let draws = if self.balance > 0.0 { dataset.draws(self.balance) } else { Vec::new() };
        let mut meta = LatentsMeta {
            format,
            vae: vae_digest,
            latent,
            crops: self.crops,
            splits: Vec::new(),
            captions: Vec::new(),
            lengths: Vec::new(),
            starts: Vec::new(),
            draws: draws.get(range.clone()).unwrap_or_default().to_vec(),
            augmented: (!self.augment.is_none()).then(|| Augmented {
                augment: self.augment.clone(),
                seed,
                stage: cx.task().name.clone(),
            }),
        };
        for (done, e) in range.clone().enumerate() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let entry = &dataset.entries[e];
            let crops: Vec<(usize, usize)> = (0..self.crops)
                .map(|c| crop(&mut Stream::new(seed, &purpose, c as u64, e as u64), entry.len, dataset.skeleton()))
                .collect();
            let rows = |c: usize| artifacts::crop_rows(&dataset, (e, c), crops[c], meta.augmented.as_ref());
            let (crops_mu, crops_sigma) = encode_crops(&vae, &crops, &rows);
            mu.extend(crops_mu);
            sigma.extend(crops_sigma);
            meta.splits.push(entry.split);
            meta.captions.push(entry.captions.clone());
            meta.lengths.extend(crops.iter().map(|(_, frames)| frames));
            meta.starts.extend(crops.iter().map(|(start, _)| start));
            cx.progress(done as u64 + 1, range.len() as u64, "clips", &[]);
        }
        let meta = ShardMeta { latents: meta, first: range.start };
        let tensors = tensors(&meta.latents, meta.first, mu, sigma);
        let metrics = BTreeMap::from([("entries".to_owned(), range.len() as f64)]);
        shards::publish(cx, &meta, LATENTS_FILE, &tensors, metrics)
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let mut whole: Option<LatentsMeta> = None;
        let mut mu = Vec::new();
        let mut sigma = Vec::new();
        for shard in shards::read(cx, shards, "latents", LATENTS_FILE) {
            let (ShardMeta { latents, first }, mut part) = shard?;
            let have = whole.as_ref().map_or(0, |w| w.splits.len());
            if first != have {
                return Err(StageError::Fault(format!(
                    "a shard begins at entry {first}, but the previous shard ended at entry {have}"
                )));
            }
            mu.extend_from_slice(&part.take("mu", 3, LATENTS_FILE)?.values);
            sigma.extend_from_slice(&part.take("sigma", 3, LATENTS_FILE)?.values);
            match &mut whole {
                None => whole = Some(latents),
                Some(whole) => {
                    whole.splits.extend(latents.splits);
                    whole.captions.extend(latents.captions);
                    whole.lengths.extend(latents.lengths);
                    whole.starts.extend(latents.starts);
                    whole.draws.extend(latents.draws);
                }
            }
        }
        let meta = whole.ok_or_else(|| StageError::Fault("no shard of the latents was given".into()))?;
        if !mu.iter().chain(&sigma).all(|v| v.is_finite()) {
            return Err(StageError::Input(
                "the VAE's latents are not finite; the VAE is not trained well enough".into(),
            ));
        }
        let size = meta.latent.tokens * meta.latent.dim;
        let train: Vec<f32> = mu
            .chunks_exact(size * meta.crops)
            .zip(&meta.splits)
            .filter(|(_, split)| **split == Split::Train)
            .flat_map(|(rows, _)| rows.iter().copied())
            .collect();
        let metrics = BTreeMap::from([
            ("entries".to_owned(), meta.splits.len() as f64),
            ("latent_std".to_owned(), standard_deviation(&train)),
            ("mean_sigma".to_owned(), sigma.iter().map(|s| f64::from(*s)).sum::<f64>() / sigma.len() as f64),
        ]);
        let bytes = tensors(&meta, 0, mu, sigma).to_bytes()?;
        let output = artifacts::publish(cx, ArtifactKind::Latents, to_meta(&meta), LATENTS_FILE, bytes)?;
        Ok(Outcome::Finished { output, metrics })
    }
}

fn tensors(meta: &LatentsMeta, first: usize, mu: Vec<f32>, sigma: Vec<f32>) -> Tensors {
    let rows = meta.splits.len() * meta.crops;
    let shape = [rows, meta.latent.tokens, meta.latent.dim];
    let entry = (0..rows).map(|row| (first + row / meta.crops) as i64).collect();
    Tensors::default().with("mu", shape, mu).with("sigma", shape, sigma).with_integers("entry", [rows], entry)
}
