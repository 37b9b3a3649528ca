//! `evaluate.reconstruction`: what a VAE loses, clip by clip.
//!
//! Each clip is its entry's first frames, as many as are a multiple of the unit length; it is encoded and decoded alone, so no
//! number hangs on the sharding. Metrics without a prefix are of a sample z of the posterior, as every later stage uses it; `mu_` of the
//! posterior's mean; `clip_mean_` of no network at all: the clip's own mean feature vector, held; `real_` of the clip itself.
//! Definitions: [`evaluation::reconstruction`](crate::evaluation::reconstruction).

use std::collections::BTreeMap;

use motion::{Skeleton, Stream};
use protocol::stage::{DataFormat, EvaluateReconstruction};
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};

use super::encode::shard_range;
use super::{Map, REPORT_FILE, no_entries, publish_report};
use crate::artifacts::{self, to_meta};
use crate::context::{AttemptContext, ContextError, Outcome, StageError};
use crate::evaluation::joints::time_mean;
use crate::evaluation::reconstruction::{ClipErrors, real_skating, summary};
use crate::networks::Autoencoder;

/// Errors of the three guesses at one clip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Row {
    entry: String,
    sample: ClipErrors,
    mu: ClipErrors,
    clip_mean: ClipErrors,
    /// Skating ratio of the clip.
    real_skating: f64,
}

/// What a shard knows.
#[derive(Debug, Serialize, Deserialize)]
struct Rows {
    format: DataFormat,
    rows: Vec<Row>,
}

impl Map for EvaluateReconstruction {
    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let (_, vae) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
        let (_, dataset) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let dataset = artifacts::dataset(&*blobs, &dataset)?;
        let vae = Autoencoder::read(&*blobs, &vae, &cx.device())?;
        vae.check_format(dataset.format)?;
        let entries = dataset.entries_of(self.split);
        if entries.is_empty() {
            return Err(no_entries(self.split));
        }

        let range = shard_range(entries.len(), index, of);
        let total = range.len() as u64;
        let (skeleton, width, seed) = (dataset.skeleton(), dataset.mean.len(), cx.task().seed);
        let meta = vae.meta();
        let mut rows = Vec::with_capacity(range.len());
        for &e in &entries[range] {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let entry = &dataset.entries[e];
            let frames = (entry.len / skeleton.unit * skeleton.unit).max(entry.len.min(skeleton.unit));
            let mut truth = dataset.features(entry)[..frames * width].to_vec();
            vae.normalise(&mut truth);
            let posterior = vae.encode(truth.clone(), frames);
            let mut stream = Stream::new(seed, "evaluate.reconstruction/noise", 0, e as u64);
            let z = posterior.sample(&mut stream);
            let errors = |guess: &[f32]| ClipErrors::between(&truth, guess, &meta.mean, &meta.std, skeleton);
            rows.push(Row {
                entry: entry.id.clone(),
                sample: errors(&vae.decode(z, frames)),
                mu: errors(&vae.decode(posterior.mu.clone(), frames)),
                clip_mean: errors(&time_mean(&truth, width)),
                real_skating: real_skating(&truth, &meta.mean, &meta.std, skeleton),
            });
            cx.progress(rows.len() as u64, total, "clips", &[]);
        }
        let rows = Rows { format: dataset.format, rows };
        let bytes = serde_json::to_vec(&rows).map_err(|e| StageError::Fault(e.to_string()))?;
        let meta = serde_json::json!({"shard": index, "of": of});
        let output = artifacts::publish(cx, ArtifactKind::Shard, meta, REPORT_FILE, bytes)?;
        Ok(Outcome::Finished { output, metrics: BTreeMap::new() })
    }

    fn merge(&self, cx: &mut dyn AttemptContext, shards: &[Digest]) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let mut whole: Option<Rows> = None;
        for digest in shards {
            let manifest = cx.manifest(*digest)?;
            let bytes = artifacts::file(&*blobs, &manifest, REPORT_FILE)?;
            let rows: Rows = serde_json::from_slice(&bytes)
                .map_err(|e| StageError::Context(ContextError::Corrupt(format!("{REPORT_FILE} of a shard: {e}"))))?;
            match &mut whole {
                None => whole = Some(rows),
                Some(whole) => whole.rows.extend(rows.rows),
            }
        }
        let Rows { format, rows } = whole.ok_or_else(|| StageError::Fault("an evaluation without shards".into()))?;
        let skeleton = Skeleton::of(format);
        let column = |of: fn(&Row) -> ClipErrors| rows.iter().map(of).collect::<Vec<_>>();
        let mut metrics = summary(&column(|r| r.sample), skeleton, "");
        metrics.extend(summary(&column(|r| r.mu), skeleton, "mu_"));
        metrics.extend(summary(&column(|r| r.clip_mean), skeleton, "clip_mean_"));
        let skating = rows.iter().map(|row| row.real_skating).sum::<f64>() / rows.len() as f64;
        metrics.insert("real_skating_ratio".into(), skating);
        if metrics.values().any(|v| !v.is_finite()) {
            return Err(StageError::Input(
                "the VAE's reconstructions are not finite; it has not been trained well".into(),
            ));
        }
        publish_report(cx, metrics, to_meta(&rows))
    }
}
