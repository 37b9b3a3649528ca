//! Average inference time per sentence (AITS), for several models side by side.
//!
//! Source: MLD and MotionLCM, which divide the time of a test set by its sentences. One sentence at a time is timed
//! with the model loaded, from the text to the decoded motion, without the conversion of features to joints. Departs:
//! every motion has the same length. The text encoder is that of the model: hashed words cost nothing, where the
//! papers' CLIP and T5 are most of a one-step model's time. The conversion of features to the data's own scale is
//! included. The first sentences, during which caches fill, are left out. Only times of one machine can be compared, so
//! a time is never a stage's value.

use std::time::Duration;

use motion::synthetic;
use protocol::Seed;
use protocol::stage::{DataSynthetic, Sampler};

use super::Generator;
use crate::context::StageError;
use crate::parts::text;

pub use crate::generate::Timing;

/// Number of first sentences of each model that are not counted.
pub const WARM_UP: usize = 5;

/// Statistics of the times of many sentences, in seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Times {
    /// Number of sentences.
    pub sentences: usize,
    /// AITS, the mean time.
    pub mean: f64,
    /// Median time.
    pub median: f64,
    /// 95th percentile of the times.
    pub p95: f64,
    /// Mean time of embedding the text.
    pub text: f64,
    /// Mean time of the sampler.
    pub sampling: f64,
    /// Mean time of decoding.
    pub decoding: f64,
}

impl Times {
    /// Computes the statistics; `None` without sentences.
    pub fn of(timings: &[Timing]) -> Option<Self> {
        let mut seconds: Vec<f64> = timings.iter().map(|t| t.total().as_secs_f64()).collect();
        seconds.sort_by(f64::total_cmp);
        let count = seconds.len();
        // The smallest value that `percent` of all do not exceed.
        let rank = |percent: usize| seconds.get((count * percent).div_ceil(100).max(1) - 1).copied();
        let mean =
            |of: fn(&Timing) -> Duration| timings.iter().map(|t| of(t).as_secs_f64()).sum::<f64>() / count as f64;
        Some(Self {
            sentences: count,
            mean: mean(Timing::total),
            median: rank(50)?,
            p95: rank(95)?,
            text: mean(|t| t.text),
            sampling: mean(|t| t.sampling),
            decoding: mean(|t| t.decoding),
        })
    }
}

/// Runs each of `models` on each of `sentences`, sentence by sentence all models, so that other load of the machine
/// affects all alike. Each sentence starts with another model. The results of the first `warm_up` rounds are dropped.
fn side_by_side<T>(
    models: usize,
    sentences: usize,
    warm_up: usize,
    mut said: impl FnMut(usize, usize) -> Result<T, StageError>,
) -> Result<Vec<Vec<T>>, StageError> {
    let mut all: Vec<Vec<T>> = (0..models).map(|_| Vec::with_capacity(sentences)).collect();
    let rounds = (0..if sentences == 0 { 0 } else { warm_up }).map(|i| (i % sentences, false));
    for (sentence, counts) in rounds.chain((0..sentences).map(|i| (i, true))) {
        for turn in 0..models {
            let model = (sentence + turn) % models;
            let said = said(model, sentence)?;
            if counts {
                all[model].push(said);
            }
        }
    }
    Ok(all)
}

/// Times models with their samplers, one motion of `frames` frames per sentence. Returns the times of each model by
/// sentence. `done` is called after each motion, including warm-up.
pub fn time(
    models: &[(&Generator, &Sampler)],
    sentences: &[String],
    frames: Option<usize>,
    done: &mut dyn FnMut(),
) -> Result<Vec<Vec<Timing>>, StageError> {
    side_by_side(models.len(), sentences.len(), WARM_UP, |model, sentence| {
        let (generator, sampler) = models[model];
        // Sentences repeat, and models may share an encoder.
        text::forget();
        let motion = generator.generate(&sentences[sentence], frames, Some(sampler), Seed(sentence as u64))?;
        done();
        Ok(motion.timing)
    })
}

/// Sentences for timing: captions of synthetic clips.
pub fn sentences(count: usize) -> Vec<String> {
    let clips = DataSynthetic { clips: count, val: 0.0, test: 0.0, mirror: false };
    let dataset = synthetic::generate(&clips, Seed(0));
    let first = dataset.entries.iter().filter_map(|entry| dataset.captions.get(*entry.captions.first()?));
    first.take(count).map(|caption| caption.text.clone()).collect()
}

/// Number of threads that this process computes with.
pub fn threads() -> usize {
    rayon::current_num_threads()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sentence_counts_once_for_every_model_and_the_warm_up_not_at_all() {
        let mut said = Vec::new();
        let all = side_by_side(3, 4, 2, |model, sentence| {
            said.push((model, sentence));
            Ok(said.len())
        })
        .expect("nobody fails");
        assert_eq!(said.len(), 3 * (2 + 4), "warm-up and all");
        assert!(all.iter().all(|times| times.len() == 4), "{all:?}");
        assert!(all.iter().flatten().all(|nth| *nth > 3 * 2), "the first rounds are left out: {all:?}");
        for round in said.chunks(3) {
            let mut models: Vec<usize> = round.iter().map(|(model, _)| *model).collect();
            models.sort_unstable();
            assert_eq!(models, [0, 1, 2], "sentence by sentence, all models: {said:?}");
            assert!(round.iter().all(|(_, sentence)| *sentence == round[0].1));
        }
        let counted: Vec<usize> = said[6..].chunks(3).map(|round| round[0].1).collect();
        assert_eq!(counted, [0, 1, 2, 3]);
        let firsts: Vec<usize> = said[6..].chunks(3).map(|round| round[0].0).collect();
        assert_eq!(firsts, [0, 1, 2, 0], "none is always first");
        assert_eq!(side_by_side(2, 0, 5, |_, _| Ok(())).expect("nobody fails"), [vec![], vec![]]);
    }

    #[test]
    fn the_time_per_sentence_is_the_mean_of_all_three_parts() {
        let timing = |ms| Timing {
            text: Duration::from_millis(ms),
            sampling: Duration::from_millis(10 * ms),
            decoding: Duration::from_millis(100 * ms),
        };
        let times = Times::of(&[timing(1), timing(3)]).expect("two sentences");
        assert_eq!((times.sentences, times.mean, times.median, times.p95), (2, 0.222, 0.111, 0.333));
        assert_eq!((times.text, times.sampling, times.decoding), (0.002, 0.02, 0.2));
        let hundred: Vec<Timing> = (1..=100).rev().map(timing).collect();
        let times = Times::of(&hundred).expect("a hundred sentences");
        assert_eq!((times.median, times.p95), (5.55, 10.545));
        assert_eq!(Times::of(&[]), None);
    }

    #[test]
    fn there_are_as_many_sentences_as_asked_for() {
        for count in [0, 1, 7, 100] {
            assert_eq!(sentences(count).len(), count);
        }
        let all = sentences(100);
        assert!(all.iter().all(|sentence| sentence.split_whitespace().count() > 2), "{all:?}");
        assert_eq!(all, sentences(100));
    }
}
