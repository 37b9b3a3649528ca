//! `evaluate.recognition`: whether motions show what their captions name. Source: the recognition accuracy of Action2Motion (Guo et al., 2020), with
//! classes that are read off captions and a classifier of ours.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::ArtifactKind;
use crate::stage::{Neighbours, Output, Problems, Ref, Sampler, Shape, Split, StageSpec};

/// What a motion can be recognised as.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Activity {
    /// What it is called.
    pub name: String,
    /// Words, or several in a row, of which a caption of it has at least one.
    pub words: Vec<String>,
    /// Draws a motion of it into the sheet.
    #[serde(default)]
    pub sheet: bool,
}

/// `evaluate.recognition`: a classifier learns activities from the train split's real clips; measured is how many of the drawn motions it takes for what
/// their captions name (`accuracy`, and `accuracy/NAME`), beside real clips of `split` (`real_accuracy`), and the share of skating steps of both
/// (`skating`, `real_skating`). The report has a contact sheet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateRecognition {
    /// Stage that gives the model.
    pub model: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Activities. A clip is of the first whose words a caption has; one whose captions differ in that is left out, and so is one of none.
    pub activities: Vec<Activity>,
    /// Sampler.
    pub sampler: Sampler,
    /// Motions, dealt out to the activities in turn.
    pub motions: usize,
    /// Clips whose captions and lengths are drawn, and which are recognised for comparison.
    pub split: Split,
}

/// What people ask for first, in words of HumanML3D's captions.
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
            "such as `activities: [{name: walk, words: [walks, walking]}, {name: run, words: [runs, running]}]`";
        if self.activities.len() < 2 {
            p.add(
                "activities",
                format!("{} activities; expected at least two to tell apart", self.activities.len()),
                HELP,
            );
        }
        for (i, activity) in self.activities.iter().enumerate() {
            let name = &activity.name;
            if name.is_empty() || self.activities[..i].iter().any(|other| other.name == *name) {
                p.add("activities", format!("`{name}` is no name of its own"), "give each activity another name");
            }
            if activity.words.is_empty() || activity.words.iter().any(|words| words.split_whitespace().next().is_none())
            {
                p.add("activities", format!("`{name}` has no words, or an empty one"), HELP);
            }
        }
        self.sampler.check(p);
        p.positive("motions", self.motions);
        if self.split == Split::Train {
            p.add("split", "`train` is what the classifier learns from", "use `val`, `test` or `all`");
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
        let all = ["accuracy", "real_accuracy", "skating", "real_skating"].map(str::to_owned).into_iter();
        Some(all.chain(self.activities.iter().map(|activity| format!("accuracy/{}", activity.name))).collect())
    }
}
