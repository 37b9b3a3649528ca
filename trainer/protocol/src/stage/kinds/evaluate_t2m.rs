//! `evaluate.t2m`: the papers' metrics, in an evaluator's space. Source: text-to-motion (Guo et al., CVPR 2022) and all after it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::stage::{Neighbours, Output, Problems, Ref, Sampler, Shape, Split, StageSpec};
use crate::{ArtifactKind, limits};

/// How different the motions of one caption are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct MultiModality {
    /// Captions per repeat; 0 leaves the metric out.
    pub captions: usize,
    /// Motions per caption.
    pub samples: usize,
    /// Pairs compared per caption.
    pub pairs: usize,
}

impl Default for MultiModality {
    fn default() -> Self {
        Self { captions: 100, samples: 30, pairs: 10 }
    }
}

/// `evaluate.t2m`: the papers' metrics, in an evaluator's space.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvaluateT2m {
    /// Stage that gives the model.
    pub model: String,
    /// Stage that gives the clips.
    pub dataset: String,
    /// Stage that gives the evaluator.
    pub evaluator: String,
    /// Measures real motion, against itself with other crops; no model is read.
    pub real: bool,
    /// The control: captions are dealt to motions at random, so that retrieval is left to chance.
    pub shuffled: bool,
    /// Sampler.
    pub sampler: Sampler,
    /// Repeats with other noise, captions, crops and pools.
    pub repeats: usize,
    /// MultiModality.
    pub multimodality: MultiModality,
    /// Clips. Choose on `val`; `test` is for the last look.
    pub split: Split,
    /// Takes all clips where the split has fewer than a pool of 32, and says so in the report; otherwise so small a split is refused.
    pub all_if_small: bool,
    /// Shards.
    pub shards: usize,
}

impl Default for EvaluateT2m {
    fn default() -> Self {
        Self {
            model: "mld".into(),
            dataset: "dataset".into(),
            evaluator: "evaluator".into(),
            real: false,
            shuffled: false,
            sampler: Sampler::default(),
            repeats: 20,
            multimodality: MultiModality::default(),
            split: Split::Val,
            all_if_small: false,
            shards: 8,
        }
    }
}

impl StageSpec for EvaluateT2m {
    const KIND: &'static str = "evaluate.t2m";
    // 2: says which model it measured, and how that was drawn.
    const VERSION: u32 = 2;
    const SHAPE: Shape = Shape::Map;
    const OUTPUT: Output = Output { name: "report", kind: ArtifactKind::Report };

    fn refs(&mut self) -> Vec<Ref<'_>> {
        let generated = !self.real;
        vec![
            Ref::stage("dataset", &mut self.dataset, ArtifactKind::Dataset),
            Ref::stage("evaluator", &mut self.evaluator, ArtifactKind::Evaluator),
            Ref::stage("model", &mut self.model, ArtifactKind::Model)
                .only_if(generated)
                // Shuffled captions say nothing of the model.
                .measured_if(generated && !self.shuffled),
        ]
    }

    fn check(&self, p: &mut Problems) {
        if !self.real {
            self.sampler.check(p);
        }
        p.positive("repeats", self.repeats);
        p.shards(self.shards);
        let MultiModality { captions, samples, pairs } = self.multimodality;
        p.product(
            "multimodality.samples",
            &[("repeats", self.repeats), ("multimodality.captions", captions), ("multimodality.samples", samples)],
            limits::EVALUATED_MOTIONS,
        );
        if captions > 0 && !(1..=samples).contains(&pairs) {
            let message = format!("`multimodality.pairs` is {pairs}; expected 1 to `samples`, {samples}");
            p.add("multimodality.pairs", message, "");
        }
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, p: &mut Problems) {
        let (evaluator, dataset) = (&self.evaluator, &self.dataset);
        if let (Some(ours), Some(theirs)) = (stages.format(dataset), stages.format(evaluator))
            && ours != theirs
        {
            let message = format!(
                "`{evaluator}` is an evaluator for skeletons of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add("evaluator", message, &format!("add a `train.evaluator` stage with `dataset: {dataset}`"));
        }
        if self.real {
            return;
        }
        let model = &self.model;
        if stages.evaluator_of_model(model) == Some(evaluator) {
            let message =
                format!("`{model}` was trained to agree with `{evaluator}`, so that its metrics would flatter it");
            p.add("evaluator", message, "train another evaluator, under another name, to measure with");
        }
        if let (Some(ours), Some(theirs)) = (stages.format(dataset), stages.format(model))
            && ours != theirs
        {
            let message = format!(
                "`{model}` makes motions of {}, but the clips of `{dataset}` have {}",
                theirs.skeleton(),
                ours.skeleton()
            );
            p.add("model", message, "measure a model on the format that it was trained on");
        }
        stages.check_sampler(p, model, &self.sampler);
    }

    fn sampler(&self) -> Option<&Sampler> {
        (!self.real).then_some(&self.sampler)
    }

    fn shards(&self) -> usize {
        self.shards
    }
}
