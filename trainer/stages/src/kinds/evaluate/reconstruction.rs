//! `evaluate.reconstruction`: errors of a VAE or a tokenizer, clip by clip.
//!
//! Each clip is its entry's first frames, the largest multiple of the unit length. It is encoded and decoded alone, so
//! no number depends on the sharding. Metrics without a prefix are those of a sample z of the posterior, as every later
//! stage uses it. `mu_` are those of the posterior's mean. A tokenizer has neither sample nor mean: it decodes its
//! tokens. `clip_mean_` are those without a network: the clip's own mean feature vector, repeated. `real_` are those of
//! the clip itself. `millimetres_per_unit` is the conversion from the data's unit in all metrics that end in `_mm`. A
//! tokenizer also has, as means over its codebooks, the share of codes in `used` and the `perplexity` of all clips'
//! codes. With an evaluator there is also `fid`, of the reconstructions against the clips, each embedded alone. The
//! papers' FID is on crops of at most 196 frames, drawn again in each of 20 repeats. Definitions:
//! [`evaluation::reconstruction`](crate::metrics::reconstruction).

use std::collections::BTreeMap;

use motion::{Skeleton, Stream};
use protocol::stage::{DataFormat, EvaluateReconstruction, PHYSICS, Split};
use protocol::{ArtifactKind, Digest};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::artifacts::{self, Draft, Tensors, to_meta};
use crate::context::{AttemptContext, ContextError, Outcome, StageError};
use crate::evaluation::reconstructor::Reconstructor;
use crate::evaluation::report::{REPORT_FILE, no_entries};
use crate::kinds::shape::Map;
use crate::metrics::frechet::{Gaussian, to_f64};
use crate::metrics::joints::time_mean;
use crate::metrics::physics::mean_physics;
use crate::metrics::reconstruction::{ClipErrors, real_physics, real_still, summary};
use crate::parts::evaluator::TrainedEvaluator;
use crate::shards::shard_range;

/// Clips per dimension below which FID's covariances are unreliable.
const FEW: usize = 5;
/// File of a shard's embeddings: `real` and `made` `[clips, width]`.
const EMBEDDINGS_FILE: &str = "embeddings.safetensors";

/// Errors of the three reconstructions of one clip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Row {
    entry: String,
    sample: ClipErrors,
    /// Errors of the posterior's mean; `None` for a tokenizer.
    mu: Option<ClipErrors>,
    clip_mean: ClipErrors,
    /// Physics of the original clip.
    real_physics: [f64; PHYSICS.len()],
    /// Share of its jerks in which feet and wrists are still; `None` for fewer than 4 frames.
    real_still: Option<f64>,
}

/// Results of a shard.
#[derive(Debug, Serialize, Deserialize)]
struct Rows {
    format: DataFormat,
    rows: Vec<Row>,
    /// Number of uses of each code, by codebook; empty for a VAE.
    codes: Vec<Vec<u64>>,
}

/// Embeddings of clips and of their reconstructions, one after the other.
#[derive(Default)]
struct Embedded {
    real: Vec<f32>,
    made: Vec<f32>,
}

impl Embedded {
    /// Adds a clip and its reconstruction, both rows in the data's own scale.
    fn add(&mut self, evaluator: &TrainedEvaluator, real: Vec<f32>, made: Vec<f32>) {
        self.real.extend(evaluator.motions(&[real]));
        self.made.extend(evaluator.motions(&[made]));
    }

    fn to_bytes(&self, width: usize) -> Result<Vec<u8>, StageError> {
        let rows = |values: &[f32]| [values.len() / width, width];
        let tensors = Tensors::default().with("real", rows(&self.real), self.real.clone());
        tensors.with("made", rows(&self.made), self.made.clone()).to_bytes()
    }

    /// Merges the embeddings of all shards.
    fn gather(cx: &dyn AttemptContext, shards: &[Digest]) -> Result<Self, StageError> {
        let mut all = Self::default();
        for digest in shards {
            let bytes = artifacts::mapped(&*cx.blobs(), &cx.manifest(*digest)?, EMBEDDINGS_FILE)?;
            let mut tensors = Tensors::from_bytes(bytes, EMBEDDINGS_FILE)?;
            all.real.extend_from_slice(&tensors.take("real", 2, EMBEDDINGS_FILE)?.values);
            all.made.extend_from_slice(&tensors.take("made", 2, EMBEDDINGS_FILE)?.values);
        }
        Ok(all)
    }

    fn fid(&self, width: usize) -> f64 {
        let fit = |values: &[f32]| Gaussian::fit(&to_f64(values), width);
        fit(&self.real).distance(&fit(&self.made)).max(0.0)
    }
}

/// Opens the evaluator for FID, if the stage has one.
fn evaluator(cx: &dyn AttemptContext, name: &str) -> Result<Option<(Digest, TrainedEvaluator)>, StageError> {
    if name.is_empty() {
        return Ok(None);
    }
    let (digest, manifest) = artifacts::input(cx, "evaluator", ArtifactKind::Evaluator)?;
    Ok(Some((digest, TrainedEvaluator::read(&*cx.blobs(), &manifest, &cx.device())?)))
}

/// Refuses FID over a single clip.
fn check_fid(clips: usize) -> Result<(), StageError> {
    if clips >= 2 {
        return Ok(());
    }
    Err(StageError::Input("FID needs at least 2 clips, but the split has 1; leave `evaluator` out".into()))
}

/// Share of codes in use and their perplexity, each a mean over the codebooks.
fn usage(codes: &[Vec<u64>]) -> Vec<(String, f64)> {
    if codes.is_empty() {
        return Vec::new();
    }
    let mean = |of: fn(&Vec<u64>) -> f64| codes.iter().map(of).sum::<f64>() / codes.len() as f64;
    let used = mean(|counts| counts.iter().filter(|count| **count > 0).count() as f64 / counts.len() as f64);
    let perplexity = mean(|counts| {
        let counts: Vec<f32> = counts.iter().map(|count| *count as f32).collect();
        models::quantizer::perplexity(&counts)
    });
    vec![("used".to_owned(), used), ("perplexity".to_owned(), perplexity)]
}

impl Map for EvaluateReconstruction {
    fn repetitions(&self, entries: &dyn Fn(Split) -> f64) -> f64 {
        entries(self.split)
    }

    fn shard(&self, cx: &mut dyn AttemptContext, index: usize, of: usize) -> Result<Outcome, StageError> {
        let dataset = artifacts::input_dataset(cx)?;
        let measured = Reconstructor::read(cx, self.decoder_steps)?;
        measured.check_format(dataset.format)?;
        let entries = dataset.entries_of(self.split);
        if entries.is_empty() {
            return Err(no_entries(self.split));
        }
        let evaluator = evaluator(cx, &self.evaluator)?.map(|(_, evaluator)| evaluator);
        if let Some(evaluator) = &evaluator {
            evaluator.check(&dataset, &entries)?;
            check_fid(entries.len())?;
        }
        let mut embedded = Embedded::default();
        let range = shard_range(entries.len(), index, of);
        let total = range.len() as u64;
        let skeleton = dataset.skeleton();
        let width = dataset.mean.len();
        let seed = cx.task().seed;
        let (mean, std) = measured.statistics();
        let mut codes = measured.no_codes();
        let mut rows = Vec::with_capacity(range.len());
        for &e in &entries[range] {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let entry = &dataset.entries[e];
            let frames = (entry.len / skeleton.unit * skeleton.unit).max(entry.len.min(skeleton.unit));
            let mut truth = dataset.features(entry)[..frames * width].to_vec();
            measured.check_frames(&entry.id, frames)?;
            let natural = truth.clone();
            measured.normalise(&mut truth);
            let mut stream = Stream::new(seed, "evaluate.reconstruction/noise", 0, e as u64);
            let (sample, mu) = measured.guesses(&truth, frames, &mut stream, &mut codes);
            if let Some(evaluator) = &evaluator {
                let mut made = sample.clone();
                measured.denormalise(&mut made);
                embedded.add(evaluator, natural, made);
            }
            let errors = |guess: &[f32]| ClipErrors::between(&truth, guess, mean, std, skeleton);
            rows.push(Row {
                entry: entry.id.clone(),
                sample: errors(&sample),
                mu: mu.map(|mu| errors(&mu)),
                clip_mean: errors(&time_mean(&truth, width)),
                real_physics: real_physics(&truth, mean, std, skeleton),
                real_still: real_still(&truth, mean, std, skeleton),
            });
            cx.progress(rows.len() as u64, total, "clips", &[]);
        }
        let rows = Rows { format: dataset.format, rows, codes };
        let bytes = serde_json::to_vec(&rows).map_err(|e| StageError::Fault(e.to_string()))?;
        let mut draft = Draft::new(cx, ArtifactKind::Shard, json!({"shard": index, "of": of}));
        draft.add(REPORT_FILE, bytes)?;
        if let Some(evaluator) = &evaluator {
            draft.add(EMBEDDINGS_FILE, embedded.to_bytes(evaluator.width())?)?;
        }
        let output = draft.finish(cx)?;
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
                Some(whole) => {
                    whole.rows.extend(rows.rows);
                    for (all, counts) in whole.codes.iter_mut().zip(rows.codes) {
                        all.iter_mut().zip(counts).for_each(|(all, count)| *all += count);
                    }
                }
            }
        }
        let Rows { format, rows, codes } =
            whole.ok_or_else(|| StageError::Fault("no shard of the evaluation was given".into()))?;
        let skeleton = Skeleton::of(format);
        let column = |of: fn(&Row) -> ClipErrors| rows.iter().map(of).collect::<Vec<_>>();
        let mut metrics = summary(&column(|r| r.sample), skeleton, "");
        let means: Vec<ClipErrors> = rows.iter().filter_map(|row| row.mu).collect();
        if !means.is_empty() {
            metrics.extend(summary(&means, skeleton, "mu_"));
        }
        metrics.extend(usage(&codes));
        metrics.extend(summary(&column(|r| r.clip_mean), skeleton, "clip_mean_"));
        let real: Vec<f64> = rows.iter().flat_map(|row| row.real_physics).collect();
        metrics.extend(mean_physics(&real).map(|(name, value)| (format!("real_{name}"), value)));
        let still: Vec<f64> = rows.iter().filter_map(|row| row.real_still).collect();
        if !still.is_empty() {
            metrics.insert("real_still_ratio".into(), still.iter().sum::<f64>() / still.len() as f64);
        }
        metrics.insert("millimetres_per_unit".into(), 1000.0 * skeleton.metres_per_unit);
        let mut meta = json!({"kind": cx.task().settings.kind()});
        if let Some((digest, evaluator)) = evaluator(cx, &self.evaluator)? {
            let width = evaluator.width();
            metrics.insert("fid".into(), Embedded::gather(cx, shards)?.fid(width));
            meta["evaluator"] = to_meta(&digest);
            meta["words"] = to_meta(&evaluator.meta().words);
            if rows.len() < FEW * width {
                cx.log(&format!(
                    "FID uses {} clips in {width} dimensions; compare it only with FIDs of as many clips in the same \
                     evaluator",
                    rows.len()
                ));
            }
        }
        if metrics.values().any(|v| !v.is_finite()) {
            return Err(StageError::Input(
                "the reconstructions are not finite; their model is not trained well enough".into(),
            ));
        }
        meta["metrics"] = json!(metrics);
        let bytes = protocol::canonical::to_bytes(&json!({"metrics": metrics, "details": rows}));
        let output = artifacts::publish(cx, ArtifactKind::Report, meta, REPORT_FILE, bytes)?;
        Ok(Outcome::Finished { output, metrics })
    }
}
