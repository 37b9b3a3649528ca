//! Free-T2M's losses on predicted motions: on their slow part, and on the agreement of their embeddings with those of
//! real motions. Each acts only at some noise levels. Source and departures: `models::frequency` and
//! `protocol::stage::frequency`.

use burn::tensor::{Int, Tensor, TensorData};
use models::diffusion::{Schedule, affine, unzip};
use models::frequency::{Agreement, Stage, high_frequency, low_frequency, semantic};
use models::losses::Pointwise;
use protocol::ArtifactKind;
use protocol::stage::{Band, DataFormat, FrequencyLosses, Norm, Over};

use super::Losses;
use crate::artifacts::{self, word};
use crate::context::{AttemptContext, StageError};
use crate::parts::evaluator::TrainedEvaluator;

/// Name of the term on the slow part.
pub(crate) const LOW_FREQUENCY: &str = "low_frequency";
pub(crate) const SEMANTIC: &str = "semantic";

/// Largest factor of the network's output in the clean sample. Timesteps with a larger one are left out: the clean
/// sample there is mostly the output's error.
const MOST_GAIN: f64 = 10.0;

/// The loss terms of a stage.
#[derive(Debug)]
pub(crate) struct FrequencyTerms {
    settings: FrequencyLosses,
    low: Stage,
    meaning: Stage,
    evaluator: Option<TrainedEvaluator>,
    mean: Vec<f32>,
    std: Vec<f32>,
    readable: Vec<bool>,
}

/// The predictions of a slice, and their targets.
pub(crate) struct Predicted<'a> {
    /// Predicted clean motions [B, T, F], normalised.
    pub(crate) found: Tensor<3>,
    /// Target motions of the same shape.
    pub(crate) target: Tensor<3>,
    /// Number of frames of each motion.
    pub(crate) lengths: &'a [usize],
    /// Timestep of each motion.
    pub(crate) timesteps: &'a [usize],
    /// Timesteps of all samples with these terms, over all slices.
    pub(crate) batch_timesteps: &'a [usize],
}

/// Computes the clean samples that a network's outputs imply at `timesteps`.
pub(crate) fn clean(schedule: &Schedule, noisy: Tensor<3>, out: Tensor<3>, timesteps: &[usize]) -> Tensor<3> {
    let pairs: Vec<(f64, f64)> = timesteps.iter().map(|t| schedule.clean(*t)).collect();
    if pairs.iter().all(|pair| *pair == (0.0, 1.0)) {
        return out;
    }
    let (a, e) = unzip(pairs);
    affine(noisy, out, &a, &e)
}

impl FrequencyTerms {
    /// Creates the configured terms for motions of `format`, normalised with `mean` and `std`; `None` if all weights
    /// are zero.
    pub(crate) fn read(
        cx: &dyn AttemptContext,
        settings: &FrequencyLosses,
        schedule: &Schedule,
        format: DataFormat,
        (mean, std): (&[f32], &[f32]),
    ) -> Result<Option<Self>, StageError> {
        if !settings.any() {
            return Ok(None);
        }
        let evaluator = match settings.semantic.weight > 0.0 {
            true => {
                let (_, manifest) = artifacts::input(cx, FrequencyLosses::EVALUATOR, ArtifactKind::Evaluator)?;
                Some(TrainedEvaluator::read(&*cx.blobs(), &manifest, &cx.device())?)
            }
            false => None,
        };
        if let Some(evaluator) = &evaluator
            && evaluator.meta().format != format
        {
            let ours = word(&format);
            let theirs = word(&evaluator.meta().format);
            return Err(StageError::Input(format!(
                "`{}` embeds motions in format `{theirs}`, but the clips have format `{ours}`; train an evaluator on \
                 these clips",
                FrequencyLosses::EVALUATOR
            )));
        }
        let steps = schedule.steps();
        let low = &settings.low_frequency;
        let meaning = &settings.semantic;
        Ok(Some(Self {
            low: Stage::of_shares(low.from, low.to, steps),
            meaning: Stage::of_shares(meaning.from, meaning.to, steps),
            settings: settings.clone(),
            evaluator,
            mean: mean.to_vec(),
            std: std.to_vec(),
            readable: (0..steps).map(|t| schedule.clean(t).1.abs() <= MOST_GAIN).collect(),
        }))
    }

    /// Returns true if any term acts at timestep `t`.
    pub(crate) fn acts(&self, t: usize) -> bool {
        let low = &self.settings.low_frequency;
        let meaning = &self.settings.semantic;
        (low.weight > 0.0 && self.in_stage(&self.low, t)) || (meaning.weight > 0.0 && self.in_stage(&self.meaning, t))
    }

    fn in_stage(&self, stage: &Stage, t: usize) -> bool {
        stage.has(t) && self.readable[t]
    }

    /// The weight of each sample of the slice, so that dividing by the global batch gives the configured mean.
    fn weights(&self, stage: &Stage, over: Over, predicted: &Predicted<'_>, global: usize) -> Vec<f32> {
        let count = predicted.batch_timesteps.iter().filter(|t| self.in_stage(stage, **t)).count();
        let one = match over {
            Over::Stage => global as f32 / count.max(1) as f32,
            Over::Batch => 1.0,
        };
        predicted.timesteps.iter().map(|t| if self.in_stage(stage, *t) { one } else { 0.0 }).collect()
    }

    /// Adds the terms of a slice of a batch of `global` samples.
    pub(crate) fn add(&self, losses: &mut Losses, predicted: &Predicted<'_>, global: usize) {
        let batch = predicted.lengths.len();
        let frames = predicted.found.dims()[1];
        let low = &self.settings.low_frequency;
        let weights = self.weights(&self.low, low.over, predicted, global);
        if low.weight > 0.0 && weights.iter().any(|weight| *weight > 0.0) {
            let whole = vec![frames; batch];
            let lengths = if low.masked { predicted.lengths } else { &whole };
            let distance = match low.distance {
                Norm::L1 => Pointwise::L1,
                Norm::L2 => Pointwise::L2,
            };
            let found = predicted.found.clone();
            let target = predicted.target.clone();
            let term = match low.band {
                Band::Slow => low_frequency,
                Band::Fast => high_frequency,
            };
            let sum = term(found, target, lengths, low.keep.min(frames), distance, &weights);
            losses.add(LOW_FREQUENCY, sum, low.weight);
        }
        let meaning = &self.settings.semantic;
        let weights = self.weights(&self.meaning, meaning.over, predicted, global);
        let chosen: Vec<usize> = (0..batch).filter(|b| weights[*b] > 0.0).collect();
        if let Some(evaluator) = &self.evaluator
            && !chosen.is_empty()
        {
            let indices: Vec<i64> = chosen.iter().map(|b| *b as i64).collect();
            let rows = |x: &Tensor<3>| {
                let indices =
                    Tensor::<1, Int>::from_data(TensorData::new(indices.clone(), [indices.len()]), &x.device());
                x.clone().select(0, indices)
            };
            let lengths: Vec<usize> = chosen.iter().map(|b| predicted.lengths[*b]).collect();
            let weights: Vec<f32> = chosen.iter().map(|b| weights[*b]).collect();
            let embed = |x: Tensor<3>| evaluator.embed_normalised(x, &lengths, &self.mean, &self.std);
            let target = embed(rows(&predicted.target));
            // With a threshold of 1 the hinge is the cosine distance itself.
            let agreement = match meaning.threshold < 1.0 {
                true => Agreement::Below(meaning.threshold),
                false => Agreement::Cosine,
            };
            losses.add(SEMANTIC, semantic(embed(rows(&predicted.found)), target, agreement, &weights), meaning.weight);
        }
    }
}
