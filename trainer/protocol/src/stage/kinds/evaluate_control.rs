//! `evaluate.control`: accuracy of motions at target positions, and its cost in quality. Source: OmniControl, MotionLCM
//! (tables 3 and 4).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::control::{check_skeleton, check_words};
use crate::stage::{ControlSetting, Neighbours, Output, Problems, Ref, Sampler, Shape, Split, StageSpec, TrainControl};
use crate::{ArtifactKind, limits};

/// `evaluate.control`: errors at target positions, with the control part and without it, by joints and density. Every
/// combination of `joints` with an entry of `percent` or `frames` is a case. Its metrics are named `METRIC/CASE`, such
/// as `average_error/six/25pct`; without a case a metric is the mean over the cases.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateControl {
    /// Stage that gives the model, of `train.control`.
    pub model: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the evaluator.
    pub evaluator: String,
    /// Frames and joints that get targets.
    pub setting: ControlSetting,
    /// Cases of joints: a joint, or `six`, `twelve` or `all` of them with targets together.
    pub joints: Vec<String>,
    /// Densities of targets in percent of the frames.
    #[schemars(inner(range(min = 0.0, max = 100.0)), extend("x-unit" = "percent of the frames"))]
    pub percent: Vec<f64>,
    /// Densities of targets as numbers of frames.
    #[schemars(inner(range(min = 1, max = 10_000)), extend("x-unit" = "frames"))]
    pub frames: Vec<usize>,
    /// Distance in metres beyond which a target is missed.
    #[schemars(range(max = 1e3), extend("exclusiveMinimum" = 0.0, "x-unit" = "metres"))]
    pub threshold: f64,
    /// Factor on the ControlNet's residuals and on the changes by feedback.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub scale: f64,
    /// Number of rounds of feedback on generated latents; each motion keeps the result of its best round. By default it
    /// is the number in the control part's training.
    #[schemars(range(min = 0, max = limits::FEEDBACK_ROUNDS), extend("x-unit" = "rounds"))]
    pub feedback: Option<usize>,
    /// Number of steps that refine generated latents towards the targets; 0, as published, refines nothing.
    #[schemars(range(min = 0, max = limits::REFINE_STEPS), extend("x-unit" = "steps"))]
    pub refine: usize,
    /// Sampler for the model.
    pub sampler: Sampler,
    /// Number of repeats with other noise, captions, crops and pools.
    #[schemars(range(min = 1, max = 100), extend("x-unit" = "repeats"))]
    pub repeats: usize,
    /// Split of the clips. Choose on `val`; keep `test` for the final result.
    pub split: Split,
    /// Uses all clips if the split has fewer than a pool of 32, and reports it; otherwise so small a split is refused.
    pub all_if_small: bool,
    /// Number of shards.
    #[schemars(range(min = 1, max = crate::limits::SHARDS), extend("x-unit" = "shards"))]
    pub shards: usize,
}

impl Default for EvaluateControl {
    fn default() -> Self {
        Self {
            model: "control".into(),
            dataset: "dataset".into(),
            evaluator: "evaluator".into(),
            setting: ControlSetting::Temporal,
            joints: vec!["six".into()],
            percent: vec![25.0],
            frames: Vec::new(),
            threshold: 0.5,
            scale: 1.0,
            feedback: None,
            refine: 0,
            sampler: Sampler { steps: 1, ..Sampler::default() },
            repeats: 20,
            split: Split::Val,
            all_if_small: false,
            shards: 8,
        }
    }
}

impl StageSpec for EvaluateControl {
    const KIND: &'static str = "evaluate.control";
    const VERSION: u32 = 5;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("evaluator", &mut self.evaluator, ArtifactKind::Evaluator),
            Ref::stage("model", &mut self.model, ArtifactKind::Model).measured_if(true),
        ]
    }

    fn check(&self, p: &mut Problems) {
        check_words(p, "joints", &self.joints);
        if self.percent.is_empty() && self.frames.is_empty() {
            p.add(
                "percent",
                "`percent` and `frames` are both empty, so there are no hints",
                "published: `percent: [25]`",
            );
        }
        for (i, percent) in self.percent.iter().enumerate() {
            if !(*percent > 0.0 && *percent <= 100.0) {
                let message = format!("`percent` has {percent}; expected numbers above 0 and at most 100");
                p.add(&format!("percent[{i}]"), message, "");
            }
        }
        self.sampler.check(p);
        let densities = self.percent.len() + self.frames.len();
        p.product(
            "joints",
            &[("repeats", self.repeats), ("joints", self.joints.len()), ("densities", densities)],
            limits::CONTROL_CASES,
        );
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let model = &self.model;
        let dataset = &self.dataset;
        let evaluator = &self.evaluator;
        if stages.stage(model).is_some_and(|stage| stage.get::<TrainControl>().is_none() && stage.family().is_some()) {
            let message = format!("`{model}` has no control part");
            p.add("model", message, "name a `train.control` stage");
        }
        let ours = stages.format(dataset);
        for (field, name) in [("evaluator", evaluator), ("model", model)] {
            if let (Some(ours), Some(theirs)) = (ours, stages.format(name))
                && ours != theirs
            {
                let theirs = theirs.skeleton();
                let ours = ours.skeleton();
                let message = format!("`{name}` has skeletons of {theirs}, but the clips of `{dataset}` have {ours}");
                p.add(field, message, "use a dataset in the model's format");
            }
        }
        if stages.evaluator_of_model(model) == Some(evaluator) {
            let message =
                format!("`{evaluator}` was part of the training loss of `{model}`, so its metrics would be biased");
            p.add("evaluator", message, "train a second evaluator and measure with that one");
        }
        check_skeleton(p, "joints", &self.joints, ours);
        stages.check_sampler(p, model, &self.sampler);
    }

    fn sampler(&self) -> Option<&Sampler> {
        Some(&self.sampler)
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
