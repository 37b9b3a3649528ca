//! `evaluate.recognition`: the share of motions that show the activity of their captions. Source: the recognition
//! accuracy of Action2Motion (Guo et al., 2020).
//!
//! A clip's activity comes from its captions: the first activity with a word in them. A classifier
//! ([`crate::metrics::recognition`]) is trained on clips of the train split, at most [`TAUGHT`] per activity. Then
//! motions are generated for captions and lengths of `split`, activity by activity in turn, keyed by (seed, number of
//! the motion). A motion is correct if the classifier predicts its caption's activity. An activity without a clip in
//! `split` is reported and skipped. Clips of `split` are classified as they are and as the model's VAE or tokenizer
//! reconstructs them, which shows what the model could reach at best.
//!
//! Departs: the paper's classifier is a recurrent network and its classes are labels; ours is a closed form, and
//! classes are words.
//!
//! Files: the report, and `contact-sheet.png` with the first motion of each activity that has `sheet: true`.

use std::collections::BTreeMap;
use std::rc::Rc;

use motion::dataset::{Dataset, Entry, crop};
use motion::features::recover_joints;
use motion::random::permutation;
use motion::{Skeleton, Stream, draw};
use protocol::stage::{Activity, EvaluateRecognition, Split};
use serde_json::json;

use crate::artifacts::word;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::measured::measured;
use crate::evaluation::report::{finite, no_entries, publish_illustrated};
use crate::generate::generator::{self, Batch};
use crate::kinds::shape::Plain;
use crate::metrics::physics::{mean_physics, physics_of_features};
use crate::metrics::recognition::{Classifier, describe};

/// Largest number of training clips per activity; the training time grows with the cube of all clips.
const TAUGHT: usize = 64;
/// Number of motions computed together.
const BLOCK: usize = 32;
/// Number of poses per motion on the sheet.
const POSES: usize = 9;

/// Words of a sentence, in lower case and without surrounding punctuation.
fn words(text: &str) -> Vec<String> {
    text.split(|c: char| !c.is_alphanumeric() && c != '\'').filter(|w| !w.is_empty()).map(str::to_lowercase).collect()
}

/// Phrases of each activity, as lists of words.
struct Vocabulary(Vec<Vec<Vec<String>>>);

impl Vocabulary {
    fn of(activities: &[Activity]) -> Self {
        Self(activities.iter().map(|activity| activity.words.iter().map(|phrase| words(phrase)).collect()).collect())
    }

    /// The first activity with a phrase in the sentence.
    fn names(&self, sentence: &str) -> Option<usize> {
        let sentence = words(sentence);
        let has =
            |phrase: &Vec<String>| !phrase.is_empty() && sentence.windows(phrase.len()).any(|part| part == phrase);
        self.0.iter().position(|phrases| phrases.iter().any(has))
    }

    /// The activity of all captions of an entry; `None` if they differ or one has none.
    fn shown(&self, dataset: &Dataset, entry: &Entry) -> Option<usize> {
        let mut named = entry.captions.iter().map(|caption| self.names(&dataset.captions[*caption].text));
        let first = named.next()??;
        named.all(|other| other == Some(first)).then_some(first)
    }
}

/// Entries of a split by activity.
fn by_activity(dataset: &Dataset, vocabulary: &Vocabulary, split: Split) -> Vec<Vec<usize>> {
    let mut found = vec![Vec::new(); vocabulary.0.len()];
    for e in dataset.entries_of(split) {
        if let Some(activity) = vocabulary.shown(dataset, &dataset.entries[e]) {
            found[activity].push(e);
        }
    }
    found
}

/// A motion to be generated.
struct Asked {
    activity: usize,
    caption: usize,
    length: usize,
}

impl Asked {
    /// Draws one of `entries`, which are those of `activity`, with a caption and a length.
    fn draw(draw: &mut Stream, dataset: &Dataset, activity: usize, entries: &[usize]) -> Self {
        let entry = &dataset.entries[entries[draw.below(entries.len())]];
        let caption = entry.captions[draw.below(entry.captions.len())];
        Self { activity, caption, length: crop(draw, entry.len, dataset.skeleton()).1 }
    }
}

/// A motion that was generated.
struct Drawn {
    asked: Asked,
    taken: usize,
    rows: Vec<f32>,
}

/// The settings, with methods for the computed values.
struct Recognition<'a>(&'a EvaluateRecognition);

impl Recognition<'_> {
    /// Trains the classifier on clips of the train split.
    fn taught(
        &self,
        cx: &dyn AttemptContext,
        dataset: &Dataset,
        vocabulary: &Vocabulary,
    ) -> Result<Classifier, StageError> {
        let mut motions = Vec::new();
        let mut labels = Vec::new();
        let train = by_activity(dataset, vocabulary, Split::Train);
        for (activity, entries) in train.iter().enumerate() {
            if entries.is_empty() {
                return Err(self.unknown(activity, Split::Train));
            }
            let order = permutation(cx.task().seed, "evaluate.recognition/taught", activity as u64, entries.len());
            for i in order.into_iter().take(TAUGHT) {
                let entry = &dataset.entries[entries[i as usize]];
                motions.push(describe(dataset.features(entry), dataset.skeleton()));
                labels.push(activity);
            }
        }
        Classifier::fit(&motions, &labels, train.len()).ok_or_else(|| {
            StageError::Input("the training clips are too few or too similar to learn the activities from".into())
        })
    }

    fn unknown(&self, activity: usize, split: Split) -> StageError {
        let Activity { name, words, .. } = &self.0.activities[activity];
        StageError::Input(format!(
            "no clip of the split `{}` shows `{name}`; in such a clip, each caption has one of \"{}\", and no word of \
             an earlier activity",
            word(&split),
            words.join("\", \"")
        ))
    }
}

impl Plain for EvaluateRecognition {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (dataset, model) = measured(cx, &self.sampler)?;
        if dataset.entries_of(self.split).is_empty() {
            return Err(no_entries(self.split));
        }
        let vocabulary = Vocabulary::of(&self.activities);
        let classifier = Recognition(self).taught(cx, &dataset, &vocabulary)?;
        let looked_at = by_activity(&dataset, &vocabulary, self.split);
        let present: Vec<usize> = (0..looked_at.len()).filter(|activity| !looked_at[*activity].is_empty()).collect();
        for (activity, _) in looked_at.iter().enumerate().filter(|(_, entries)| entries.is_empty()) {
            cx.log(&format!("{}; this activity is left out", Recognition(self).unknown(activity, self.split)));
        }
        if present.is_empty() {
            return Err(no_entries(self.split));
        }
        let seed = cx.task().seed;
        let stream = |what: &str, i: usize| Stream::new(seed, &format!("evaluate.recognition/{what}"), 0, i as u64);
        let reconstruct = |e: usize, rows: &[f32]| model.reconstruct(rows, &mut stream("reconstruction", e));
        let real = Real::of(&dataset, &classifier, &looked_at, &reconstruct);

        let mut asked = Vec::with_capacity(self.motions);
        for i in 0..self.motions {
            let activity = present[i % present.len()];
            asked.push(Asked::draw(&mut stream("entry", i), &dataset, activity, &looked_at[activity]));
        }
        let mut drawn: Vec<Drawn> = Vec::new();
        while !asked.is_empty() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let block: Vec<Asked> = asked.drain(..BLOCK.min(asked.len())).collect();
            let captions: Vec<&str> = block.iter().map(|a| dataset.captions[a.caption].text.as_str()).collect();
            let texts: Vec<_> = model.embed(&captions)?.into_iter().map(Rc::new).collect();
            let lengths: Vec<usize> = block.iter().map(|a| a.length).collect();
            let first = drawn.len();
            let seeds = |k: usize, i: usize| stream(&format!("noise {k}"), first + i);
            let batch = Batch { texts: &texts, lengths: &lengths, seeds: &seeds, control: None };
            for (asked, rows) in block.into_iter().zip(generator::motions(&*model, batch, &self.sampler, &mut |_| {})?)
            {
                drawn.push(Drawn { asked, taken: classifier.classify(&describe(&rows, dataset.skeleton())), rows });
            }
            cx.progress(drawn.len() as u64, self.motions as u64, "motions", &[]);
        }
        let metrics = Recognition(self).metrics_of(&drawn, &real, dataset.skeleton());
        finite(&metrics)?;
        let sheet = Recognition(self).sheet(&dataset, &drawn)?;
        let name = |activity: usize| &self.activities[activity].name;
        let table: Vec<_> = drawn
            .iter()
            .map(|d| json!({"caption": dataset.captions[d.asked.caption].text, "frames": d.asked.length, "named": name(d.asked.activity), "taken": name(d.taken)}))
            .collect();
        let details = json!({
            "motions": table,
            "real": {"clips": real.clips, "right": real.right, "reconstructed_right": real.reconstructed_right},
            "split": self.split,
            "sampler": self.sampler,
        });
        let pictures = sheet.map(|bytes| ("contact-sheet.png", bytes)).into_iter().collect();
        publish_illustrated(cx, metrics, json!({}), details, pictures)
    }
}

/// Real clips of the split: their number and that of correct predictions by activity, and the physics of each.
struct Real {
    clips: Vec<usize>,
    right: Vec<usize>,
    /// Correct predictions for the reconstructions.
    reconstructed_right: Vec<usize>,
    physics: Vec<f64>,
}

impl Real {
    /// `reconstruct` gives the reconstruction of an entry's rows.
    fn of(
        dataset: &Dataset,
        classifier: &Classifier,
        looked_at: &[Vec<usize>],
        reconstruct: &dyn Fn(usize, &[f32]) -> Vec<f32>,
    ) -> Self {
        let mut right = vec![0; looked_at.len()];
        let mut reconstructed_right = right.clone();
        let mut physics = Vec::new();
        for (activity, entries) in looked_at.iter().enumerate() {
            for e in entries {
                let rows = dataset.features(&dataset.entries[*e]);
                let shows =
                    |rows: &[f32]| usize::from(classifier.classify(&describe(rows, dataset.skeleton())) == activity);
                right[activity] += shows(rows);
                reconstructed_right[activity] += shows(&reconstruct(*e, rows));
                physics.extend(physics_of_features(rows, dataset.skeleton()));
            }
        }
        let clips: Vec<usize> = looked_at.iter().map(Vec::len).collect();
        Self { physics, clips, right, reconstructed_right }
    }
}

impl Recognition<'_> {
    fn metrics_of(&self, drawn: &[Drawn], real: &Real, skeleton: &Skeleton) -> BTreeMap<String, f64> {
        let right = |drawn: &&Drawn| drawn.taken == drawn.asked.activity;
        let share = |part: usize, of: usize| part as f64 / of as f64;
        let of_real = |right: &[usize]| share(right.iter().sum(), real.clips.iter().sum());
        let made: Vec<f64> = drawn.iter().flat_map(|d| physics_of_features(&d.rows, skeleton)).collect();
        let mut metrics = BTreeMap::from([
            ("accuracy".to_owned(), share(drawn.iter().filter(right).count(), drawn.len())),
            ("real_accuracy".to_owned(), of_real(&real.right)),
            ("reconstructed_accuracy".to_owned(), of_real(&real.reconstructed_right)),
        ]);
        metrics.extend(mean_physics(&made));
        metrics.extend(mean_physics(&real.physics).map(|(name, value)| (format!("real_{name}"), value)));
        for (i, activity) in self.0.activities.iter().enumerate() {
            let of_it = || drawn.iter().filter(move |d| d.asked.activity == i);
            if of_it().next().is_some() {
                metrics.insert(
                    format!("accuracy/{}", activity.name),
                    share(of_it().filter(right).count(), of_it().count()),
                );
            }
        }
        metrics
    }

    /// Draws the first motion of each activity with `sheet: true`.
    fn sheet(&self, dataset: &Dataset, drawn: &[Drawn]) -> Result<Option<Vec<u8>>, StageError> {
        let skeleton = dataset.skeleton();
        let seen = self.0.activities.iter().enumerate().filter(|(_, activity)| activity.sheet);
        let first = seen.filter_map(|(i, _)| drawn.iter().find(|d| d.asked.activity == i));
        let motions: Vec<draw::Row> = first
            .map(|d| draw::Row {
                title: dataset.captions[d.asked.caption].text.clone(),
                note: self.0.sampler.to_string(),
                joints: recover_joints(&d.rows, skeleton),
            })
            .collect();
        if motions.is_empty() {
            return Ok(None);
        }
        let mut png = Vec::new();
        let fault = |e: std::io::Error| StageError::Fault(e.to_string());
        draw::sheet_to(&motions, POSES, skeleton, draw::Given::default(), &mut png).map_err(fault)?;
        Ok(Some(png))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_activity_whose_words_a_caption_has_is_named() {
        let activity = |name: &str, words: &[&str]| Activity {
            name: name.into(),
            words: words.iter().map(|w| (*w).to_owned()).collect(),
            sheet: false,
        };
        let known = [activity("circle", &["in a circle"]), activity("walk", &["walks", "walking"])];
        let vocabulary = Vocabulary::of(&known);
        assert_eq!(vocabulary.names("A person walks slowly, in a circle."), Some(0));
        assert_eq!(vocabulary.names("the man is Walking in a straight line"), Some(1));
        assert_eq!(vocabulary.names("a sleepwalker stands in a   circ le"), None, "parts of words are none");
    }
}
