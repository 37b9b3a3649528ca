//! `evaluate.recognition`: the share of motions that show the activity of their captions. Source: the recognition
//! accuracy of Action2Motion (Guo et al., 2020), with classes from captions and a classifier of ours.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, PHYSICS, Problems, Ref, Sampler, Shape, Split, StageSpec};

/// An activity that the classifier recognises.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Activity {
    /// Name of the activity.
    pub name: String,
    /// Phrases of one or more words; a caption with one of them describes the activity.
    pub words: Vec<String>,
    /// Draws one of its motions on the sheet.
    #[serde(default)]
    pub sheet: bool,
}

/// `evaluate.recognition`: trains a classifier of activities on real clips of the train split. It measures the share of
/// generated motions that are classified as their caption's activity (`accuracy`, and `accuracy/NAME`). It also measures
/// that of real clips of `split` (`real_accuracy`), and of these clips as the model's VAE or tokenizer reconstructs them
/// (`reconstructed_accuracy`). It has the physical measures of the motions, and as `real_...` those of the clips. The
/// report has a contact sheet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateRecognition {
    /// Stage that gives the model.
    pub model: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Activities, in order of priority. A clip shows the first one with a phrase in a caption. Clips whose captions
    /// differ in this, or have no phrase, are left out.
    pub activities: Vec<Activity>,
    /// Sampler for the model.
    pub sampler: Sampler,
    /// Number of motions, divided among the activities in turn.
    #[schemars(range(min = 1, max = 10_000), extend("x-unit" = "motions"))]
    pub motions: usize,
    /// Split of the clips for captions and lengths, and for the comparison with real motion.
    pub split: Split,
}

/// Common activities of users' prompts, in words of HumanML3D's captions.
fn usual() -> Vec<Activity> {
    let activity = |(name, words): (&str, &[&str])| Activity {
        name: name.to_owned(),
        words: words.iter().map(|word| (*word).to_owned()).collect(),
        sheet: true,
    };
    let all: [(&str, &[&str]); 7] = [
        ("jump", &["jumps", "jumping"]),
        ("kick", &["kicks", "kicking"]),
        ("wave", &["waves", "waving"]),
        ("sit", &["sits", "sitting"]),
        ("run", &["runs", "running", "jogs", "jogging"]),
        ("turn", &["turns", "turning"]),
        ("walk", &["walks", "walking"]),
    ];
    all.map(activity).to_vec()
}

impl Default for EvaluateRecognition {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            dataset: "dataset".into(),
            activities: usual(),
            sampler: Sampler::default(),
            motions: 200,
            split: Split::Test,
        }
    }
}

impl StageSpec for EvaluateRecognition {
    const KIND: &'static str = "evaluate.recognition";
    // Version 4 classifies smoothed paths and positions, and reconstructions too.
    const VERSION: u32 = 6;
    const SHAPE: Shape = Shape::Plain;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("model", &mut self.model, ArtifactKind::Model).measured_if(true),
        ]
    }

    fn check(&self, p: &mut Problems) {
        const HELP: &str =
            "for example `activities: [{name: walk, words: [walks, walking]}, {name: run, words: [runs, running]}]`";
        if self.activities.len() < 2 {
            p.add(
                "activities",
                format!("`activities` has {} entries; expected at least two", self.activities.len()),
                HELP,
            );
        }
        for (i, activity) in self.activities.iter().enumerate() {
            let name = &activity.name;
            if name.is_empty() || self.activities[..i].iter().any(|other| other.name == *name) {
                p.add(
                    "activities",
                    format!("the activity name `{name}` is empty or used twice"),
                    "give each activity a name of its own",
                );
            }
            if activity.words.is_empty() || activity.words.iter().any(|words| words.split_whitespace().next().is_none())
            {
                p.add("activities", format!("`{name}` has no words, or an empty word"), HELP);
            }
        }
        self.sampler.check(p);
        if self.split == Split::Train {
            p.add("split", "the classifier is trained on the split `train`", "use `val`, `test` or `all`");
        }
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        stages.same_skeleton(p, ("model", &self.model), &self.dataset);
        stages.check_sampler(p, &self.model, &self.sampler);
    }

    fn sampler(&self) -> Option<&Sampler> {
        Some(&self.sampler)
    }

    fn metrics(&self) -> Option<BTreeSet<String>> {
        let shares = ["accuracy", "real_accuracy", "reconstructed_accuracy"].map(str::to_owned).into_iter();
        let physics = PHYSICS.iter().flat_map(|name| [(*name).to_owned(), format!("real_{name}")]);
        Some(
            shares
                .chain(physics)
                .chain(self.activities.iter().map(|activity| format!("accuracy/{}", activity.name)))
                .collect(),
        )
    }
}
